"""Values on their way into a recording, checked: values of spaces, logged numbers, arrays."""

from __future__ import annotations

import math
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

from runner.errors import ConfigError, RecordingError
from runner.recording.chunks import MAX_CHUNK_BYTES
from runner.recording.gym_spaces import Part, Space, parts_of
from runner.recording.spaces import MAX_VALUE_BYTES, encode_text
from runner.util.jsonable import as_mapping
from runner.util.values import is_utf8

MAX_ARRAY_BYTES: Final = MAX_CHUNK_BYTES - (1 << 16)
_HERE: Final = str(Path(__file__).parent)
_SCALARS: Final = (np.bool_, *(np.dtype(code).type for code in "bBhHiIlLqQefd"))


class Leaf:
    """A part of a space, with the checks that its values pass before they are recorded.

    Args:
        part: where the part is in a value, and its dtype.
        what: `observation` or `action`. An action may have another shape with as many numbers, because
            only the environment knows which shapes it accepts.
    """

    def __init__(self, part: Part, what: str) -> None:
        self.part = part
        self.name = what + "".join(f"[{key!r}]" for key in part.keys)
        self._what = what
        if part.dtype is None:
            return
        self.base = np.dtype(part.dtype.base.str)
        self.shape = part.dtype.shape
        scalars = {kind for kind in _SCALARS if np.can_cast(kind, self.base)}
        scalars |= {bool} | ({int} if self.base.kind in "iu" else {float} if self.base.char == "d" else set())
        self.exact_scalars = frozenset(() if self.shape else scalars)
        """Classes whose values are all recorded exactly, or refused by NumPy."""
        self._is_rounded = False

    def fit(self, value: Any, batch: tuple[int, ...] = ()) -> NDArray[Any]:
        """Return a value as an array that can be recorded; warn the first time that one is rounded.

        Args:
            value: the value of this part alone.
            batch: the shape of the batch that it is, if it is one.

        Raises:
            RecordingError: it has another shape, holds no numbers, or numbers out of the dtype's range.
        """
        array = np.asarray(value)
        shape = batch + self.shape
        if array.dtype.kind not in "biuf":
            raise self.refused(f"found {array.dtype}, expected {self.base}")
        if array.shape != shape:
            if self._what != "action" or array.size != math.prod(shape):
                raise RecordingError(
                    f"found {self.name} of shape {array.shape}, expected {shape} by its space."
                )
            array = array.reshape(shape)
        if array.dtype is self.base or np.can_cast(array.dtype, self.base):
            return array
        with np.errstate(all="ignore"):
            rounded = array.astype(self.base)
        if not np.array_equal(rounded, array, equal_nan=array.dtype.kind == "f"):
            if self.base.kind in "iu":
                limits = np.iinfo(self.base)
                if not ((array >= limits.min) & (array <= limits.max)).all():
                    raise self.refused(f"{self.base} holds {limits.min} to {limits.max}")
            if not self._is_rounded:
                self._is_rounded = True
                warn_user(
                    f"{self.name} comes as {array.dtype} and is recorded, rounded, as the {self.base} of its "
                    "space. This warning is given once."
                )
        return rounded

    def refused(self, reason: object) -> RecordingError:
        """Return the error for a value that is not of the space."""
        what = self._what
        return RecordingError(f"found an {what} that is not of the environment's {what} space ({reason}).")


def leaves_of(space: Space, what: str, where: str = "") -> list[Leaf]:
    """Return the leaves of a space; `what` is `observation` or `action`."""
    return [Leaf(part, what) for part in parts_of(space, where or f"the {what} space")]


def filler(
    leaves: Sequence[Leaf], column: NDArray[Any], batch: tuple[int, ...] = ()
) -> Callable[[int, Any], None]:
    """Return a function that puts a value of a space into a row of a column.

    Args:
        leaves: the leaves of the space.
        column: [rows, *batch] values of the space.
        batch: the shape of the batch that each value is, if it is one.

    Raises:
        RecordingError: (from the returned function) a value is not of its space.
    """
    if len(leaves) == 1 and not leaves[0].part.keys:
        return _leaf_filler(leaves[0], column, batch)
    fillers = [(leaf, leaf.part.keys, _leaf_filler(leaf, _column_of(leaf, column), batch)) for leaf in leaves]

    def put(row: int, value: Any) -> None:
        for leaf, keys, put_leaf in fillers:
            inside = value
            try:
                for key in keys:
                    inside = inside[key]
            except (TypeError, LookupError) as error:
                raise leaf.refused(error) from error
            put_leaf(row, inside)

    return put


def _leaf_filler(leaf: Leaf, column: NDArray[Any], batch: tuple[int, ...]) -> Callable[[int, Any], None]:
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


def _column_of(leaf: Leaf, column: NDArray[Any]) -> NDArray[Any]:
    for name in leaf.part.fields:
        column = column[name]
    return column


def value_bytes(leaves: Sequence[Leaf], value: Any) -> bytes:
    """Return a value of a space as its bytes in a recording.

    Raises:
        RecordingError: it is not of the space, or too large.
    """
    pieces = []
    for leaf in leaves:
        try:
            inside = leaf.part.of(value)
            if leaf.part.text is not None:
                pieces.append(encode_text(leaf.part.text(inside)))
            else:
                pieces.append(np.asarray(leaf.fit(inside), leaf.base, order="C").tobytes())
        except (TypeError, ValueError, LookupError, AttributeError, OverflowError, RecursionError) as error:
            raise leaf.refused(error) from error
    if (size := sum(map(len, pieces))) > MAX_VALUE_BYTES:
        raise leaves[0].refused(f"it takes {size:,} bytes, expected at most {MAX_VALUE_BYTES:,}")
    return b"".join(pieces)


def put_chosen(leaves: Sequence[Leaf], values: Any, into: NDArray[Any], which: NDArray[np.intp]) -> None:
    """Put values of single environments into their rows, as a vector's info holds them.

    Raises:
        RecordingError: they are not of the space.
    """
    put = filler(leaves, into)
    for i in which.tolist():
        put(i, _element(values, i))


def _element(values: Any, i: int) -> Any:
    """Return the value of one environment in a batch of a `Dict` or `Tuple` space."""
    if isinstance(values, Mapping):
        return {key: _element(part, i) for key, part in values.items() if not str(key).startswith("_")}
    if isinstance(values, tuple):
        return tuple(_element(part, i) for part in values)
    return values[i]


def lone_number(value: Any, what: str) -> float:
    """Return a number that may stand in an array of one.

    Raises:
        RecordingError: it is not a number.
    """
    return float(_lone(value, what, "iubf", "a number"))


def whole_number(value: Any, what: str) -> int:
    """Return a whole number that may stand in an array of one.

    Raises:
        RecordingError: it is not a whole number.
    """
    return int(_lone(value, what, "iub", "a whole number of its Discrete space"))


def _lone(value: Any, what: str, kinds: str, expected: str) -> Any:
    array = np.asarray(value)
    if array.size != 1 or array.dtype.kind not in kinds:
        raise RecordingError(f"found the {what} {value!r}, expected {expected}.")
    return array.reshape(())


def logged_number(name: str, value: Any) -> float:
    """Return a logged number, which may stand in an array of one.

    Raises:
        ConfigError: it is not a number.
    """
    try:
        if callable(detach := getattr(value, "detach", None)):  # a tensor of PyTorch
            value = detach()
        return lone_number(value, name) if np.size(value) == 1 and np.ndim(value) else float(value)
    except (TypeError, ValueError, OverflowError, RuntimeError, RecordingError) as error:
        raise ConfigError(
            f"log: found {type(value).__name__} for {name!r}, expected a number that a float64 holds, or "
            "text; an array is recorded by snapshot()."
        ) from error


def check_log_name(name: Any, value: Any) -> None:
    """Refuse a name that a logged value cannot have.

    Raises:
        ConfigError: it is empty, or not text.
    """
    if not isinstance(name, str) or not name or not is_utf8(name):
        raise ConfigError(f"log: found the name {name!r} for {value!r}, expected text that is valid Unicode")


def arrays_of(name: str, value: Any) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the arrays of a snapshot: the value itself, or those of a mapping as `name/key`.

    Raises:
        ConfigError: a value holds something else than numbers, or too many.
    """
    if not isinstance(name, str) or not is_utf8(name):
        raise ConfigError(f"snapshot: found the name {name!r}, expected an array of numbers and a name.")
    if (inside := as_mapping(value)) is not None:
        for key, part in inside.items():
            yield from arrays_of(f"{name}/{key}", part)
        return
    try:
        values = _as_array(value)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ConfigError(f"snapshot: found no array of numbers for {name!r} ({error})") from error
    if values.dtype.kind not in "biuf" or values.dtype.itemsize > 8:
        raise ConfigError(
            f"snapshot: found {values.dtype} for {name!r}, expected an array of numbers and a name."
        )
    if values.nbytes > MAX_ARRAY_BYTES:
        raise ConfigError(
            f"snapshot: found {values.nbytes:,} bytes for {name!r}, expected at most "
            f"{MAX_ARRAY_BYTES:,}; record it in parts."
        )
    yield name, values.astype(values.dtype.newbyteorder("<"), copy=False)


def _as_array(value: Any) -> NDArray[Any]:
    """Return an array or tensor as NumPy's; the short floats that NumPy lacks become float32, exactly."""
    if callable(detach := getattr(value, "detach", None)):
        value = detach().cpu()
        if "bfloat16" in str(value.dtype) or "float8" in str(value.dtype):
            value = value.float()
    values = np.asarray(value, order="C")
    if values.dtype.name.startswith(("bfloat16", "float8")):
        return values.astype(np.float32)
    return values


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
