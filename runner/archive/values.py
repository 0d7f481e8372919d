"""Columns: how each is read from message records and written back, and the columns of a space's values.

The values of a space have one column for each number if there are few, else one with the bytes of the array:

    Box(4,) float32              action_0, action_1, action_2, action_3
    Dict(at=Box(2,), image=Box(84, 84, 3))
                                 observation_at_0, observation_at_1, observation_image (bytes, row by row)
    Text                         one column of text

Names are the path to the number: keys of `Dict`s, positions in `Tuple`s and arrays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from runner.recording.spaces import Leaf, Value, decode, encode_bytes, encode_text, leaves_of, row_dtype
from runner.util.arrays import Array, Records

MAX_NUMBERS: Final = 64
"""An array with more numbers is one column of bytes."""
MAX_COLUMNS: Final = 1024
"""In a space with more columns than this, every array is one column of bytes."""


@dataclass(frozen=True)
class ArchiveColumn:
    """A column of messages: how it is read from message records, and written back."""

    name: str
    type: pa.DataType
    read: Callable[[Records], pa.Array]
    write: Callable[[Records, pa.Array], None] | None = None
    """Sets the records' field; None if other columns determine it."""


def stored(name: str, kind: pa.DataType, values_in: Callable[[Records], Array]) -> ArchiveColumn:
    """Return the column of values that stand in records; `values_in` returns a view of them, [n, ...].

    Unsigned 32-bit numbers become signed, which readers can subtract.
    """
    is_bytes = pa.types.is_fixed_size_binary(kind)

    def read(records: Records) -> pa.Array:
        values = values_in(records)
        if values.dtype.hasobject:
            return pa.array(values.tolist(), kind)
        if is_bytes:
            raw = np.ascontiguousarray(values).view(np.uint8)
            return pa.FixedSizeBinaryArray.from_buffers(kind, len(records), [None, pa.py_buffer(raw.data)])
        return pa.array(np.ascontiguousarray(values).astype(kind.to_pandas_dtype(), copy=False), kind)

    def write(records: Records, column: pa.Array) -> None:
        values = values_in(records)
        if is_bytes:
            start = column.offset * kind.byte_width
            size = len(records) * kind.byte_width
            raw = np.frombuffer(column.buffers()[1], np.uint8)[start : start + size]
            values[...] = raw.view(values.dtype).reshape(values.shape)
        else:
            values[...] = numbers(column)

    return ArchiveColumn(name, kind, read, write)


def nullable(column: ArchiveColumn, given_in: Callable[[Records], Array | None]) -> ArchiveColumn:
    """Return the column with null where a value was not given.

    Args:
        given_in: returns a view of the flags in records, [n]; None if the records do not have the field.
    """
    write_values = column.write
    assert write_values is not None
    is_bytes = pa.types.is_fixed_size_binary(column.type)
    zero = pa.scalar(bytes(column.type.byte_width) if is_bytes else 0).cast(column.type)

    def read(records: Records) -> pa.Array:
        given = given_in(records)
        if given is None:
            return pa.nulls(len(records), column.type)
        values = column.read(records)
        null = pa.scalar(None, column.type)
        return values if given.all() else pc.if_else(pa.array(np.ascontiguousarray(given)), values, null)

    def write(records: Records, values: pa.Array) -> None:
        given = given_in(records)
        if given is not None:
            given[...] = numbers(values.is_valid())
            write_values(records, values.fill_null(zero))

    return ArchiveColumn(column.name, column.type, read, write)


class SpaceColumns:
    """The columns of the values of a space.

    Args:
        prefix: the beginning of the columns' names; the field unless given.
        given: the field that says of each name whether it has a value; else all have.
    """

    def __init__(
        self, description: Mapping[str, object], field: str, where: str, prefix: str = "", given: str = ""
    ) -> None:
        self._description = description
        self._where = where
        self._leaves = leaves_of(description, where)
        self.dtype: np.dtype[np.generic] = row_dtype(description)
        """The dtype of a value in records; a text is an object."""
        prefix = prefix or field
        parts = _parts(self._leaves)
        names = [
            "_".join([prefix, *(key.replace(".", "_") for key in leaf.path), *map(str, at or ())])
            for leaf, at in parts
        ]
        if len(set(names)) < len(names):
            names = [f"{prefix}_{number}" for number in range(1, len(names) + 1)]
        self.columns = [
            _column(name, field, given, leaf, at) for name, (leaf, at) in zip(names, parts, strict=True)
        ]
        """The columns, in order."""

    def unpack(self, value: bytes) -> Value:
        """Return an encoded value as it is assigned to a record.

        Raises:
            RecordingError: it is not a value of the space.
        """
        return _as_record(decode(self._description, value, self._where))

    def pack(self, values: Array) -> list[bytes]:
        """Return the encoded values of records."""
        parts: list[list[bytes]] = [[b""] * len(values)]
        for leaf in self._leaves:
            own = _inside(values, leaf)
            if leaf.item is not None:
                parts.append([encode_bytes(v.tobytes()) for v in own])
            else:
                parts.append([encode_text(v) if leaf.dtype is None else v.tobytes() for v in own])
        return [b"".join(pieces) for pieces in zip(*parts, strict=True)]


def _parts(leaves: Sequence[Leaf]) -> list[tuple[Leaf, tuple[int, ...] | None]]:
    """Return the leaf of each column, and its number's place in the leaf; None for all of the leaf."""
    few = sum(map(_spreadable, leaves)) <= MAX_COLUMNS
    parts: list[tuple[Leaf, tuple[int, ...] | None]] = []
    for leaf in leaves:
        if leaf.dtype is not None and (not leaf.dtype.shape or (few and _spreadable(leaf))):
            parts += [(leaf, at) for at in np.ndindex(leaf.dtype.shape)]
        elif leaf.dtype is None or leaf.dtype.itemsize:
            parts.append((leaf, None))
    return parts


def _spreadable(leaf: Leaf) -> int:
    """Return the count of numbers in a leaf, if they are few enough for a column each; else 0."""
    count = math.prod(leaf.dtype.shape) if leaf.dtype is not None else 0
    return count if count <= MAX_NUMBERS else 0


def _column(name: str, field: str, given: str, leaf: Leaf, at: tuple[int, ...] | None) -> ArchiveColumn:
    """Return the column of one number of a leaf, or of all of it."""
    if leaf.dtype is None and given:
        return _varying(name, field, given, leaf)
    if leaf.dtype is None:
        kind = pa.string()
    elif at is None:
        kind = pa.binary(leaf.dtype.itemsize)
    else:
        kind = _number(leaf.dtype.base)
    place: Any = (..., *(at or ()))

    def given_in(records: Records) -> Array | None:
        flags = records[given]
        return flags[leaf.path[0]] if leaf.path[0] in (flags.dtype.names or ()) else None

    column = stored(name, kind, lambda records: _inside(records[field], leaf)[place])
    return nullable(column, given_in) if given else column


def _number(dtype: np.dtype[np.generic]) -> pa.DataType:
    """Return the type of a column of numbers; programs that read tables take float32 for float16."""
    return pa.float32() if dtype == np.float16 else pa.from_numpy_dtype(dtype.newbyteorder("="))


def _varying(name: str, field: str, given: str, leaf: Leaf) -> ArchiveColumn:
    """Return the column of an extra of varying size: of texts, or of lists, which hold arrays row by row."""
    (key,), item = leaf.path, leaf.item
    kind = pa.string() if item is None else pa.list_(_number(item.base))

    def values_in(records: Records) -> Array | None:
        """Return a view of the values; None if the records do not have them."""
        if key not in (records.dtype[given].names or ()):
            return None
        fields = records.dtype.names or ()
        is_object = "varying" in fields and key in (records.dtype["varying"].names or ())
        return records["varying" if is_object else field][key]  # some records have arrays of one shape

    def read(records: Records) -> pa.Array:
        values = values_in(records)
        if values is None:
            return pa.nulls(len(records), kind)
        flags = records[given][key].tolist()
        if item is None:
            plain = values.tolist()
        else:
            plain = [value.ravel().astype(kind.value_type.to_pandas_dtype()) for value in values]
        return pa.array(
            [value if is_given else None for value, is_given in zip(plain, flags, strict=True)], kind
        )

    def write(records: Records, column: pa.Array) -> None:
        values = values_in(records)
        if values is None:
            return
        records[given][key] = numbers(column.is_valid())
        for k, value in enumerate(numbers(column).tolist()):
            if item is None:
                values[k] = value or ""
            elif values.dtype.hasobject or value is not None:
                flat = np.array([] if value is None else value, item.base)
                values[k] = flat.reshape(-1, *item.shape)

    return ArchiveColumn(name, kind, read, write)


def _inside(values: NDArray[Any], leaf: Leaf) -> NDArray[Any]:
    """Return the values of a leaf, a view."""
    for key in leaf.path:
        values = values[key]
    return values


def _as_record(value: Value) -> Value:
    """Return a value with tuples in place of dictionaries, as it is assigned to a record."""
    parts = value.values() if isinstance(value, Mapping) else value
    return tuple(map(_as_record, parts)) if isinstance(value, Mapping | tuple) else value


def numbers(column: pa.Array) -> Array:
    """Return a column as an array: a view where possible."""
    values: Array = column.to_numpy(zero_copy_only=False)
    return values
