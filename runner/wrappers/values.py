"""Values of spaces, put where they are written from; what is not of its space is refused."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.recording.spaces import encode_text
from runner.wrappers.described import Part


def filler(parts: Sequence[Part], column: NDArray[Any], what: str) -> Callable[[int, Any], None]:
    """Return what puts a value of a space into a row of a column.

    Raises:
        RecordingError: (what is returned) a value is not of its space.
    """
    if not parts:
        return lambda _row, _value: None
    columns = [(part.keys, _within(column, part)) for part in parts]

    def put_one(row: int, value: Any) -> None:
        try:
            only[row] = value
        except (TypeError, ValueError, OverflowError) as error:
            raise _no_value(what, error) from error

    def put(row: int, value: Any) -> None:
        try:
            for keys, own in columns:
                inside = value
                for key in keys:
                    inside = inside[key]
                own[row] = inside
        except (TypeError, ValueError, LookupError, OverflowError) as error:
            raise _no_value(what, error) from error

    if len(columns) == 1 and not columns[0][0]:
        only = columns[0][1]
        return put_one
    return put


def _within(column: NDArray[Any], part: Part) -> NDArray[Any]:
    for name in part.fields:
        column = column[name]
    return column


def _no_value(what: str, error: Exception) -> RecordingError:
    return RecordingError(f"found an {what} that is not of the environment's {what} space ({error}).")


def check_value(parts: Sequence[Part], value: Any, what: str = "observation", level: int = 6) -> None:
    """Refuse a value of another shape; warn of numbers that the space's dtype cannot hold exactly.

    Args:
        parts: of its space.
        value: the value.
        what: `observation`, or `action`, of which the environment alone knows what shape it takes.
        level: of the warning: how many calls away the loop is.

    Raises:
        RecordingError: it is one.
    """
    for part in parts:
        try:
            inside = part.of(value)
        except (TypeError, LookupError) as error:
            raise _no_value(what, error) from error
        if part.dtype is None:
            continue
        found, expected = np.asarray(inside), part.dtype
        name = "".join(f"[{key!r}]" for key in part.keys)
        if found.dtype.kind not in "biuf" or (what == "action" and found.shape != expected.shape):
            continue
        if found.shape != expected.shape:
            raise RecordingError(
                f"found {what}{name} of shape {found.shape}, expected {expected.shape} by its space."
            )
        with np.errstate(all="ignore"):
            kept = found.astype(expected.base)
        if not np.array_equal(kept, found, equal_nan=found.dtype.kind == "f"):
            warnings.warn(
                f"{what}{name} comes as {found.dtype} and is recorded, rounded, as the {expected.base} "
                "of its space",
                RuntimeWarning,
                stacklevel=level,
            )


def value_bytes(parts: Sequence[Part], value: Any) -> bytes:
    """Return a value of a space as it stands in a recording.

    Raises:
        RecordingError: it is not of the space.
    """
    pieces = []
    try:
        for part in parts:
            inside = part.of(value)
            if part.dtype is None:
                pieces.append(encode_text(inside))
            else:
                array = np.empty(part.dtype.shape, part.dtype.base)
                array[...] = inside
                pieces.append(array.tobytes())
    except (TypeError, ValueError, LookupError, AttributeError, OverflowError) as error:
        raise _no_value("observation or action", error) from error
    return b"".join(pieces)


def put_batch(parts: Sequence[Part], value: Any, into: NDArray[Any], what: str) -> None:
    """Put batched values of a space into a column, all rows at once.

    Raises:
        RecordingError: they are not of the space.
    """
    try:
        for part in parts:
            _within(into, part)[...] = part.of(value)
    except (TypeError, ValueError, LookupError, OverflowError) as error:
        raise RecordingError(f"found {what} that is not of its space ({error}).") from error


def put_chosen(parts: Sequence[Part], values: Any, into: NDArray[Any], which: NDArray[np.intp]) -> None:
    """Put values of single environments into their rows, as a vector's info holds them.

    Raises:
        RecordingError: they are not of the space.
    """
    for i in which.tolist():
        own = _picked(values, i)
        check_value(parts, own)
        put_batch(parts, own, into[i : i + 1], "an observation")


def _picked(values: Any, i: int) -> Any:
    """Return the value of one environment out of a mapping of batches."""
    if isinstance(values, Mapping):
        return {key: _picked(part, i) for key, part in values.items() if not str(key).startswith("_")}
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
