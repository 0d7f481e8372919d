"""The rows in which two arrays differ, in bits or beyond a tolerance; the values in which two mappings do."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.util.arrays import Array, Flags, Records
from runner.util.jsonable import as_json
from runner.util.values import flatten

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
    # Bytes are copied to be compared: few at a time stay in the processor's caches.
    rows = max(_COMPARED_BYTES * n // max(got.nbytes, 1), 1)
    for start in range(0, n, rows):
        left, right = recorded[start : start + rows], got[start : start + rows]
        if left.tobytes() == right.tobytes():
            continue
        if (differs := differing_rows(left, right, tolerance)).any():
            return start + int(np.argmax(differs))
    return None


def differing_rows(a: NDArray[Any], b: NDArray[Any], tolerance: float | None = None) -> Flags:
    """Return which rows of two columns, [rows, ...], differ; arguments as for `first_difference`."""
    if tolerance is None:
        differs = _bits(a) != _bits(b)
    elif a.dtype.names:
        parts = [differing_rows(a[name], b[name], tolerance) for name in a.dtype.names]
        differs = np.logical_or.reduce(parts)
    elif a.dtype.kind == "f":
        differs = ~np.isclose(b, a, rtol=tolerance, atol=tolerance, equal_nan=True)
    else:
        differs = a != b
    rows: Flags = np.asarray(differs).reshape(len(a), np.size(differs) // max(len(a), 1))
    return np.asarray(rows.any(axis=1))


def _bits(values: Array) -> Array:
    """Return values other than whole numbers and objects as whole numbers of the same bits."""
    kind, size = values.dtype.kind, values.dtype.itemsize
    if kind not in "bfV":
        return values
    return np.ascontiguousarray(values).view(f"u{size}" if kind == "f" and size in (2, 4, 8) else "u1")


def differing_part(recorded: object, got: object, tolerance: float | None) -> tuple[str, object, object]:
    """Return where in two values of a space the first difference is, such as `[2]`, and both values there.

    Args:
        recorded: an array, a record, or a mapping or tuple of such values.
        got: another value with the same parts.
        tolerance: as for `first_difference`.
    """
    for path, left, right in _leaves("", recorded, got):
        if left.shape != right.shape or left.dtype != right.dtype:
            return path, _plain(left), _plain(right)
        first = first_differing_row(left.reshape(-1), right.reshape(-1), tolerance)
        if first is not None:
            at = np.unravel_index(first, left.shape)
            index = f"[{', '.join(map(str, at))}]" if at else ""
            return path + index, _plain(left[at]), _plain(right[at])
    return "", _plain(recorded), _plain(got)


def _leaves(path: str, recorded: Any, got: Any) -> Iterator[tuple[str, Array, Array]]:
    """Yield the arrays in two values of a space, with their paths."""
    names: Any = getattr(getattr(recorded, "dtype", None), "names", None)
    if names or isinstance(recorded, dict):
        for name in names or recorded:
            yield from _leaves(f"{path}[{name!r}]", recorded[name], got[name])
    elif isinstance(recorded, tuple):
        for i, (left, right) in enumerate(zip(recorded, got, strict=True)):
            yield from _leaves(f"{path}[{i}]", left, right)
    else:
        yield path, np.asarray(recorded), np.asarray(got)


def _plain(value: object) -> object:
    return as_json(value.item() if isinstance(value, np.ndarray | np.generic) and not value.shape else value)


@dataclass(frozen=True)
class Change:
    """A value by its path, in both runs; None where one has none."""

    path: str
    a: object
    b: object


def changes_in(a: Mapping[str, object], b: Mapping[str, object]) -> list[Change]:
    """Return the differences of two nested mappings, by dotted path."""
    left, right = flatten(a, keep_empty=True), flatten(b, keep_empty=True)
    paths = dict.fromkeys([*left, *right])

    def filled(path: str) -> bool:
        """Return whether a mapping is empty in one, and the other's entries in it are listed anyway."""
        return {} in (left.get(path), right.get(path)) and any(p.startswith(f"{path}.") for p in paths)

    return [
        Change(path, left.get(path), right.get(path))
        for path in paths
        if ((path in left) != (path in right) or left.get(path) != right.get(path)) and not filled(path)
    ]


def equal_values(a: Mapping[str, object], b: Mapping[str, object]) -> dict[str, object]:
    """Return the values that two nested mappings share, by dotted path."""
    left, right = flatten(a, keep_empty=True), flatten(b, keep_empty=True)
    return {path: value for path, value in left.items() if path in right and right[path] == value}
