"""The values that a loop records with its steps: `rec.step(action, extras={"value": value})`.

They are put into columns, a row for each step, and handed to the recorder some thousands at a time. The last
row waits for `note_step` until the next step is taken.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from runner.errors import ConfigError, RunnerError
from runner.loops.step_buffer import StepBuffer
from runner.loops.values import numbers_of
from runner.recording import schema
from runner.recording.extras import MAX_EXTRA_BYTES, MAX_NAME_LENGTH, MAX_NAMES, ExtraLayout
from runner.recording.gym_values import SCALARS
from runner.recording.messages import encode
from runner.recording.recorder import Recorder
from runner.recording.spaces import Value
from runner.util.arrays import Array
from runner.util.values import is_utf8

_MAX_ROWS: Final = 4096
_MAX_BYTES: Final = 4 << 20
"""The most rows, and bytes of them, that wait for the recorder."""
_MAX_DIMENSIONS: Final = 8
_PYTHON: Final = {bool: "?", int: "<i8", float: "<f8"}
TOPICS: Final = {"train": schema.TRAIN_EXTRA, "eval": schema.EVAL_EXTRA}


class _Column(NamedTuple):
    """The values of one name that the recorder does not have yet."""

    dtype: np.dtype[np.generic]
    shape: tuple[int, ...]
    """The shape of a row: [*batch, ...]."""
    scalars: frozenset[type]
    """The classes of single numbers that it holds exactly."""
    values: Array
    """[rows, *shape]."""


class Extras:
    """The extras of a loop that the recorder does not have yet; the caller holds the loop's lock.

    Args:
        batch: (N,) for N environments that step at once, whose values are arrays [N, ...]; else ().
    """

    def __init__(self, recorder: Recorder, batch: tuple[int, ...] = ()) -> None:
        self._recorder, self._batch = recorder, batch
        self._n = batch[0] if batch else 1
        self._taken = recorder.steps
        self._dtypes: dict[str, np.dtype[np.generic]] = {}
        """The dtype of each name's values of one environment, with their shape."""
        self._is_described = False
        """Whether the recording has the names and dtypes."""
        self._columns: dict[str, _Column] = {}
        self._max_rows = 0
        self._phase = ""
        self._steps: list[int] = []
        """The number of the step of each row; of several environments, that of the first."""
        self._partial: dict[int, set[str]] = {}
        """The names that were given, in rows that do not have all."""
        self._final = dict.fromkeys(schema.PHASES, -1)
        """The last step of each phase that cannot be extended any more."""

    def taker(self, phase: str, rows: StepBuffer) -> Callable[[Mapping[str, object]], None]:
        """Return a function that puts down the values of a step that was just taken, by name.

        It is called with each step, so it has what it needs at hand.
        """
        steps, columns, taken, n, array = self._steps, self._columns, self._taken, self._n, np.ndarray

        def take(values: Mapping[str, Value]) -> None:
            if not values:
                return
            row = len(steps)
            try:
                for name, value in values.items():
                    dtype, shape, scalars, cells = columns[name]
                    is_fitting = value.__class__ in scalars or (
                        value.__class__ is array and value.dtype is dtype and value.shape == shape
                    )
                    cells[row] = value if is_fitting else _fitting(name, value, dtype, shape)
            except (AttributeError, KeyError):  # no mapping, or a new name
                self._grow(row, values)
                take(values)
                return
            except OverflowError as error:
                raise ConfigError(f"extras: found {value} for {name!r}, which {dtype} cannot hold") from error
            if not row:
                self._phase = phase
            steps.append(taken[phase] + rows.filled - n)
            if len(values) != len(columns):
                self._partial[row] = set(values)
            if row >= self._max_rows:
                self._write(row)

        return take

    def extend(self, phase: str, rows: StepBuffer, values: Mapping[str, object]) -> None:
        """Put down further values of the last step of the phase that is recorded now.

        Raises:
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
        self._grow(len(self._steps) - 1, values)
        row = len(self._steps) - 1
        columns = {name: self._columns[name] for name in values}
        fitting = {name: _fitting(name, values[name], own.dtype, own.shape) for name, own in columns.items()}
        for name, value in fitting.items():
            columns[name].values[row] = value
        if row in self._partial:
            self._partial[row].update(values)

    def checked_batch(self, values: Mapping[str, object], shape: tuple[int, ...]) -> dict[str, Array]:
        """Return the values of T steps of N environments, by name, as `put_batch` takes them.

        Args:
            values: [T, N, ...] each.
            shape: T and N.

        Raises:
            ConfigError: a name or a value cannot be recorded.
        """
        if not isinstance(values, Mapping):
            raise ConfigError(f"extras: found {type(values).__name__}, expected arrays by name")
        arrays = {name: _numbers(name, value) for name, value in values.items()}
        for name, array in arrays.items():
            if array.shape[:2] != shape:
                raise ConfigError(
                    f"extras: found shape {array.shape} for {name!r}, expected {(*shape, '...')}"
                )
        self._grow(len(self._steps), {name: array[0] for name, array in arrays.items()})
        return {
            name: _fitting(name, array, self._columns[name].dtype, shape[:1] + self._columns[name].shape)
            for name, array in arrays.items()
        }

    def put_batch(self, phase: str, rows: StepBuffer, values: Mapping[str, Array]) -> None:
        """Hand the values of the T steps of all environments that were just taken to the recorder.

        Args:
            values: as `checked_batch` returned them.
        """
        self._write(len(self._steps))
        self._phase = phase
        count = len(next(iter(values.values()))) * self._n
        first = self._taken[phase] + rows.filled - count
        columns = {
            name: values[name].reshape(count, *own.shape) if name in values else np.zeros(count, own)
            for name, own in self._dtypes.items()
        }
        given = {name: np.full(count, name in values) for name in self._dtypes}
        self._send(np.arange(first, first + count), columns, given)

    def _grow(self, row: int, values: Mapping[str, object]) -> None:
        """Add the names that are new, of which rows before this one have no values."""
        if not isinstance(values, Mapping):
            raise ConfigError(f"extras: found {type(values).__name__}, expected values by name")
        fresh = {
            name: self._dtype_of(name, value) for name, value in values.items() if name not in self._columns
        }
        if not fresh:
            return
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
        self._max_rows = max(1, min(_MAX_ROWS, _MAX_BYTES // (size * self._n)))
        self._dtypes, self._is_described = dtypes, False
        left = len(self._steps)
        for name, dtype in dtypes.items():
            own = self._columns.get(name)
            base, shape = np.dtype(dtype.base.str), (*self._batch, *dtype.shape)
            column = _column(base, shape, self._max_rows + 1)
            self._columns[name] = column
            if own is not None:
                column.values[:left] = own.values[:left]

    def _dtype_of(self, name: object, value: object) -> np.dtype[np.generic]:
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
        given = self._given(n)
        columns = {
            name: column.values[:n].reshape(-1, *self._dtypes[name].shape)
            for name, column in self._columns.items()
        }
        steps = np.add.outer(np.array(self._steps[:n]), np.arange(self._n)).ravel()
        self._send(steps, columns, given)
        del self._steps[:n]
        left = len(self._steps)
        for column in self._columns.values():
            column.values[:left] = column.values[n : n + left]
        self._partial = {row - n: names for row, names in self._partial.items() if row >= n}

    def _send(
        self, steps: NDArray[np.int64], columns: Mapping[str, Array], given: Mapping[str, NDArray[np.bool_]]
    ) -> None:
        """Hand the values with these steps, and whether each was given, to the recorder."""
        topic, recorder = TOPICS[self._phase], self._recorder
        # The steps of the other phase came before all of these.
        first = recorder.position - recorder.steps[self._phase] + 1
        if not self._is_described:
            layout = ExtraLayout(0, np.dtype(list(self._dtypes.items())))
            begin_layout(recorder, layout, first + int(steps[0]))
            self._is_described = True
        for block, part in recorder.fill(topic, (steps + first).astype(np.uint64)):
            block["step"] = steps[part]
            for name, values in columns.items():
                block["values"][name] = values[part]
                block["given"][name] = given[name][part]
        self._final[self._phase] = int(steps[-1])

    def _given(self, n: int) -> dict[str, NDArray[np.bool_]]:
        """Return whether each environment's step has a value, by name, in n rows; zero those without one."""
        given = {name: np.ones(n, np.bool_) for name in self._dtypes}
        for row, names in self._partial.items():
            for name in given.keys() - names if row < n else ():
                given[name][row] = False
                self._columns[name].values[row] = 0
        return {name: np.repeat(flags, self._n) for name, flags in given.items()}


def begin_layout(recorder: Recorder, layout: ExtraLayout, position: int) -> None:
    """Record the names of extras from a position on."""
    payload = encode(schema.EXTRA_COLUMNS, {"json": layout.json})
    recorder.append(schema.EXTRA_COLUMNS_TOPIC, payload, position)
    recorder.flush_messages()
    recorder.set_messages(dict.fromkeys(TOPICS.values(), layout.message))


def _column(base: np.dtype[np.generic], shape: tuple[int, ...], rows: int) -> _Column:
    """Return a column for values of a dtype and a shape."""
    exact: set[type] = {
        kind for kind in SCALARS if np.can_cast(kind, base) and (kind is not np.bool_ or base.kind == "b")
    }
    exact |= {kind for kind, held in _PYTHON.items() if np.dtype(held) == base}
    return _Column(base, shape, frozenset(() if shape else exact), np.zeros((rows, *shape), base))


def _fitting(name: str, value: object, base: np.dtype[np.generic], shape: tuple[int, ...]) -> Array:
    """Return a value as an array, of the shape and of a dtype that the column holds exactly."""
    array = _numbers(name, value)
    if array.shape != shape or not np.can_cast(array.dtype, base):
        raise ConfigError(
            f"extras: found {array.dtype} of shape {array.shape} for {name!r}, expected {base} of shape "
            f"{shape} as in its first value: convert it, or record it under another name"
        )
    return array


def _numbers(name: str, value: object) -> Array:
    return numbers_of(value, "extras", f"for {name!r}", "a number or an array of numbers")
