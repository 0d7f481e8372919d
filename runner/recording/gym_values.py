"""Values of Gymnasium's spaces on their way into a recording: checked, and put into columns of records."""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Mapping, Sequence
from functools import cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.environments.gym_types import Space
from runner.errors import RecordingError
from runner.recording.gym_leaves import Part
from runner.recording.gym_spaces import parts_of
from runner.recording.spaces import MAX_VALUE_BYTES, Value, encode_text
from runner.util.arrays import Array, zeros

SCALARS: Final = (np.bool_, *(np.dtype(code).type for code in "bBhHiIlLqQefd"))

OnRounded = Callable[[str], None]
"""Called with a warning: values are recorded rounded."""
Put = Callable[[int, Value], None]
"""Puts a value into a row of a column."""


class Leaf:
    """A part of a space, with the checks that its values pass before they are recorded.

    Args:
        what: `observation` or `action`. An action may have another shape with as many numbers, because only
            the environment knows which shapes it accepts.
        on_rounded: called with a text the first time that a value is rounded.
    """

    def __init__(self, part: Part, what: str, on_rounded: OnRounded) -> None:
        self.part = part
        self._on_rounded = on_rounded
        self.name = what + "".join(f"[{key!r}]" for key in part.keys)
        self._what = what
        self.blank = encode_text("") if part.dtype is None else bytes(part.dtype.itemsize)
        """The bytes of the value of an agent that has none."""
        if part.dtype is None:
            return
        self.base = np.dtype(part.dtype.base.str)
        self.shape = part.dtype.shape
        self.exact_scalars = frozenset() if self.shape else _exact_scalars(self.base)
        """Classes whose values are all recorded exactly, or refused by NumPy."""
        self._is_rounded = False

    def fit(self, value: object, batch: tuple[int, ...] = ()) -> Array:
        """Return a value as an array that can be recorded.

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
        if self.part.text is not None:
            return [encode_text(self.part.text(values))]
        return [np.asarray(self.fit(values), self.base, order="C").tobytes()]

    def refused(self, reason: object) -> RecordingError:
        """Return the error for a value that is not of the space."""
        what = self._what
        return RecordingError(f"found an {what} that is not of the environment's {what} space ({reason}).")


@cache
def _exact_scalars(base: np.dtype[np.generic]) -> frozenset[type]:
    scalars = {kind for kind in SCALARS if np.can_cast(kind, base)}
    return frozenset(
        scalars | {bool} | ({int} if base.kind in "iu" else {float} if base.char == "d" else set())
    )


def leaves_of(space: Space, what: str, where: str = "", on_rounded: OnRounded = lambda _: None) -> list[Leaf]:
    """Return the leaves of a space; `what` is `observation` or `action`."""
    return [Leaf(part, what, on_rounded) for part in parts_of(space, where or f"the {what} space")]


def filler(leaves: Sequence[Leaf], column: Array, batch: tuple[int, ...] = ()) -> Put:
    """Return a function that puts a value of a space into a row of a column.

    Args:
        column: [rows, *batch] values of the space; objects where they vary in size, which hold their bytes.
        batch: the shape of the batch that each value is, if it is one.
    """
    if column.dtype.hasobject:
        return _bytes_filler(leaves, column, batch)
    if len(leaves) == 1 and not leaves[0].part.keys:
        return _leaf_filler(leaves[0], column, batch)
    fillers = [(leaf, leaf.part.keys, _leaf_filler(leaf, _column_of(leaf, column), batch)) for leaf in leaves]

    def put(row: int, value: Value) -> None:
        for leaf, keys, put_leaf in fillers:
            inside = value
            try:
                for key in keys:
                    inside = inside[key]
            except (TypeError, LookupError) as error:
                raise leaf.refused(error) from error
            put_leaf(row, inside)

    return put


def _bytes_filler(leaves: Sequence[Leaf], column: Array, batch: tuple[int, ...]) -> Put:
    places = column.reshape(len(column), -1)

    def put(row: int, value: Value) -> None:
        places[row] = bytes_of(leaves, value, batch)

    return put


def _leaf_filler(leaf: Leaf, column: Array, batch: tuple[int, ...]) -> Put:
    base, shape, array = leaf.base, batch + leaf.shape, np.ndarray
    scalars = frozenset() if batch else leaf.exact_scalars

    def put(row: int, value: Value) -> None:
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


def fitted(
    leaves: Sequence[Leaf], value: object, batch: tuple[int, ...], dtype: np.dtype[np.generic]
) -> Array:
    """Return a batch of values of a space as they stand in a column of this dtype, [*batch, ...]."""
    column = zeros((1, *batch), dtype)
    filler(leaves, column, batch)(0, value)
    return np.asarray(column[0])


def put_unknown(leaves: Sequence[Leaf], column: Array) -> None:
    """Fill a column of values of the space with NaN, and with 0 where they are whole numbers."""
    for leaf in leaves:
        _column_of(leaf, column)[...] = np.nan if leaf.base.kind == "f" else 0


def leaves_by_agent(space: Any, what: str, on_rounded: OnRounded = lambda _: None) -> dict[str, list[Leaf]]:
    """Return the leaves of each agent's space in the `Dict` of all of them."""
    leaves = leaves_of(space, what, "the agents' spaces", on_rounded)
    return {agent: [leaf for leaf in leaves if leaf.part.keys[0] == agent] for agent in space.spaces}


def filler_by_agent(
    leaves: Mapping[str, Sequence[Leaf]], column: Array
) -> Callable[[int, Mapping[str, Value]], None]:
    """Return a function that puts the values of some agents into a row, and zeros for the others."""
    fillers = {} if column.dtype.hasobject else {agent: filler(own, column) for agent, own in leaves.items()}
    every, zeros = [leaf for own in leaves.values() for leaf in own], np.zeros((), column.dtype)

    def put(row: int, values: Mapping[str, object]) -> None:
        for agent in values:
            if agent not in leaves:
                names = ", ".join(map(str, leaves))
                raise RecordingError(f"found the agent {agent!r}, expected one of possible_agents: {names}")
        column[row] = zeros if fillers else bytes_of(every, values, agents=values)[0]
        for agent in values if fillers else ():
            fillers[agent](row, {agent: values[agent]})

    return put


def bytes_of(
    leaves: Sequence[Leaf],
    value: object,
    batch: tuple[int, ...] = (),
    agents: Container[object] | None = None,
) -> list[bytes]:
    """Return the values of a batch, nested as their space, each as its bytes in a recording.

    Args:
        agents: of a game, those that have a value; None for other spaces.
    """
    columns = []
    for leaf in leaves:
        try:
            if agents is None or leaf.part.keys[0] in agents:
                columns.append(leaf.pieces(leaf.part.of(value), batch))
            else:
                columns.append([leaf.blank])
        except (TypeError, ValueError, LookupError, AttributeError, OverflowError, RecursionError) as error:
            raise leaf.refused(error) from error
    whole = [b"".join(pieces[k] for pieces in columns) for k in range(math.prod(batch))]
    if (size := max(map(len, whole), default=0)) > MAX_VALUE_BYTES:
        raise leaves[0].refused(f"it takes {size:,} bytes, expected at most {MAX_VALUE_BYTES:,}")
    return whole


def element_of(values: Value, i: int | slice) -> Value:
    """Return one of many values, or some, that are nested as their space."""
    if isinstance(values, Mapping):
        return {key: element_of(part, i) for key, part in values.items()}
    if isinstance(values, tuple):
        return tuple(element_of(part, i) for part in values)
    return values[i]
