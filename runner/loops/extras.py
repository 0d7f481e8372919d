"""The values that a loop records with its steps: `rec.step(action, extras={"value": value})`.

They are put into columns, a row for each step, and handed to the recorder some thousands at a time. The last
row waits for `note_step` until the next step is taken.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.errors import ConfigError, RunnerError
from runner.loops.rows import PhaseRows
from runner.loops.values import as_array
from runner.recording import schema
from runner.recording.extras import MAX_EXTRA_BYTES, MAX_NAME_LENGTH, MAX_NAMES, ExtraLayout
from runner.recording.gym_values import SCALARS
from runner.recording.messages import encode
from runner.recording.recorder import Recorder
from runner.util.values import is_utf8

_MAX_ROWS: Final = 4096
_MAX_BYTES: Final = 4 << 20
"""The most rows, and bytes of them, that wait for the recorder."""
_MAX_DIMENSIONS: Final = 8
_PYTHON: Final = {bool: "?", int: "<i8", float: "<f8"}
_TOPICS: Final = {"train": schema.TRAIN_EXTRA, "eval": schema.EVAL_EXTRA}

Put = Callable[[int, Any], None]
"""Puts a value into a row of its column."""


class Extras:
    """The extras of a loop that the recorder does not have yet; the caller holds the loop's lock.

    Args:
        recorder: takes their records.
        batch: (N,) for N environments that step at once, whose values are arrays [N, ...]; else ().
    """

    def __init__(self, recorder: Recorder, batch: tuple[int, ...] = ()) -> None:
        self._recorder, self._batch = recorder, batch
        self._n = batch[0] if batch else 1
        self._taken = recorder.steps
        self._dtypes: dict[str, np.dtype[Any]] = {}
        self._is_described = False
        """Whether the recording has the names and dtypes."""
        self._columns: dict[str, NDArray[Any]] = {}
        """By name, [rows, *batch, *shape]."""
        self._put: dict[str, Put] = {}
        self._room = 0
        self._phase = ""
        self._steps: list[int] = []
        """The number of the step of each row; of several environments, that of the first."""
        self._partial: dict[int, set[str]] = {}
        """The names that were given, in rows that do not have all."""
        self._final = dict.fromkeys(schema.PHASES, -1)
        """The last step of each phase that cannot be extended any more."""

    def taker(self, phase: str, rows: PhaseRows) -> Callable[[Mapping[str, Any]], None]:
        """Return a function that puts down the values of a step that was just taken, by name.

        It is called with each step, so it has what it needs at hand.

        Args:
            phase: `train` or `eval`.
            rows: its steps.

        Raises:
            ConfigError: (from the returned function) a name or a value cannot be recorded.
        """
        steps, put, partial, taken, n = self._steps, self._put, self._partial, self._taken, self._n

        def take(values: Mapping[str, Any]) -> None:
            if not values:
                return
            row = len(steps)
            try:
                for name, value in values.items():
                    put[name](row, value)
            except (AttributeError, IndexError, KeyError):  # no mapping, no room, or a new name
                row = self._put_new(row, values)
            if not row:
                self._phase = phase
            steps.append(taken[phase] + rows.filled - n)
            if len(values) != len(put):
                partial[row] = set(values)

        return take

    def extend(self, phase: str, rows: PhaseRows, values: Mapping[str, Any]) -> None:
        """Put down further values of the last step of the phase that is recorded now.

        Args:
            phase: `train` or `eval`.
            rows: its steps.
            values: by name.

        Raises:
            ConfigError: a name or a value cannot be recorded.
            RunnerError: there is no such step, or it cannot be extended any more.
        """
        step = self._taken[phase] + rows.filled - self._n
        if step <= self._final[phase]:
            raise RunnerError(
                "note_step: found no step that can be extended, expected one of this phase that was taken "
                "after the last step of the other phase."
            )
        if not self._steps or self._steps[-1] != step:
            self.taker(phase, rows)(values)
            return
        row = self._put_new(len(self._steps) - 1, values)
        if row in self._partial:
            self._partial[row].update(values)

    def _put_new(self, row: int, values: Mapping[str, Any]) -> int:
        """Put down values of which some may have new names; return the row that they have then."""
        if not isinstance(values, Mapping):
            raise ConfigError(f"extras: found {type(values).__name__}, expected values by name")
        if row == self._room:
            self._write(row)
            row = 0
        fresh = {name: self._dtype_of(name, value) for name, value in values.items() if name not in self._put}
        if fresh:
            row = self._grow(row, fresh)
        for name, value in values.items():
            self._put[name](row, value)
        return row

    def _grow(self, row: int, fresh: dict[str, np.dtype[Any]]) -> int:
        """Add names, of which rows before this one have no values; return the row that it is now."""
        dtypes = self._dtypes | fresh
        if len(dtypes) > MAX_NAMES:
            raise ConfigError(f"extras: found more than {MAX_NAMES} names, the last {list(dtypes)[-1]!r}")
        if (size := sum(dtype.itemsize for dtype in dtypes.values())) > MAX_EXTRA_BYTES:
            raise ConfigError(
                f"extras: found {size:,} bytes a step, expected at most {MAX_EXTRA_BYTES:,}; snapshot() "
                "records a larger array now and then."
            )
        self._write(row)
        if self._steps:
            self._partial.setdefault(0, set(self._dtypes))
        self._room = max(1, min(_MAX_ROWS, _MAX_BYTES // (size * self._n)))
        before, self._columns = self._columns, {}
        for name, dtype in dtypes.items():
            column = np.zeros((self._room, *self._batch, *dtype.shape), dtype.base.str)
            if name in before:
                column[:1] = before[name][:1]
            self._columns[name], self._put[name] = column, _filler(name, column)
        self._dtypes, self._is_described = dtypes, False
        return 0

    def _dtype_of(self, name: Any, value: Any) -> np.dtype[Any]:
        """Return the dtype, with the shape, that a name gets by its first value."""
        if not isinstance(name, str) or not 0 < len(name) <= MAX_NAME_LENGTH or not is_utf8(name):
            raise ConfigError(
                f"extras: found the name {str(name)[:80]!r}, expected text of 1 to {MAX_NAME_LENGTH} letters"
            )
        array = _numbers(name, value)
        if array.shape[: len(self._batch)] != self._batch:
            raise ConfigError(
                f"extras: found shape {array.shape} for {name!r}, expected an array [{self._n}, ...] with a "
                "value for each environment"
            )
        shape = array.shape[len(self._batch) :]
        if not array.size or array.ndim > _MAX_DIMENSIONS:
            raise ConfigError(
                f"extras: found an array of shape {array.shape} for {name!r}, expected at most "
                f"{_MAX_DIMENSIONS} dimensions, and a number at least"
            )
        return np.dtype((array.dtype.newbyteorder("<").str, shape))

    def commit(self) -> None:
        """Hand all rows to the recorder but the last one, which may be extended."""
        self._write(len(self._steps) - 1)

    def finish(self) -> None:
        """Hand all rows to the recorder; no step taken so far can be extended. All steps are committed."""
        self._write(len(self._steps))
        self._final = {phase: steps - 1 for phase, steps in self._taken.items()}

    def _write(self, n: int) -> None:
        """Hand the first n rows to the recorder."""
        if n <= 0:
            return
        topic, recorder = _TOPICS[self._phase], self._recorder
        # The steps of the other phase came before all of these.
        first = sum(recorder.steps.values()) - recorder.steps[self._phase] + 1
        if not self._is_described:
            layout = ExtraLayout(0, np.dtype(list(self._dtypes.items())))
            payload = encode(schema.EXTRA_COLUMNS, {"json": layout.json})
            recorder.append(schema.EXTRA_COLUMNS_TOPIC, payload, first + self._steps[0])
            recorder.flush_messages()
            recorder.resize(dict.fromkeys(_TOPICS.values(), layout.sizes))
            self._is_described = True
        given = self._given(n)
        steps = np.add.outer(np.array(self._steps[:n]), np.arange(self._n)).ravel()
        done = 0
        while done < len(steps):
            block = recorder.block(topic)[: len(steps) - done]
            part = slice(done, done + len(block))
            block["step"] = steps[part]
            for name, column in self._columns.items():
                values = column[:n].reshape(len(steps), *self._dtypes[name].shape)
                block["values"][name] = values[part]
                block["given"][name] = given[name][part]
            recorder.take(topic, (steps[part] + first).astype(np.uint64))
            done += len(block)
        self._final[self._phase] = int(steps[-1])
        self._keep_from(n)

    def _given(self, n: int) -> dict[str, NDArray[np.bool_]]:
        """Return whether each environment's step has a value, by name, in n rows; clear the rest."""
        given = {name: np.ones(n, np.bool_) for name in self._dtypes}
        for row, names in self._partial.items():
            for name in given.keys() - names if row < n else ():
                given[name][row] = False
                self._columns[name][row] = 0
        return {name: np.repeat(flags, self._n) for name, flags in given.items()}

    def _keep_from(self, n: int) -> None:
        """Remove the first n rows; at most one remains."""
        del self._steps[:n]
        if self._steps:
            for column in self._columns.values():
                column[0] = column[n]
        left = {row - n: names for row, names in self._partial.items() if row >= n}
        self._partial.clear()
        self._partial.update(left)


def _filler(name: str, column: NDArray[Any]) -> Put:
    """Return a function that puts a value of a name into a row of its column.

    Raises:
        ConfigError: (from the returned function) it has another shape or dtype than the first one.
    """
    base, shape, array = column.dtype, column.shape[1:], np.ndarray
    exact = {kind for kind in SCALARS if np.can_cast(kind, base)}
    exact |= {kind for kind, held in _PYTHON.items() if np.dtype(held) == base}
    scalars = frozenset(() if shape else exact)

    def put(row: int, value: Any) -> None:
        if value.__class__ is array and value.dtype is base and value.shape == shape:
            column[row] = value
            return
        if value.__class__ not in scalars:
            value = _fitting(name, value, base, shape)
        try:
            column[row] = value
        except OverflowError as error:
            raise ConfigError(f"extras: found {value} for {name!r}, which {base} cannot hold") from error

    return put


def _fitting(name: str, value: Any, base: np.dtype[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """Return a value as an array, of the shape and of a dtype that the column holds exactly."""
    array = _numbers(name, value)
    if array.shape != shape or not np.can_cast(array.dtype, base):
        raise ConfigError(
            f"extras: found {array.dtype} of shape {array.shape} for {name!r}, expected {base} of shape "
            f"{shape} as in its first value: convert it, or record it under another name"
        )
    return array


def _numbers(name: str, value: Any) -> NDArray[Any]:
    """Return a value as an array of numbers."""
    try:
        array = as_array(value)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise ConfigError(
            f"extras: found no number and no array of numbers for {name!r} ({error})"
        ) from error
    if array.dtype.kind not in "biuf" or array.dtype.itemsize > 8:
        raise ConfigError(
            f"extras: found {type(value).__name__} of {array.dtype} for {name!r}, expected a number or an "
            "array of numbers"
        )
    return array
