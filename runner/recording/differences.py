"""The first row in which recorded values differ from those that were made again."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.util.arrays import Array, Records

_COMPARED_BYTES: Final = 1 << 16


def first_difference(
    recorded: Records, got: Records, names: Iterable[str], tolerance: float | None = None
) -> tuple[int, str] | None:
    """Return the first row in which fields of records differ, and the first of the fields; None if none does.

    Args:
        tolerance: absolute and relative, for floating-point numbers; None compares bytes.
    """
    rows = ((first_differing_row(recorded[name], got[name], tolerance), name) for name in names)
    return min(((row, name) for row, name in rows if row is not None), key=lambda at: at[0], default=None)


def first_differing_row(recorded: Array, got: Array, tolerance: float | None = None) -> int | None:
    """Return the number of the first row that differs; None if none does.

    Args:
        recorded: a column of records, [rows, ...].
        tolerance: as for `first_difference`.
    """
    n = len(recorded)
    if recorded.dtype == object:
        different = (k for k in range(n) if recorded[k] != got[k])
        return next(different, None)
    # Bytes are copied to be compared: few at a time stay in the processor's caches.
    rows = max(_COMPARED_BYTES * n // max(got.nbytes, 1), 1)
    for start in range(0, n, rows):
        left, right = recorded[start : start + rows], got[start : start + rows]
        if left.tobytes() == right.tobytes():
            continue
        if tolerance is not None:
            differs = _beyond(left, right, tolerance)
        else:
            a, b = (
                np.ascontiguousarray(each).view(np.uint8).reshape(len(left), -1) for each in (left, right)
            )
            differs = (a != b).any(axis=1)
        if differs.any():
            return start + int(np.argmax(differs))
    return None


def _beyond(recorded: NDArray[Any], got: NDArray[Any], tolerance: float) -> NDArray[np.bool_]:
    if recorded.dtype.names:
        parts = [_beyond(recorded[name], got[name], tolerance) for name in recorded.dtype.names]
        return np.asarray(np.logical_or.reduce(parts))
    if recorded.dtype.kind == "f":
        same = np.isclose(got, recorded, rtol=tolerance, atol=tolerance, equal_nan=True)
    else:
        same = recorded == got
    return np.asarray(~same.reshape(len(recorded), -1).all(axis=1))
