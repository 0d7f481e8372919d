"""How values of a space stand in a recording: as raw bytes, laid out as the space's description says.

A description is JSON that anyone can read, kept in the metadata record `run`:

    {"type": "Dict", "spaces": {
        "position": {"type": "Box", "dtype": "<f4", "shape": [3], "low": -1.0, "high": 1.0},
        "mission": {"type": "Text", "max_length": 40}}}

The leaves follow one another in its order, without gaps: an array row by row, little-endian, in the
space's own dtype; a text as its length in bytes (uint32) and UTF-8. Where no leaf is a text, every value
has one size, and many of them are one NumPy array.

Extras have another kind of leaf: `{"type": "Array", "dtype": "<i8", "shape": [null, 4]}`, an array whose
first axis varies in length. It stands there as its length in bytes (uint32), and row by row.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from runner.errors import RecordingError
from runner.util.arrays import DType
from runner.util.values import is_text, is_whole

MAX_VALUE_BYTES: Final = 16 << 20
"""The most that one value of a space of fixed width may take."""
_MAX_DEPTH: Final = 16
_MAX_PARTS: Final = 4096
RECORDED_DTYPE: Final = re.compile(r"(?:\|[biu]1|<[iu][248]|<f[248])")
"""Matches the names of the dtypes that numbers have in a recording."""
_LENGTH: Final = struct.Struct("<I")

Description = Mapping[str, Any]
"""A space as JSON."""
Value = Any
"""An observation or action: whatever its space holds."""


@dataclass(frozen=True)
class Leaf:
    """A part of a space without parts of its own: its path, and the dtype of its values."""

    path: tuple[str, ...]
    """Keys of `Dict`s and numbers of `Tuple`s, from the outermost in."""
    dtype: DType | None
    """The dtype of its value, including the shape; None where values vary in size."""
    item: DType | None = None
    """The dtype of an element along the first axis, of arrays of varying length; else None."""


def leaves_of(description: object, where: str) -> list[Leaf]:
    """Return the leaves of a space in order.

    Raises:
        RecordingError: this describes no space; `where` is named.
    """
    try:
        leaves = list(_leaves(description, ()))
        if (parts := _count(description)) > _MAX_PARTS:
            raise ValueError(f"{parts:,} parts, expected {_MAX_PARTS:,} at most")
        size = sum(leaf.dtype.itemsize for leaf in leaves if leaf.dtype is not None)
        if size > MAX_VALUE_BYTES:
            raise ValueError(f"{size:,} bytes a value, expected {MAX_VALUE_BYTES:,} at most")
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise RecordingError(f"{where}: describes no space that can be recorded ({error}).") from error
    return leaves


def row_dtype(description: Description) -> DType:
    """Return the dtype of a space's values in records, `Dict` and `Tuple` as fields.

    Values of varying size are objects.
    """
    parts = parts_of(description)
    if parts is None:
        leaf = leaf_dtype(description)
        return np.dtype(object) if leaf is None else leaf
    return np.dtype([(name, row_dtype(part)) for name, part in parts])


def least_number(description: Mapping[str, object]) -> int:
    """Return the least number of a `Discrete` space; 0 if its description states no valid one."""
    start = description.get("start")
    return start if is_whole(start, -(2**62), 2**62) else 0


def decode(description: Description, data: bytes, where: str) -> Value:
    """Return the value that stands in these bytes: dictionaries, tuples, texts and arrays.

    Raises:
        RecordingError: it is no value of the space; `where` is named.
    """
    try:
        value, end = _value(description, data, 0)
    except (struct.error, ValueError) as error:
        raise RecordingError(f"{where}: found no value of its space ({error}).") from error
    if end != len(data):
        raise RecordingError(f"{where}: found {len(data)} bytes, expected {end} for a value of its space.")
    return value


def encode_text(text: str) -> bytes:
    """Return a text as it stands in a recording."""
    return encode_bytes(text.encode("utf-8", "surrogatepass"))


def encode_bytes(data: bytes) -> bytes:
    """Return a text in UTF-8, or an array of varying length as its bytes, as it stands in a recording."""
    return _LENGTH.pack(len(data)) + data


def parts_of(description: Description) -> list[tuple[str, Description]] | None:
    """Return the parts of a `Dict` or `Tuple` by name; None for a leaf."""
    kind = description["type"]
    if kind == "Dict":
        return list(description["spaces"].items())
    if kind == "Tuple":
        return [(str(i), part) for i, part in enumerate(description["spaces"])]
    return None


def _leaves(description: object, path: tuple[str, ...]) -> Iterator[Leaf]:
    if not isinstance(description, Mapping) or len(path) > _MAX_DEPTH:
        raise ValueError("found no object that describes a space, or too many inside one another")
    parts = parts_of(description)
    if parts is None:
        yield Leaf(path, leaf_dtype(description), item_dtype(description))
        return
    for name, part in parts:
        if not is_text(name) or not name:
            raise ValueError(f"a part is called {name!r}")
        yield from _leaves(part, (*path, name))


def _count(description: Any) -> int:
    """Return how many parts a space has, with the parts that have parts themselves."""
    parts = parts_of(description)
    return 1 if parts is None else len(parts) + sum(_count(part) for _, part in parts if parts_of(part))


def leaf_dtype(description: Mapping[str, object]) -> DType | None:
    """Return the dtype of a leaf; None where values vary in size: texts, and arrays of varying length."""
    is_one_size = description["type"] not in ("Text", "Array")
    return _array_dtype(description, description["shape"]) if is_one_size else None


def item_dtype(description: Mapping[str, object]) -> DType | None:
    """Return the dtype of an element of arrays of varying length; None for other leaves."""
    if description["type"] != "Array":
        return None
    shape = description["shape"]
    if not isinstance(shape, list) or shape[:1] != [None] or 0 in shape:
        raise ValueError(f"shape {shape}")
    return _array_dtype(description, shape[1:])


def _array_dtype(description: Mapping[str, object], shape: object) -> DType:
    kind, dtype = description["type"], description["dtype"]
    if not isinstance(kind, str) or not isinstance(dtype, str) or not RECORDED_DTYPE.fullmatch(dtype):
        raise ValueError(f"{kind} of {dtype}")
    if not isinstance(shape, list) or not all(is_whole(n, 0, MAX_VALUE_BYTES) for n in shape):
        raise ValueError(f"shape {shape}")
    if len(shape) > 32 or math.prod(shape) > MAX_VALUE_BYTES:
        raise ValueError(f"shape {shape}")
    return np.dtype((dtype, tuple(shape)))


def _value(description: Description, data: bytes, at: int) -> tuple[Value, int]:
    """Return the value at an offset, and the offset behind it."""
    parts = parts_of(description)
    if parts is not None:
        values = {}
        for name, part in parts:
            values[name], at = _value(part, data, at)
        return (values if description["type"] == "Dict" else tuple(values.values())), at
    dtype = leaf_dtype(description)
    if dtype is None:
        (length,) = _LENGTH.unpack_from(data, at)
        start = at + _LENGTH.size
        at += _LENGTH.size + length
        if at > len(data):
            raise ValueError(f"a value of {length:,} bytes in {len(data):,}")
        item = item_dtype(description)
        if item is None:
            return data[start:at].decode("utf-8", "surrogatepass"), at
        return np.frombuffer(data[start:at], item), at
    if at + dtype.itemsize > len(data):
        raise ValueError(f"{len(data):,} bytes, too few")
    flat = np.frombuffer(data, dtype.base, math.prod(dtype.shape), at)
    return (flat.reshape(dtype.shape) if dtype.shape else flat[0]), at + dtype.itemsize
