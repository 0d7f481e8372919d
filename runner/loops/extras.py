"""The values that a loop records with its steps: `rec.step(action, extras={"value": value})`.

They are put into columns, a row for each step, and handed to the recorder some thousands at a time. The last
row waits for `note_step` until the next step is taken. Values of varying size, which are texts, and arrays
with a first axis of varying length, are put down as bytes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from runner.errors import ConfigError
from runner.loops.step_buffer import StepBuffer
from runner.loops.values import as_array, numbers_of
from runner.recording import schema
from runner.recording.extras import (
    MAX_EXTRA_BYTES,
    MAX_NAME_LENGTH,
    MAX_NAMES,
    NOTHING,
    ExtraLayout,
    box_of,
    encoded,
    lengthened,
    united,
)
from runner.recording.gym_values import SCALARS
from runner.recording.messages import encode
from runner.recording.recorder import Recorder
from runner.recording.spaces import Description, Value, item_dtype, leaf_dtype, row_dtype
from runner.util.arrays import Array, Flags, Ints
from runner.util.values import is_utf8

_MAX_ROWS: Final = 4096
_MAX_BYTES: Final = 4 << 20
"""The most rows, and bytes of them, that wait for the recorder."""
_MAX_DIMENSIONS: Final = 8
_PYTHON: Final = {bool: "?", int: "<i8", float: "<f8"}
_Values = Array | list[Any]
"""Values of a name: numbers as an array, else a list of texts, or of arrays of different lengths."""


@dataclass(frozen=True, slots=True)
class _Column:
    """The values of one name that the recorder does not have yet."""

    dtype: np.dtype[np.generic] | None
    """Of a number; None where values vary in size, which are bytes then."""
    shape: tuple[int, ...]
    """The shape of a row: [*batch, ...]."""
    scalars: frozenset[type]
    """The classes of single numbers that it holds exactly."""
    values: Array
    """[rows, *shape]."""


class ExtrasWriter:
    """Hands the extras of steps to the recorder, and begins a layout where names are new or begin to vary."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self.described: dict[str, Description] = {}
        """The description of each name's values of one environment."""
        self.layout = ExtraLayout(-1, 0, {})
        """The last layout that the recording has."""

    def put(self, phase: str, steps: Ints, columns: Mapping[str, Array], given: Mapping[str, Flags]) -> None:
        """Record the extras of steps, given by their numbers in the phase that is recorded now.

        Args:
            columns: [steps, ...] by name, values of varying size as bytes; names that are missing have none.
            given: [steps], whether a step has the value, by name.
        """
        recorder = self._recorder
        # The steps of the other phase came before all of these.
        positions = (steps + (recorder.position - recorder.steps[phase] + 1)).astype(np.uint64)
        if self.layout.columns != self.described:
            position = int(positions[0])
            number = self.layout.number + 1
            self.layout = layout = ExtraLayout(number, position * schema.STEP_NANOSECONDS, self.described)
            recorder.append(schema.EXTRA_COLUMNS_TOPIC, encode(schema.EXTRA_COLUMNS, layout.fields), position)
            recorder.begin_extras(number, layout.message)
        varying = self.layout.varying["spaces"]
        nothing = np.full(len(steps), NOTHING, object)
        for block, part in recorder.fill(schema.extra_topic(phase, self.layout.number), positions):
            block["step"] = steps[part]
            for name in self.described:
                block["given"][name] = given[name][part] if name in given else False
                if name not in varying:
                    block["values"][name] = columns[name][part] if name in columns else 0
            if varying:
                parts = (columns.get(name, nothing)[part].tolist() for name in varying)
                block["varying"] = np.fromiter(map(b"".join, zip(*parts, strict=True)), object)


class PendingExtras:
    """The extras of a loop that the recorder does not have yet; the caller holds the loop's lock.

    Args:
        leave_out: called with the error of each value that cannot be recorded; the others of its step are.
        batch: (N,) for N environments that step at once, with values [N, ...]; else ().
    """

    def __init__(
        self, recorder: Recorder, leave_out: Callable[[Exception], None], batch: tuple[int, ...] = ()
    ) -> None:
        self._writer = ExtrasWriter(recorder)
        self._leave_out = leave_out
        self._batch = batch
        self._n = batch[0] if batch else 1
        self._taken = recorder.steps
        self._columns: dict[str, _Column] = {}
        self._room = 0
        """The rows that the columns hold."""
        self._max_rows = 0
        """How many of these rows may wait now."""
        self._phase = ""
        self._steps: list[int] = []
        """The number of each row's step; of several environments, of the first one's step."""
        self._partial: dict[int, set[str]] = {}
        """The names that were given, in rows that do not have all."""
        self._fixed_bytes = 0
        """Bytes of a step's values of one size."""
        self._held = 0
        """Bytes of varying size put down since rows were last handed on."""
        self._held_row = -1
        """The last row that has some of these bytes."""
        self._row_bytes: dict[str, int] = {}
        """The most bytes of an environment in that row, by name."""
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
                    column = columns[name]
                    is_fitting = (
                        value.__class__ is array
                        and value.dtype is column.dtype
                        and value.shape == column.shape
                    ) or value.__class__ in column.scalars
                    column.values[row] = value if is_fitting else self._fitted(name, row, value)
            except (AttributeError, KeyError):  # no mapping, a new name, or values of another length
                take(self._grow(row, values))
                return
            except (OverflowError, ConfigError) as error:
                self._leave_out(
                    ConfigError(f"extras: found {value} for {name!r}, which {column.dtype} cannot hold")
                    if isinstance(error, OverflowError)
                    else error
                )
                take({other: value for other, value in values.items() if other != name})
                return
            if not row:
                self._phase = phase
            steps.append(taken[phase] + (rows.filled - 1) * n)
            if len(values) != len(columns):
                self._partial[row] = set(values)
            if row >= self._max_rows:
                self._write(row)

        return take

    def extend(self, phase: str, rows: StepBuffer, values: Mapping[str, object]) -> None:
        """Put down further values of the last step of the phase that is recorded now.

        Raises:
            ConfigError: there is no such step, or it cannot be extended any more.
        """
        step = self._taken[phase] + rows.pending - self._n
        if step <= self._final[phase]:
            raise ConfigError(
                "note_step: found no step that can be extended, expected one of this phase that was taken "
                "after the last step of the other phase."
            )
        if not self._steps or self._steps[-1] != step:
            self.taker(phase, rows)(values)
            return
        values = self._grow(len(self._steps) - 1, values)
        row = len(self._steps) - 1
        fitting = {}
        for name, value in values.items():
            try:
                fitting[name] = self._fitted(name, row, value)
            except ConfigError as error:
                self._leave_out(error)
        for name, value in fitting.items():
            self._columns[name].values[row] = value
        if row in self._partial:
            self._partial[row].update(fitting)

    def checked_batch(self, values: Mapping[str, object], shape: tuple[int, ...]) -> dict[str, Array]:
        """Return the values of T steps of N environments, by name, as `put_batch` takes them.

        Args:
            values: [T, N, ...] each; values of varying size in lists of T lists of N.
            shape: T and N.

        Raises:
            ConfigError: they are too large together.
        """
        values = self._grow(len(self._steps), values, shape)
        sizes = np.full(shape[0] * self._n, self._fixed_bytes)
        flat = {}
        for name, value in values.items():
            column = self._writer.described[name]
            whole = _values(name, value, shape)
            if leaf_dtype(column) is None:
                flat[name] = np.fromiter((encoded(column, item) for item in _listed(whole, shape)), object)
                sizes += [len(item) for item in flat[name].tolist()]
            else:
                assert isinstance(whole, np.ndarray)
                flat[name] = whole.reshape(len(sizes), *whole.shape[2:])
        if sizes.max() > MAX_EXTRA_BYTES:
            raise _too_large(", ".join(flat), int(sizes.max()))
        return flat

    def put_batch(self, phase: str, rows: StepBuffer, values: Mapping[str, Array]) -> None:
        """Hand the values of the T steps of all environments that were just taken to the recorder.

        Args:
            values: as `checked_batch` returned them.
        """
        self._write(len(self._steps))
        self._phase = phase
        count = len(next(iter(values.values())))
        first = self._taken[phase] + rows.pending - count
        self._writer.put(
            phase, np.arange(first, first + count), values, dict.fromkeys(values, np.ones(count, np.bool_))
        )
        self._final[phase] = first + count - 1

    def _grow(self, row: int, values: Any, lead: tuple[int, ...] | None = None) -> Mapping[str, object]:
        """Add columns for new names, and let the first axis of an array vary once its length changes.

        Args:
            row: the first row that may have them.
            values: [*lead, ...] each; by default of one step.

        Returns:
            The values that can be recorded.
        """
        if not isinstance(values, Mapping):
            self._leave_out(ConfigError(f"extras: found {type(values).__name__}, expected values by name"))
            return {}
        described, size = self._descriptions(values, self._batch if lead is None else lead)
        fitting = {name: value for name, value in values.items() if name in described}
        described = self._writer.described | described
        if described == self._writer.described:
            return fitting
        self._write(row)  # with the names so far, which begins a layout if they are new
        if self._writer.layout.number + 1 == schema.MAX_LAYOUTS:
            changed = [name for name in fitting if self._writer.described.get(name) != described[name]]
            self._leave_out(_too_many(changed[0]))
            return {name: value for name, value in fitting.items() if name not in changed}
        if self._steps:
            self._partial.setdefault(0, set(self._writer.described))
        self._fixed_bytes = size
        self._writer.described = described
        width = row_dtype({"type": "Dict", "spaces": described}).itemsize * self._n
        self._room = self._max_rows = max(1, min(_MAX_ROWS, _MAX_BYTES // width))
        left = len(self._steps)
        for name, description in described.items():
            before = self._columns.get(name)
            column = self._column(description)
            self._columns[name] = column
            if before is None:
                continue
            if before.values.dtype == column.values.dtype:
                column.values[:left] = before.values[:left]
            else:
                for k in range(left):
                    column.values[k] = self._fitted(name, k, before.values[k])
        return fitting

    def _descriptions(
        self, values: Mapping[str, object], lead: tuple[int, ...]
    ) -> tuple[dict[str, Description], int]:
        """Return the descriptions of the values that can be recorded, and the bytes of all of one size."""
        described = dict[str, Description]()
        size = self._fixed_bytes
        for name, value in values.items():
            known = self._writer.described.get(name)
            try:
                needed = _needed(name, known, value, lead)
                larger = size + _fixed_size(needed) - _fixed_size(known)
                if larger > MAX_EXTRA_BYTES:
                    raise _too_large(name, larger)
                if len({*self._writer.described, *described, name}) > MAX_NAMES:
                    raise _too_many(name)
            except ConfigError as error:
                self._leave_out(error)
                continue
            described[name], size = needed, larger
        return described, size

    def _column(self, description: Description) -> _Column:
        """Return a column for values of a description."""
        dtype = leaf_dtype(description)
        if dtype is None:
            return _Column(None, (), frozenset(), np.full((self._room + 1, *self._batch), NOTHING, object))
        base = np.dtype(dtype.base.str)
        shape = (*self._batch, *dtype.shape)
        exact = {kind for kind in SCALARS if np.can_cast(kind, base)}
        exact |= {kind for kind, held in _PYTHON.items() if np.dtype(held) == base}
        return _Column(
            base, shape, frozenset(() if shape else exact), np.zeros((self._room + 1, *shape), base)
        )

    def _fitted(self, name: str, row: int, value: object) -> Any:
        """Return a value as it is put into a row of its column; count the bytes of values of varying size.

        Raises:
            KeyError: it has another dtype or shape than the column.
            ConfigError: it cannot be recorded.
        """
        column, description, batch = self._columns[name], self._writer.described[name], self._batch
        values = _values(name, value, batch)
        if column.dtype is not None:
            if isinstance(values, list) or values.shape != column.shape:
                raise KeyError(name)
            if not np.can_cast(values.dtype, column.dtype):
                raise KeyError(name)
            return values
        items = _listed(values, batch)
        item_type = item_dtype(description)
        for item in items:
            is_alike = isinstance(item, str) == (item_type is None)
            if item_type is not None and is_alike:
                is_alike = (item.dtype, item.shape[1:]) == (item_type.base, item_type.shape)
            if not is_alike:
                _needed(name, description, value, batch)
        data = [encoded(description, item) for item in items]
        if row != self._held_row:
            self._held_row = row
            self._row_bytes = {}
        self._row_bytes[name] = max(map(len, data))
        if (size := self._fixed_bytes + sum(self._row_bytes.values())) > MAX_EXTRA_BYTES:
            del self._row_bytes[name]
            raise _too_large(name, size)
        self._held += sum(map(len, data))
        if self._held > _MAX_BYTES:
            self._max_rows = min(self._max_rows, row)
        return np.fromiter(data, object) if batch else data[0]

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
        given = {name: np.ones(n, np.bool_) for name in self._columns}
        for row, names in self._partial.items():
            if row < n:
                for name in given.keys() - names:  # blank what the row does not have
                    given[name][row] = False
                    column = self._columns[name]
                    column.values[row : row + 1].fill(NOTHING if column.dtype is None else 0)
        columns = {}
        for name, column in self._columns.items():
            columns[name] = column.values[:n].reshape(-1, *column.shape[len(self._batch) :])
        steps = np.add.outer(np.array(self._steps[:n]), np.arange(self._n)).ravel()
        flags = {name: np.repeat(are_given, self._n) for name, are_given in given.items()}
        self._writer.put(self._phase, steps, columns, flags)
        self._final[self._phase] = int(steps[-1])
        del self._steps[:n]
        left = len(self._steps)
        for column in self._columns.values():
            column.values[:left] = column.values[n : n + left]
        self._partial = {row - n: names for row, names in self._partial.items() if row >= n}
        self._max_rows = self._room
        self._held = 0
        self._held_row -= n


def _fixed_size(description: Description | None) -> int:
    """Return the bytes of a step's values of one size."""
    dtype = None if description is None else leaf_dtype(description)
    return 0 if dtype is None else dtype.itemsize


def _too_large(name: str, size: int) -> ConfigError:
    return ConfigError(
        f"extras: found {size:,} bytes a step, expected at most {MAX_EXTRA_BYTES:,}: {name!r} is too large. "
        "snapshot() records a larger array now and then."
    )


def _too_many(name: str) -> ConfigError:
    return ConfigError(
        f"extras: found more than {MAX_NAMES} names, or {schema.MAX_LAYOUTS} steps with names that were new "
        f"or began to vary in length, the last {name!r}"
    )


def _values(name: str, value: object, lead: tuple[int, ...]) -> _Values:
    """Return the values of a name, [*lead, ...]: an array, or a list of texts or arrays, row by row.

    Raises:
        ConfigError: it holds something else, or not as many.
    """
    if not lead:
        return [value] if isinstance(value, str) else _numbers(repr(name), value)
    try:
        array = as_array(value)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        array = np.empty(0, object)
    if array.dtype.kind in "biuf" and (array.size or not isinstance(value, list | tuple)):
        if array.shape[: len(lead)] != lead:
            raise _wrong_shape(name, f"shape {array.shape}", lead)
        return array
    items: list[Any] = [value]
    for n in lead:
        for item in items:
            is_array = isinstance(item, np.ndarray) and item.ndim > 0
            if not (is_array or isinstance(item, list | tuple)) or len(item) != n:
                raise _wrong_shape(name, f"{type(item).__name__} {str(item)[:40]!r}", lead)
        items = [part for item in items for part in item]
    items = [
        item if isinstance(item, str) else _numbers(_place(name, i, lead), item)
        for i, item in enumerate(items)
    ]
    has_text = any(isinstance(item, str) for item in items)
    if len({np.shape(item) for item in items}) == 1 and not has_text and items[0].size:
        return np.stack(items).reshape(*lead, *items[0].shape)
    return items


def _listed(values: _Values, lead: tuple[int, ...]) -> list[Any]:
    """Return the value of each environment."""
    if isinstance(values, list):
        return values
    return list(values.reshape(math.prod(lead), *values.shape[len(lead) :]))


def _needed(name: object, known: Description | None, value: object, lead: tuple[int, ...]) -> Description:
    """Return the description that a name needs for these values, [*lead, ...], and for its earlier values.

    It keeps the dtype and the shape of its first value; only the first axis may get another length.

    Raises:
        ConfigError: there is none.
    """
    if not isinstance(name, str) or not 0 < len(name) <= MAX_NAME_LENGTH or not is_utf8(name):
        raise ConfigError(
            f"extras: found the name {str(name)[:80]!r}, expected text of 1 to {MAX_NAME_LENGTH} letters"
        )
    values = _values(name, value, lead)
    given = _described(name, values, lead)
    is_empty = given["type"] == "Array" and not any(item.size for item in _listed(values, lead))
    if known is None:
        if is_empty and isinstance(value, list | tuple) and given["dtype"] == "|b1":
            raise ConfigError(
                f"extras: found an empty list as the first value of {name!r}, expected an array, which has a "
                "dtype, such as np.zeros(0, np.int64)"
            )
        return given
    if is_empty and known.get("shape"):  # it fits, whatever dtype it has
        return lengthened(known)
    both = united(known, given)
    if both is not None and both.get("dtype") == known.get("dtype"):
        return both
    raise ConfigError(
        f"extras: found {_named(given)} for {name!r}, expected {_named(known)} as in its first value: "
        "convert it, or record it under another name"
    )


def _described(name: str, values: _Values, lead: tuple[int, ...]) -> Description:
    """Return the description of the first values of a name."""
    if isinstance(values, list):
        kinds = ["" if np.shape(item) == (0,) else _kind(item) for item in values]  # "" fits any array
        common = max(kinds, key=lambda kind: (kind != "", kinds.count(kind)))
        are_texts, are_numbers = common == "a text", common == "a number"
        odd = [k for k, kind in enumerate(kinds) if kind != common and (kind or are_texts or are_numbers)]
        if odd:
            raise ConfigError(
                f"extras: found {kinds[odd[0]] or 'an empty array'} for {_place(name, odd[0], lead)}, and "
                f"{common} for others; expected texts, or arrays that differ in their first axis only"
            )
        if are_texts:
            return {"type": "Text"}
        shapes = {item.shape[1:] for item in values if item.shape != (0,)} or {()}
        dtype = np.result_type(*(item.dtype for item in values))
        return lengthened(box_of(dtype.newbyteorder("<"), (0, *shapes.pop())))
    shape = values.shape[len(lead) :]
    if 0 in shape[1:] or values.ndim > _MAX_DIMENSIONS:
        raise ConfigError(
            f"extras: found an array of shape {values.shape} for {name!r}, expected at most "
            f"{_MAX_DIMENSIONS} dimensions, and a number at least in all but the first"
        )
    box = box_of(values.dtype.newbyteorder("<"), shape)
    return lengthened(box) if shape[:1] == (0,) else box


def _kind(item: str | Array) -> str:
    """Return what one value is, for an error."""
    if isinstance(item, str):
        return "a text"
    return f"an array of shape ({', '.join(['T', *map(str, item.shape[1:])])})" if item.ndim else "a number"


def _named(description: Description) -> str:
    """Return what values are, for an error."""
    if description["type"] == "Text":
        return "str"
    lengths = ["T" if n is None else str(n) for n in description["shape"]]
    shape = f"({', '.join(lengths)}{',' if len(lengths) == 1 else ''})"
    return f"{np.dtype(description['dtype'])} of shape {shape}"


def _wrong_shape(name: str, given: str, lead: tuple[int, ...]) -> ConfigError:
    if len(lead) > 1:
        return ConfigError(f"extras: found {given} for {name!r}, expected {(*lead, '...')}")
    return ConfigError(
        f"extras: found {given} for {name!r}, expected an array [{lead[0]}, ...] or a list with a value for "
        "each environment"
    )


def _place(name: str, i: int, lead: tuple[int, ...]) -> str:
    """Return the name of a value, with the environment of the i-th one if there are several."""
    return f"{name!r} of environment {i % lead[-1]}" if lead else repr(name)


def _numbers(place: str, value: object) -> Array:
    if isinstance(value, list | tuple) and not value:
        return np.zeros(0, np.bool_)  # which fits into any dtype
    return numbers_of(
        value, "extras", f"for {place}", "a number or an array of numbers, of one shape, or a text"
    )
