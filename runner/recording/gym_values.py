"""Values of Gymnasium's spaces on their way into a recording: checked, and put into columns of rows.

What puts values down is compiled from the leaves of their spaces, as `dataclasses` compiles `__init__`, so
that a step takes about a microsecond: an expression takes the value of each leaf and checks it, and all of a
short row is packed at once. The source consists of words of this module and of numbers: keys, dtypes and
columns are objects that it refers to, so nothing that an environment or a recording says gets into it.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from functools import cache, cached_property, lru_cache, partial
from typing import Any, Final

import numpy as np

from runner.errors import RecordingError
from runner.recording.gym_spaces import Keys, RecordedSpace, checked_leaves
from runner.recording.spaces import MAX_VALUE_BYTES, Value, encode_text
from runner.util.arrays import Array, DType, Records, zeros

SCALARS: Final = (np.bool_, *(np.dtype(code).type for code in "bBhHiIlLqQefd"))
NO_VALUE: Final = (struct.error, TypeError, ValueError, LookupError, OverflowError)
"""The errors of Python and NumPy for something that is no value of its space."""
REFUSED: Final = (*NO_VALUE, AttributeError, RecursionError)
"""The same for a value that may be text, of spaces that are not Gymnasium's too."""

OnRounded = Callable[[str], None]
"""Called with a warning: values are recorded rounded."""
Put = Callable[..., int]
"""Puts values into a row, whose number comes first; returns the bytes of those that vary in size."""
PutStep = Callable[..., None]
"""Puts a whole step into a row, whose number comes first."""
Change = Callable[[Value], Value]
"""Returns a value in another form."""
_MAX_PACKED: Final = 4096
"""The most bytes of a row that is packed at once, because this copies arrays twice."""
_CODES: Final = {np.dtype(code).str: code for code in "?bBhHiIqQd"}
"""How `struct` packs single numbers. Shorter floats are packed as bytes, else some NaNs would change."""


class LeafValues:
    """A part of a space without parts of its own, with the checks that its values pass.

    Args:
        keys: the keys of the `Dict`s and `Tuple`s around it, from the outermost in.
        space: the part.
        what: `observation` or `action`. An action may have another shape with as many numbers, because only
            the environment knows which shapes it accepts.
        on_rounded: called with a text the first time that a value is rounded.
    """

    def __init__(self, keys: Keys, space: RecordedSpace[Any], what: str, on_rounded: OnRounded) -> None:
        self.keys = keys
        self.space = space
        self._what = what
        self._on_rounded = on_rounded
        self.name = what + "".join(f"[{key!r}]" for key in keys)
        self.blank = encode_text("") if space.dtype is None else bytes(space.dtype.itemsize)
        """The bytes that stand for the value of an agent without a value."""
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


class StateValues(LeafValues):
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
        on_rounded: as for `LeafValues`.
        leaf: the class of the leaves.
        is_game: whether the space is the `Dict` of the agents of a game, of whom some may have no value.
    """

    def __init__(
        self,
        space: Any,
        what: str,
        on_rounded: OnRounded = lambda _: None,
        leaf: type[LeafValues] = LeafValues,
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


class _Source:
    """The objects that the source of a function refers to."""

    def __init__(self, **scope: object) -> None:
        self._scope: dict[str, Any] = {"ndarray": np.ndarray, "NO_VALUE": NO_VALUE, **scope}

    def name(self, value: object) -> str:
        """Return a name for an object."""
        name = f"x{len(self._scope)}"
        self._scope[name] = value
        return name

    def _inside(self, whole: str, leaf: LeafValues) -> str:
        return whole + "".join(f"[{self.name(key)}]" for key in leaf.keys)

    def value(
        self,
        whole: str,
        values: SpaceValues,
        leaf: LeafValues,
        scalars: frozenset[type] | None,
        batch: tuple[int, ...] = (),
        fit: Change | None = None,
    ) -> str:
        """Return an expression for the value of a leaf in the variable `whole`: zeros for an agent without.

        Args:
            scalars: classes of single numbers that are taken as they are, besides arrays of dtype and shape;
                None for all values.
            fit: called with other values; by default they are fitted.
        """
        value = f"v{len(self._scope)}"
        shape = batch + leaf.shape
        inside = self._inside(whole, leaf)
        if values.agents:
            zeros = self.name(np.zeros(shape, leaf.base)[()])
            inside = f"{inside} if {self.name(leaf.keys[0])} in {whole} else {zeros}"
        if scalars is None:
            return f"({inside})"
        test = f"({value} := {inside}).__class__ is ndarray and {value}.dtype is {self.name(leaf.base)}"
        test += f" and {value}.shape == {self.name(shape)} or {value}.__class__ in {self.name(scalars)}"
        return f"({value} if {test} else {self.name(fit or partial(leaf.fit, batch=batch))}({value}))"

    def packed(
        self, whole: str, values: SpaceValues, column: Array, fit: Change | None = None
    ) -> list[tuple[str, str]]:
        """Return how each leaf of a value of one environment is packed, and an expression for it.

        Leaves of varying size have no code, and an expression for their bytes.
        """
        packed = []
        for leaf in values.leaves:
            if leaf.space.dtype is None:
                text = f"{self.name(leaf.space.text)}({self._inside(whole, leaf)})"
                packed.append(("", f"{self.name(encode_text)}({text})"))
                continue
            dtype = leaf.base if column.dtype.hasobject else leaf.column_in(column).dtype
            code = "" if leaf.shape else _CODES.get(dtype.str, "")
            scalars: frozenset[type] | None = leaf.exact_scalars
            if not code and not leaf.shape:
                scalars = frozenset([leaf.base.type])
            elif code and code not in "?d":  # `struct` takes whole numbers that fit, and nothing else
                scalars = None
            expression = self.value(whole, values, leaf, scalars, fit=fit)
            size = leaf.base.itemsize * math.prod(leaf.shape)
            packed.append((code, expression) if code else (f"{size}s", f"{expression}.tobytes()"))
        return packed

    def function(self, parameters: str, *lines: str) -> Any:
        """Return the function with these lines.

        It has the objects in its closure: functions of one source share what Python has found out about it,
        which would have to be found out again and again if they had other globals.
        """
        source = "\n  ".join([f" def function({parameters}):", *lines])
        return _maker(f"def make({', '.join(self._scope)}):\n{source}\n return function")(
            *self._scope.values()
        )


@lru_cache(256)
def _maker(text: str) -> Any:
    """Return the function of this source that makes a function."""
    scope: dict[str, Any] = {}
    exec(compile(text, f"{__file__}, compiled", "exec"), scope)
    return scope["make"]


def filler(values: SpaceValues, column: Array, batch: tuple[int, ...] = ()) -> Put:
    """Return a function that puts a value of a space, or a batch of values, into a row of a column.

    The function raises a `RecordingError` for what is no value of the space.

    Args:
        column: [rows, *batch] values; objects where they vary in size, which hold their bytes.
    """
    source = _Source(check_agents=values.check_agents, to_bytes=values.to_bytes, REFUSED=REFUSED)
    lines = ["check_agents(value)"] if values.agents else []
    if column.dtype.hasobject:
        rows = source.name(column.reshape(len(column), math.prod(batch)))
        size = "sum(map(len, data))"
        lines.append(f"{rows}[row] = data = to_bytes(value, {source.name(batch)})")
        if not (batch or values.agents):
            packed = [
                f"{source.name(struct.Struct(f'<{code}').pack)}({piece})" if len(code) == 1 else piece
                for code, piece in source.packed("value", values, column)
            ]
            size = "len(data)"
            lines = [f"try: data = b''.join(({', '.join(packed)},))"]
            lines.append("except REFUSED: data, = to_bytes(value)  # which says why")
            lines.append(f"if len(data) > {MAX_VALUE_BYTES}: to_bytes(value)  # which refuses it")
            lines.append(f"{rows}[row] = data")
        lines.append(f"return {size}")
    if not column.dtype.hasobject:
        for leaf in values.leaves:
            scalars = frozenset() if batch else leaf.exact_scalars
            expression = source.value("value", values, leaf, scalars, batch)
            lines.append(f"try: {source.name(leaf.column_in(column))}[row] = {expression}")
            lines.append(f"except NO_VALUE as error: raise {source.name(leaf.refused)}(error) from error")
    function: Put = source.function("row, value", *lines, "return 0")
    return function


def step_filler(
    action: SpaceValues, observation: SpaceValues, rows: Records, put: PutStep, copied: Change
) -> tuple[PutStep, Change]:
    """Return a function that puts down a step of one environment, and one that keeps its action before.

    The first takes a row, action, observation, reward, terminated and truncated. The second returns an action
    in a form that the step does not change: as its bytes in the row, or else as `copied` returns it.

    Args:
        rows: [rows], with the fields `action`, `observation`, a reward as float64, and two flags.
        put: takes the same arguments as the first, and puts down what is not as expected.
        copied: returns a copy of an action, which is never bytes.
    """
    if rows.itemsize > _MAX_PACKED:
        return put, copied
    source = _Source(put=put, memory=rows.view(np.uint8).data)
    keep = copied
    code, given = _joined(source.packed("action", action, rows["action"]))
    if code not in _CODES.values():  # else it is a number, which nobody can change
        kept = _Source(copied=copied)
        code, values = _joined(kept.packed("action", action, rows["action"], _not_expected))
        pack = struct.Struct(f"<{code}")
        returned = f"try: return {kept.name(pack.pack)}({values})"
        keep = kept.function("action", returned, "except NO_VALUE: return copied(action)")
        code = f"{pack.size}s"
        given = "action"
    codes, seen = _joined(source.packed("observation", observation, rows["observation"]))
    pack_into = source.name(struct.Struct(f"<{code}{codes}d??").pack_into)
    parameters = "row, action, observation, reward, terminated, truncated"
    values = ", ".join(filter(None, [given, seen, "reward, terminated, truncated"]))
    packed = f"try: {pack_into}(memory, row * {rows.itemsize}, {values})"
    return source.function(parameters, packed, f"except NO_VALUE: put({parameters})"), keep


def _joined(packed: list[tuple[str, str]]) -> tuple[str, str]:
    """Return how all leaves are packed at once, and the expressions for them."""
    return "".join(code for code, _ in packed), ", ".join(expression for _, expression in packed)


def _not_expected(value: Value) -> Value:
    raise TypeError(f"found {type(value).__name__}")


@cache
def _exact_scalars(base: DType) -> frozenset[type]:
    scalars: set[type] = {kind for kind in SCALARS if np.can_cast(kind, base)} | {bool}
    if base.kind in "iu":
        scalars.add(int)
    elif base.char == "d":
        scalars.add(float)
    return frozenset(scalars)


def only_number(value: object, what: str, kinds: str = "iubf", expected: str = "a number") -> Array:
    """Return a number that may stand in an array of one.

    Args:
        kinds: the kinds of dtypes that it may have.
        expected: what was expected, for the error.

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
