"""Values of a space to columns and back: a column a number where there are few, else an array's bytes in one.

    Box(4,) float32              action_0, action_1, action_2, action_3
    Dict(at=Box(2,), image=Box(84, 84, 3))
                                 observation_at_0, observation_at_1, observation_image (bytes, row by row)
    Text                         one column of text

Columns are named by the way to the number: keys of `Dict`s, places in `Tuple`s and arrays.
"""

from __future__ import annotations

import itertools
import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from runner.recording.spaces import Leaf, encode_text, leaves_of

MOST_NUMBERS: Final = 64
"""An array of more numbers is one column of bytes."""
MOST_COLUMNS: Final = 1024
"""In a space that would have more columns, every array is one of bytes."""
_LENGTH: Final = struct.Struct("<I")


@dataclass(frozen=True)
class _LeafColumns:
    """The columns of a leaf: one a number, or one for all of it."""

    leaf: Leaf
    names: tuple[str, ...]
    spread: bool

    @property
    def base(self) -> np.dtype[Any]:
        """The dtype of one of its numbers."""
        assert self.leaf.dtype is not None
        return self.leaf.dtype.base

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of a value."""
        assert self.leaf.dtype is not None
        return self.leaf.dtype.shape

    @property
    def bytes(self) -> int:
        """The bytes of a value."""
        assert self.leaf.dtype is not None
        return self.leaf.dtype.itemsize

    @property
    def kind(self) -> pa.DataType:
        """The type of its columns; numbers of 16 bits with a point are widened, for what reads tables."""
        if self.leaf.dtype is None:
            return pa.string()
        if not self.spread:
            return pa.binary(self.bytes)
        return pa.from_numpy_dtype(_held(self.base))


class SpaceColumns:
    """The columns of the values of a space.

    Args:
        description: the space's, as the recording has it.
        prefix: what the names of its columns begin with: `action`.
        where: named in errors.

    Raises:
        RecordingError: this describes no space.
    """

    def __init__(self, description: Mapping[str, Any], prefix: str, where: str) -> None:
        self._parts = _named(leaves_of(description, where), prefix)
        self.fields: list[pa.Field] = [
            pa.field(name, part.kind) for part in self._parts for name in part.names
        ]

    def columns(self, values: NDArray[Any]) -> dict[str, Any]:
        """Return the columns of values of fixed width, [n] of the space's dtype."""
        made: dict[str, Any] = {}
        for part in self._parts:
            own = np.ascontiguousarray(_inside(values, part.leaf))
            if part.spread:
                flat = own.reshape(len(values), len(part.names)).astype(_held(part.base), copy=False)
                made |= {name: np.ascontiguousarray(flat[:, i]) for i, name in enumerate(part.names)}
            elif part.names:
                buffers = [None, pa.py_buffer(own.view(np.uint8).data)]
                made[part.names[0]] = pa.FixedSizeBinaryArray.from_buffers(part.kind, len(values), buffers)
        return made

    def fill(self, values: NDArray[Any], columns: Mapping[str, pa.Array]) -> None:
        """Fill in values of fixed width, [n], from their columns."""
        for part in self._parts:
            own = _inside(values, part.leaf)
            if part.spread:
                for at, name in zip(np.ndindex(part.shape), part.names, strict=True):
                    own[(slice(None), *at)] = columns[name].to_numpy(zero_copy_only=False)
            elif part.names:
                column = columns[part.names[0]]
                raw = np.frombuffer(column.buffers()[1], np.uint8)
                start = column.offset * part.bytes
                own[...] = (
                    raw[start : start + len(values) * part.bytes]
                    .view(part.base)
                    .reshape(len(values), *part.shape)
                )

    def row(self, value: bytes) -> dict[str, Any]:
        """Return the columns of one value as it stands in a recording.

        Raises:
            ValueError: it is no value of the space.
        """
        row: dict[str, Any] = {}
        at = 0
        for part in self._parts:
            if part.leaf.dtype is None:
                start = at + _LENGTH.size
                at = start + int.from_bytes(value[at:start], "little")
                row[part.names[0]] = value[start:at].decode()
                continue
            own, at = value[at : at + part.bytes], at + part.bytes
            if part.spread:
                row |= zip(part.names, np.frombuffer(own, part.base).tolist(), strict=True)
            elif part.names:
                row[part.names[0]] = own
        if at != len(value):
            raise ValueError(f"{len(value):,} bytes, expected {at:,}")
        return row

    def value(self, row: Mapping[str, Any]) -> bytes:
        """Return the value that `row` came from, as it stands in a recording."""
        return b"".join(self._pieces(row))

    def _pieces(self, row: Mapping[str, Any]) -> Iterator[bytes]:
        for part in self._parts:
            if part.leaf.dtype is None:
                yield encode_text(row[part.names[0]])
            elif part.spread:
                yield np.array([row[name] for name in part.names], part.base).tobytes()
            elif part.names:
                yield row[part.names[0]]


def _named(leaves: Sequence[Leaf], prefix: str) -> list[_LeafColumns]:
    """Return the columns of the leaves; they are numbered where their names would not differ."""
    few = sum(map(_numbers, leaves)) <= MOST_COLUMNS
    made = []
    for leaf in leaves:
        spread = leaf.dtype is not None and (not leaf.dtype.shape or (few and bool(_numbers(leaf))))
        made.append(_LeafColumns(leaf, tuple(_names(leaf, prefix, spread)), spread))
    known = [name for part in made for name in part.names]
    if len(set(known)) == len(known):
        return made
    numbered = (f"{prefix}_{number}" for number in itertools.count(1))
    return [
        _LeafColumns(part.leaf, tuple(itertools.islice(numbered, len(part.names))), part.spread)
        for part in made
    ]


def _names(leaf: Leaf, prefix: str, spread: bool) -> Iterator[str]:
    name = "_".join([prefix, *(key.replace(".", "_") for key in leaf.path)])
    if spread:
        assert leaf.dtype is not None
        yield from ("_".join([name, *map(str, at)]) for at in np.ndindex(leaf.dtype.shape))
    elif leaf.dtype is None or leaf.dtype.itemsize:
        yield name


def _numbers(leaf: Leaf) -> int:
    """Return how many numbers a leaf has, if they are few enough for a column each; else 0."""
    count = math.prod(leaf.dtype.shape) if leaf.dtype is not None else 0
    return count if count <= MOST_NUMBERS else 0


def _inside(values: NDArray[Any], leaf: Leaf) -> NDArray[Any]:
    for name in leaf.path:
        values = values[name]
    return values


def _held(base: np.dtype[Any]) -> np.dtype[Any]:
    """Return the dtype of a column of these numbers."""
    return np.dtype("<f4") if base == np.dtype("<f2") else base.newbyteorder("=")
