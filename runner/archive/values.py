"""Values of a space as columns: one for each number if there are few, else one with the bytes of the array.

    Box(4,) float32              action_0, action_1, action_2, action_3
    Dict(at=Box(2,), image=Box(84, 84, 3))
                                 observation_at_0, observation_at_1, observation_image (bytes, row by row)
    Text                         one column of text

Names are the path to the number: keys of `Dict`s, positions in `Tuple`s and arrays.
"""

from __future__ import annotations

import itertools
import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import pyarrow as pa

from runner.archive.layout import Column, Records
from runner.recording.spaces import Leaf, encode_text, leaves_of
from runner.util.arrays import Array
from runner.util.values import Json, JsonView

MAX_NUMBERS: Final = 64
"""An array with more numbers is one column of bytes."""
MAX_COLUMNS: Final = 1024
"""In a space with more columns than this, every array is one column of bytes."""
_LENGTH: Final = struct.Struct("<I")


@dataclass(frozen=True)
class _LeafColumns:
    """The columns of a leaf: one for each number, or one for all of it."""

    leaf: Leaf
    names: tuple[str, ...]
    is_spread: bool

    @property
    def dtype(self) -> np.dtype[np.generic]:
        """The dtype of a value."""
        assert self.leaf.dtype is not None
        return self.leaf.dtype

    def columns(self, field: str) -> Iterator[Column]:
        """Yield the columns; they are read from a field of records."""
        if self.leaf.dtype is None:
            yield from (Column(name, pa.string(), _not_fixed) for name in self.names)
        elif self.is_spread:
            places = np.ndindex(self.dtype.shape)
            yield from (self._number(field, name, at) for name, at in zip(self.names, places, strict=True))
        else:
            yield from (self._bytes(field, name) for name in self.names)

    def _number(self, field: str, name: str, at: tuple[int, ...]) -> Column:
        base = self.dtype.base
        index: tuple[slice | int, ...] = (slice(None), *at)
        # 16-bit floats are widened for programs that read tables
        held = np.dtype("<f4") if base == np.dtype("<f2") else base.newbyteorder("=")

        def read(records: Records) -> Array:
            return np.ascontiguousarray(self._inside(records[field])[index].astype(held, copy=False))

        def write(records: Records, column: pa.Array) -> None:
            self._inside(records[field])[index] = numbers(column)

        return Column(name, pa.from_numpy_dtype(held), read, write)

    def _bytes(self, field: str, name: str) -> Column:
        size = self.dtype.itemsize
        kind = pa.binary(size)

        def read(records: Records) -> pa.Array:
            own = np.ascontiguousarray(self._inside(records[field]))
            buffers = [None, pa.py_buffer(own.view(np.uint8).data)]
            return pa.FixedSizeBinaryArray.from_buffers(kind, len(records), buffers)

        def write(records: Records, column: pa.Array) -> None:
            raw = np.frombuffer(column.buffers()[1], np.uint8)[column.offset * size :][: len(records) * size]
            self._inside(records[field])[...] = raw.view(self.dtype.base).reshape(-1, *self.dtype.shape)

        return Column(name, kind, read, write)

    def _inside(self, values: Records) -> Array:
        for name in self.leaf.path:
            values = values[name]
        return values


class SpaceColumns:
    """The columns of the values of a space.

    Args:
        prefix: the beginning of the columns' names; the field unless given.
    """

    def __init__(
        self, description: Mapping[str, object], field: str, where: str, prefix: str | None = None
    ) -> None:
        self._leaves = _named(leaves_of(description, where), prefix or field)
        self.columns_by_leaf: list[tuple[Leaf, list[Column]]] = [
            (part.leaf, list(part.columns(field))) for part in self._leaves
        ]
        self.columns: list[Column] = [column for _, own in self.columns_by_leaf for column in own]

    def row(self, value: bytes) -> Json:
        """Return the columns of one encoded value.

        Raises:
            ValueError: it is not a value of the space.
        """
        row: Json = {}
        at = 0
        for part in self._leaves:
            if part.leaf.dtype is None:
                start = at + _LENGTH.size
                at = start + int.from_bytes(value[at:start], "little")
                row[part.names[0]] = value[start:at].decode()
                continue
            own, at = value[at : at + part.dtype.itemsize], at + part.dtype.itemsize
            if part.is_spread:
                row |= zip(part.names, np.frombuffer(own, part.dtype.base).tolist(), strict=True)
            elif part.names:
                row[part.names[0]] = own
        if at != len(value):
            raise ValueError(f"{len(value):,} bytes, expected {at:,}")
        return row

    def value(self, row: JsonView) -> bytes:
        """Return the encoded value of a row of columns."""
        pieces = []
        for part in self._leaves:
            if part.leaf.dtype is None:
                pieces.append(encode_text(row[part.names[0]]))
            elif part.is_spread:
                pieces.append(np.array([row[name] for name in part.names], part.dtype.base).tobytes())
            elif part.names:
                pieces.append(row[part.names[0]])
        return b"".join(pieces)


def _named(leaves: Sequence[Leaf], prefix: str) -> list[_LeafColumns]:
    """Return the columns of the leaves, numbered if their names would not be unique."""
    few = sum(map(_spreadable, leaves)) <= MAX_COLUMNS
    made = []
    for leaf in leaves:
        spread = leaf.dtype is not None and (not leaf.dtype.shape or (few and bool(_spreadable(leaf))))
        made.append(_LeafColumns(leaf, tuple(_names(leaf, prefix, spread)), spread))
    names = [name for part in made for name in part.names]
    if len(set(names)) == len(names):
        return made
    numbered = (f"{prefix}_{number}" for number in itertools.count(1))
    return [replace(part, names=tuple(itertools.islice(numbered, len(part.names)))) for part in made]


def _names(leaf: Leaf, prefix: str, spread: bool) -> Iterator[str]:
    name = "_".join([prefix, *(key.replace(".", "_") for key in leaf.path)])
    if spread:
        assert leaf.dtype is not None
        yield from ("_".join([name, *map(str, at)]) for at in np.ndindex(leaf.dtype.shape))
    elif leaf.dtype is None or leaf.dtype.itemsize:
        yield name


def _spreadable(leaf: Leaf) -> int:
    """Return the count of numbers in a leaf, if they are few enough for a column each; else 0."""
    count = math.prod(leaf.dtype.shape) if leaf.dtype is not None else 0
    return count if count <= MAX_NUMBERS else 0


def _not_fixed(records: Records) -> object:
    raise TypeError(f"a text is not of fixed width: {records.dtype}")


def numbers(column: pa.Array) -> Array:
    """Return a column as an array: a view where possible."""
    values: Array = column.to_numpy(zero_copy_only=False)
    return values
