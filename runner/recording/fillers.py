"""Functions that put values into columns of rows, compiled from the leaves of their spaces.

As `dataclasses` compiles `__init__`, so that a step takes about a microsecond: an expression takes the value
of each leaf and checks it, and all of a short row is packed at once. The source consists of words of this
module and of numbers: keys, dtypes and columns are objects that it refers to, so nothing that an environment
or a recording says gets into it.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, Final

import numpy as np

from runner.recording.gym_values import NO_VALUE, REFUSED, Leaf, SpaceValues
from runner.recording.spaces import MAX_VALUE_BYTES, Value, encode_text
from runner.util.arrays import Array, Records

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


class _Source:
    """The objects that the source of a function refers to."""

    def __init__(self, **scope: object) -> None:
        self._scope: dict[str, Any] = {"ndarray": np.ndarray, "NO_VALUE": NO_VALUE, **scope}

    def name(self, value: object) -> str:
        """Return a name for an object."""
        name = f"x{len(self._scope)}"
        self._scope[name] = value
        return name

    def _inside(self, whole: str, leaf: Leaf) -> str:
        return whole + "".join(f"[{self.name(key)}]" for key in leaf.keys)

    def value(
        self,
        whole: str,
        values: SpaceValues,
        leaf: Leaf,
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
        value, shape, inside = f"v{len(self._scope)}", batch + leaf.shape, self._inside(whole, leaf)
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
        rows, size = source.name(column.reshape(len(column), math.prod(batch))), "sum(map(len, data))"
        lines.append(f"{rows}[row] = data = to_bytes(value, {source.name(batch)})")
        if not (batch or values.agents):
            packed = [
                f"{source.name(struct.Struct(f'<{code}').pack)}({piece})" if len(code) == 1 else piece
                for code, piece in source.packed("value", values, column)
            ]
            size, lines = "len(data)", [f"try: data = b''.join(({', '.join(packed)},))"]
            lines.append("except REFUSED: data, = to_bytes(value)  # which says why")
            lines.append(f"if len(data) > {MAX_VALUE_BYTES}: to_bytes(value)  # which refuses it")
            lines.append(f"{rows}[row] = data")
        lines.append(f"return {size}")
    for leaf in () if column.dtype.hasobject else values.leaves:
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
    source, keep = _Source(put=put, memory=rows.view(np.uint8).data), copied
    code, given = _joined(source.packed("action", action, rows["action"]))
    if code not in _CODES.values():  # else it is a number, which nobody can change
        kept = _Source(copied=copied)
        code, values = _joined(kept.packed("action", action, rows["action"], _not_expected))
        pack = struct.Struct(f"<{code}")
        returned = f"try: return {kept.name(pack.pack)}({values})"
        keep = kept.function("action", returned, "except NO_VALUE: return copied(action)")
        code, given = f"{pack.size}s", "action"
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
