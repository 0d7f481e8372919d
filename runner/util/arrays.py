"""Types of arrays that many modules handle."""

from collections.abc import Iterable, Iterator
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

Scalar = TypeVar("Scalar", bound=np.generic)
"""The element type of an array, for functions that keep it."""
Array = NDArray[np.generic]
"""An array whose element type is known only at run time, such as a column of a recording."""
Records = NDArray[np.void]
"""Structured records, such as messages of one topic."""
MaskedArray: TypeAlias = "np.ma.MaskedArray[tuple[int, ...], np.dtype[np.generic]]"
"""An `Array` with missing values; a string, as loading `numpy.ma` takes 20 ms."""
DType = np.dtype[Any]
"""A dtype that is known only at run time."""
RecordDType = np.dtype[np.void]
Ints = NDArray[np.int64]
Ints32 = NDArray[np.int32]
Unsigned = NDArray[np.uint64]
"""Log times in nanoseconds, or offsets in a file."""
Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]


def leaves(name: str, values: NDArray[Any]) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the parts of composed values, such as values of a `Dict` space, by dotted name."""
    if values.dtype.names is None:
        yield name, values
    for part in values.dtype.names or ():
        yield from leaves(f"{name}.{part}" if name else part, values[part])


def zeros(shape: tuple[int, ...], dtype: DType) -> Array:
    """Return zeros of a dtype that may have a shape of its own, also one without elements."""
    return np.zeros((*shape, *dtype.shape), dtype.base)


def in_blocks(blocks: Iterable[Records], size: int) -> Iterator[Records]:
    """Yield rows in blocks of a size; the last may be smaller."""
    waiting: list[Records] = []
    for block in blocks:
        waiting.append(block)
        if sum(map(len, waiting)) > size:
            rows = np.concatenate(waiting)
            *whole, rest = np.split(rows, range(size, len(rows), size))
            yield from whole
            waiting = [rest]
    if waiting:
        yield np.concatenate(waiting)
