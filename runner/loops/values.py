"""Values of spaces on their way into a recording: checked for shape and for rounding."""

from __future__ import annotations

import math
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.loops.spaces import Part
from runner.recording.spaces import MAX_VALUE_BYTES, encode_text

_HERE: Final = str(Path(__file__).parent)
_SCALARS: Final = (np.bool_, *(np.dtype(code).type for code in "bBhHiIlLqQefd"))


class Leaf:
    """One part of a space, with the checks that its values pass before they are recorded.

    Args:
        part: where the part is in a value, and its dtype.
        what: `observation` or `action`. An action may have another shape with as many numbers, because
            only the environment knows which shapes it takes.
    """

    def __init__(self, part: Part, what: str) -> None:
        self.part = part
        self.keys = part.keys
        self.name = what + "".join(f"[{key!r}]" for key in part.keys)
        self.text = part.text
        self._is_action = what == "action"
        if part.dtype is None:
            return
        self.base = np.dtype(part.dtype.base.str)
        self.shape = part.dtype.shape
        scalars = {kind for kind in _SCALARS if np.can_cast(kind, self.base)}
        scalars |= {bool} | ({int} if self.base.kind in "iu" else {float} if self.base.char == "d" else set())
        self.exact_scalars = frozenset(() if self.shape else scalars)
        """Classes of which every value is recorded exactly, or refused by NumPy."""
        self._is_rounded = False

    def fit(self, value: Any, batch: tuple[int, ...] = ()) -> NDArray[Any]:
        """Return a value as an array that can be recorded; warn the first time that one is rounded.

        Args:
            value: of this part alone.
            batch: the shape of the batch that it is, if it is one.

        Raises:
            RecordingError: it has another shape, holds no numbers, or numbers out of the dtype's range.
        """
        found = np.asarray(value)
        if found.dtype.kind not in "biuf":
            raise self.refused(f"found {found.dtype}, expected {self.base}")
        if found.shape != batch + self.shape:
            if not self._is_action or found.size != math.prod(batch + self.shape):
                raise RecordingError(
                    f"found {self.name} of shape {found.shape}, expected {batch + self.shape} by its space."
                )
            found = found.reshape(batch + self.shape)
        if found.dtype is self.base or np.can_cast(found.dtype, self.base):
            return found
        with np.errstate(all="ignore"):
            kept = found.astype(self.base)
        if not np.array_equal(kept, found, equal_nan=found.dtype.kind == "f"):
            self._check_range(found)
            if not self._is_rounded:
                self._is_rounded = True
                warn_user(
                    f"{self.name} comes as {found.dtype} and is recorded, rounded, as the {self.base} of its "
                    "space. This is warned of once."
                )
        return kept

    def _check_range(self, found: NDArray[Any]) -> None:
        """Refuse numbers that an integer dtype cannot hold at all."""
        if self.base.kind not in "iu":
            return
        limits = np.iinfo(self.base)
        if not ((found >= limits.min) & (found <= limits.max)).all():
            raise self.refused(f"{self.base} holds {limits.min} to {limits.max}")

    def refused(self, reason: object) -> RecordingError:
        """Return the error for a value that is not of the space."""
        what = "action" if self._is_action else "observation"
        return RecordingError(f"found an {what} that is not of the environment's {what} space ({reason}).")


def leaves(parts: Sequence[Part], what: str) -> list[Leaf]:
    """Return the leaves for the parts of a space; `what` is `observation` or `action`."""
    return [Leaf(part, what) for part in parts]


def filler(
    own: Sequence[Leaf], column: NDArray[Any], batch: tuple[int, ...] = ()
) -> Callable[[int, Any], None]:
    """Return a function that puts a value of a space into a row of a column.

    Args:
        own: the leaves of the space.
        column: [rows, *batch] values of the space.
        batch: the shape of the batch that each value is, if it is one.

    Raises:
        RecordingError: (from the returned function) a value is not of its space.
    """
    if len(own) == 1 and not own[0].keys:
        return _single_filler(own[0], column, batch)
    fillers = [(leaf, _single_filler(leaf, _within(column, leaf.part), batch)) for leaf in own]

    def put(row: int, value: Any) -> None:
        for leaf, put_leaf in fillers:
            inside = value
            try:
                for key in leaf.keys:
                    inside = inside[key]
            except (TypeError, LookupError) as error:
                raise leaf.refused(error) from error
            put_leaf(row, inside)

    return put


def _single_filler(leaf: Leaf, column: NDArray[Any], batch: tuple[int, ...]) -> Callable[[int, Any], None]:
    base, shape, array = leaf.base, batch + leaf.shape, np.ndarray
    scalars = frozenset() if batch else leaf.exact_scalars

    def put(row: int, value: Any) -> None:
        kind = value.__class__
        try:
            if kind is array:  # the usual case costs two comparisons
                if value.dtype is not base or value.shape != shape:
                    value = leaf.fit(value, batch)
            elif kind not in scalars:
                value = leaf.fit(value, batch)
            column[row] = value
        except (TypeError, ValueError, OverflowError) as error:
            raise leaf.refused(error) from error

    return put


def _within(column: NDArray[Any], part: Part) -> NDArray[Any]:
    for name in part.fields:
        column = column[name]
    return column


def value_bytes(own: Sequence[Leaf], value: Any) -> bytes:
    """Return a value of a space as the bytes that a recording holds.

    Raises:
        RecordingError: it is not of the space, or too large.
    """
    pieces = []
    for leaf in own:
        try:
            inside = leaf.part.of(value)
            if leaf.text is not None:
                pieces.append(encode_text(leaf.text(inside)))
            else:
                pieces.append(np.asarray(leaf.fit(inside), leaf.base, order="C").tobytes())
        except (TypeError, ValueError, LookupError, AttributeError, OverflowError, RecursionError) as error:
            raise leaf.refused(error) from error
    if (size := sum(map(len, pieces))) > MAX_VALUE_BYTES:
        raise own[0].refused(f"it takes {size:,} bytes, expected at most {MAX_VALUE_BYTES:,}")
    return b"".join(pieces)


def put_batch(own: Sequence[Leaf], value: Any, into: NDArray[Any], batch: tuple[int, ...] = ()) -> None:
    """Put batched values of a space into a column, all rows at once.

    Args:
        own: the leaves of the space.
        value: batched, as a vector environment has it; a single value for an empty batch.
        into: the column.
        batch: the shape of the batch.

    Raises:
        RecordingError: they are not of the space.
    """
    for leaf in own:
        try:
            inside = leaf.part.of(value)
            if inside.__class__ is not np.ndarray or (
                inside.dtype is not leaf.base or inside.shape != batch + leaf.shape
            ):
                inside = leaf.fit(inside, batch)
            _within(into, leaf.part)[...] = inside
        except (TypeError, ValueError, LookupError, OverflowError) as error:
            raise leaf.refused(error) from error


def put_chosen(own: Sequence[Leaf], values: Any, into: NDArray[Any], which: NDArray[np.intp]) -> None:
    """Put values of single environments into their rows, as a vector's info holds them.

    Raises:
        RecordingError: they are not of the space.
    """
    for i in which.tolist():
        put_batch(own, _picked(values, i), into[i : i + 1])


def _picked(values: Any, i: int) -> Any:
    """Return the value of one environment out of a mapping of batches."""
    if isinstance(values, Mapping):
        return {key: _picked(part, i) for key, part in values.items() if not str(key).startswith("_")}
    if isinstance(values, tuple):
        return tuple(_picked(part, i) for part in values)
    return values[i]


def lone_number(value: Any, what: str) -> float:
    """Return a number that may stand in an array of one.

    Raises:
        RecordingError: it is none.
    """
    return float(_lone(value, what, "iubf", "a number"))


def whole_number(value: Any, what: str) -> int:
    """Return a whole number that may stand in an array of one.

    Raises:
        RecordingError: it is none.
    """
    return int(_lone(value, what, "iub", "a whole number of its Discrete space"))


def _lone(value: Any, what: str, kinds: str, expected: str) -> Any:
    array = np.asarray(value)
    if array.size != 1 or array.dtype.kind not in kinds:
        raise RecordingError(f"found the {what} {value!r}, expected {expected}.")
    return array.reshape(())


def require_reset(resets: int, phase: str) -> None:
    """Refuse the first step of a phase that has no reset: the state before it would be unknown.

    Raises:
        ResetNeeded: `resets` is zero.
    """
    if not resets:
        raise ResetNeeded(
            f"phase {phase!r}: the recording has seen no reset of this environment yet: call reset() first"
        )


def warn_user(message: str) -> None:
    """Warn of something in the user's loop, at the line of the loop and not in this package."""
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_HERE):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, RuntimeWarning, stacklevel=level)
