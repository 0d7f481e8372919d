"""Values of Gymnasium's spaces on their way into a recording: checked, and put into columns of rows."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from functools import cache, cached_property
from typing import Any, Final

import numpy as np

from runner.errors import RecordingError
from runner.recording.gym_spaces import Keys, RecordedSpace, checked_leaves
from runner.recording.spaces import MAX_VALUE_BYTES, Value, encode_text
from runner.util.arrays import Array, DType, zeros

SCALARS: Final = (np.bool_, *(np.dtype(code).type for code in "bBhHiIlLqQefd"))
NO_VALUE: Final = (struct.error, TypeError, ValueError, LookupError, OverflowError)
"""The errors of Python and NumPy for something that is no value of its space."""
REFUSED: Final = (*NO_VALUE, AttributeError, RecursionError)
"""The same for a value that may be text, of spaces that are not Gymnasium's too."""

OnRounded = Callable[[str], None]
"""Called with a warning: values are recorded rounded."""


class Leaf:
    """A part of a space without parts of its own, with the checks that its values pass.

    Args:
        keys: the keys of the `Dict`s and `Tuple`s around it, from the outermost in.
        space: the part.
        what: `observation` or `action`. An action may have another shape with as many numbers, because only
            the environment knows which shapes it accepts.
        on_rounded: called with a text the first time that a value is rounded.
    """

    def __init__(self, keys: Keys, space: RecordedSpace[Any], what: str, on_rounded: OnRounded) -> None:
        self.keys, self.space, self._what, self._on_rounded = keys, space, what, on_rounded
        self.name = what + "".join(f"[{key!r}]" for key in keys)
        self.blank = encode_text("") if space.dtype is None else bytes(space.dtype.itemsize)
        """The bytes of the value of an agent that has none."""
        if space.dtype is None:
            return
        self.base = np.dtype(space.dtype.base.str)
        self.shape = space.dtype.shape
        self._is_rounded = False

    @cached_property
    def exact_scalars(self) -> frozenset[type]:
        """Classes whose values are all recorded exactly, or refused by NumPy."""
        return frozenset() if self.shape else _exact_scalars(self.base)

    def value_in(self, whole: Value) -> Value:
        """Return the value of this leaf in a value of the whole space."""
        for key in self.keys:
            whole = whole[key]
        return whole

    def column_in(self, whole: Any) -> Any:
        """Return the part of a column of whole values that holds the values of this leaf."""
        for key in self.keys:
            whole = whole[str(key)]
        return whole

    def fit(self, value: object, batch: tuple[int, ...] = ()) -> Any:
        """Return a value as an array of the leaf's dtype.

        Args:
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
            return array.astype(self.base, copy=False)
        with np.errstate(all="ignore"):
            rounded = array.astype(self.base)
        if not np.array_equal(rounded, array, equal_nan=array.dtype.kind == "f"):
            if self.base.kind in "iu":
                limits = np.iinfo(self.base)
                if not ((array >= limits.min) & (array <= limits.max)).all():
                    raise self.refused(f"{self.base} holds {limits.min} to {limits.max}")
            if not self._is_rounded:
                self._is_rounded = True
                self._on_rounded(
                    f"{self.name} comes as {array.dtype} and is recorded, rounded, as the {self.base} of its "
                    "space. This warning is given once."
                )
        return rounded

    def pieces(self, values: Value, batch: tuple[int, ...] = ()) -> list[bytes]:
        """Return the bytes of a value, or of each of a batch of them.

        Raises:
            TypeError, ValueError: it is no such value, or no batch of this shape.
        """
        if batch:
            if isinstance(values, str | bytes | Mapping) or len(values) != batch[0]:
                raise ValueError(f"found {type(values).__name__}, expected a batch of {batch[0]}")
            return [piece for value in values for piece in self.pieces(value, batch[1:])]
        is_text = self.space.dtype is None
        return [encode_text(self.space.text(values)) if is_text else self.fit(values).tobytes()]

    def refused(self, reason: object) -> RecordingError:
        """Return the error for a value that is not of the space."""
        what = self._what
        return RecordingError(f"found an {what} that is not of the environment's {what} space ({reason}).")


class StateLeaf(Leaf):
    """A `Discrete` space with the states or the actions of one environment: any whole number is exact."""

    exact_scalars = frozenset([int])  # others are converted

    def fit(self, value: object, batch: tuple[int, ...] = ()) -> int:  # noqa: ARG002
        """Return a whole number, which may stand in an array of one.

        Raises:
            RecordingError: it is something else.
        """
        return int(only_number(value, self._what, "iub", "a whole number of its Discrete space"))


class SpaceValues:
    """The values of a space, with the checks that they pass before they are recorded.

    Args:
        what: `observation` or `action`.
        on_rounded: as for `Leaf`.
        leaf: the class of the leaves.
        is_game: whether the space is the `Dict` of the agents of a game, of whom some may have no value.
    """

    def __init__(
        self,
        space: Any,
        what: str,
        on_rounded: OnRounded = lambda _: None,
        leaf: type[Leaf] = Leaf,
        is_game: bool = False,
    ) -> None:
        where = "the agents' spaces" if is_game else f"the {what} space"
        self.leaves = [leaf(*part, what, on_rounded) for part in checked_leaves(space, where)]
        self.agents: tuple[object, ...] = tuple(space.spaces) if is_game else ()
        """All agents of a game."""

    def check_agents(self, values: Mapping[object, object]) -> None:
        """Refuse values of agents that the game does not have.

        Raises:
            RecordingError: there is such an agent.
        """
        for agent in values:
            if agent not in self.agents:
                names = ", ".join(map(str, self.agents))
                raise RecordingError(f"found the agent {agent!r}, expected one of possible_agents: {names}")

    def fitted(self, value: Value, batch: tuple[int, ...], dtype: DType) -> Array:
        """Return a batch of values as they stand in a column of this dtype, [*batch, ...].

        Raises:
            RecordingError: it is no batch of values of the space.
        """
        if dtype.hasobject:
            return np.array(self.to_bytes(value, batch), object).reshape(batch)
        column = zeros(batch, dtype)
        for leaf in self.leaves:
            try:
                leaf.column_in(column)[...] = leaf.fit(leaf.value_in(value), batch)
            except NO_VALUE as error:
                raise leaf.refused(error) from error
        return column

    def unknown(self, dtype: DType) -> Array:
        """Return an unknown value as it stands in a column of this dtype: NaN, and 0 for whole numbers."""
        value = zeros((), dtype)
        for leaf in self.leaves:
            leaf.column_in(value)[...] = np.nan if leaf.base.kind == "f" else 0
        return value

    def to_bytes(self, value: Value, batch: tuple[int, ...] = ()) -> list[bytes]:
        """Return the values of a batch, nested as the space, each as its bytes in a recording.

        Raises:
            RecordingError: one is no value of the space, or takes too many bytes.
        """
        columns = []
        for leaf in self.leaves:
            try:
                if self.agents and leaf.keys[0] not in value:
                    columns.append([leaf.blank])
                else:
                    columns.append(leaf.pieces(leaf.value_in(value), batch))
            except REFUSED as error:
                raise leaf.refused(error) from error
        whole = [b"".join(pieces[k] for pieces in columns) for k in range(math.prod(batch))]
        if (size := max(map(len, whole), default=0)) > MAX_VALUE_BYTES:
            raise self.leaves[0].refused(f"it takes {size:,} bytes, expected at most {MAX_VALUE_BYTES:,}")
        return whole


@cache
def _exact_scalars(base: DType) -> frozenset[type]:
    scalars = {kind for kind in SCALARS if np.can_cast(kind, base)}
    return frozenset(
        scalars | {bool} | ({int} if base.kind in "iu" else {float} if base.char == "d" else set())
    )


def only_number(value: object, what: str, kinds: str = "iubf", expected: str = "a number") -> Array:
    """Return a number that may stand in an array of one.

    Args:
        kinds: the kinds of dtypes that it may have.
        expected: what it is, for the error.

    Raises:
        RecordingError: it is something else.
    """
    array = np.asarray(value)
    if array.size != 1 or array.dtype.kind not in kinds:
        raise RecordingError(f"found the {what} {value!r}, expected {expected}.")
    return array.reshape(())


def element_of(values: Value, i: int | slice) -> Value:
    """Return one of many values, or some, that are nested as their space."""
    if isinstance(values, tuple):
        return tuple(element_of(part, i) for part in values)
    if values.__class__ is not np.ndarray and isinstance(values, Mapping):  # the latter takes longer
        return {key: element_of(part, i) for key, part in values.items()}
    return values[i]
