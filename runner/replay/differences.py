"""Recorded steps compared with what an environment returned when they were rerun."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.errors import shortened
from runner.recording.spaces import Description, Value, decode
from runner.util.arrays import Array
from runner.util.jsonable import as_json

_MAX_TEXT: Final = 200
_COMPARED_BYTES: Final = 1 << 16


@dataclass(frozen=True)
class Difference:
    """The first value in which an environment differs from a recording."""

    phase: str
    """`train` or `eval`."""
    episode: int | None
    """The number of the episode; None if it never ended, in one of several environments."""
    t: int
    """The step of the episode, from 0."""
    step: int
    """The step of the phase, from 0."""
    environment: int
    """Which environment of a vector."""
    field: str
    """`observation[2]`, `reward`, `terminated`, ...; `first observation[2]` for that of a reset."""
    recorded: object
    """The value, as JSON can hold it."""
    got: object

    def __str__(self) -> str:
        """Describe the difference in a line."""
        episode = f"episode {self.episode:,}" if self.episode is not None else f"step {self.step:,}"
        return (
            f"{self.phase} {episode}, t {self.t:,}: {self.field}: recorded {_short(self.recorded)}, "
            f"got {_short(self.got)}"
        )


def first_differing_row(recorded: Array, got: Array, tolerance: float) -> int | None:
    """Return the number of the first row that differs; None if none does.

    Args:
        recorded: a column of records, [rows, ...].
        tolerance: absolute and relative, for floating-point numbers; 0 compares bytes.
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
        if tolerance:
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


def differing_value(
    recorded: Value, got: Value, description: Description, tolerance: float = 0.0
) -> tuple[str, object, object]:
    """Return where in two observations the first difference is, such as `[2]`, and both values there.

    Args:
        recorded: a NumPy value of a space, or its bytes.
    """
    if isinstance(recorded, bytes):
        recorded, got = (decode(description, each, "an observation") for each in (recorded, got))
    for place, left, right in _leaves("", recorded, got):
        if left.shape != right.shape or left.dtype != right.dtype:
            return place, _plain(left), _plain(right)
        first = first_differing_row(left.reshape(-1), right.reshape(-1), tolerance)
        if first is not None:
            at = np.unravel_index(first, left.shape)
            index = f"[{', '.join(map(str, at))}]" if at else ""
            return place + index, _plain(left[at]), _plain(right[at])
    return "", _plain(recorded), _plain(got)


def _leaves(place: str, recorded: Value, got: Value) -> Iterator[tuple[str, Array, Array]]:
    """Yield the arrays in two values of a space, with their places."""
    names: Any = getattr(getattr(recorded, "dtype", None), "names", None)
    if names or isinstance(recorded, dict):
        for name in names or recorded:
            yield from _leaves(f"{place}[{name!r}]", recorded[name], got[name])
    elif isinstance(recorded, tuple):
        for i, (left, right) in enumerate(zip(recorded, got, strict=True)):
            yield from _leaves(f"{place}[{i}]", left, right)
    else:
        yield place, np.asarray(recorded), np.asarray(got)


def _plain(value: object) -> object:
    return as_json(value.item() if isinstance(value, np.ndarray | np.generic) and not value.shape else value)


def _short(value: object) -> str:
    text = repr(value) if isinstance(value, str) else str(value)
    return shortened(text, _MAX_TEXT)
