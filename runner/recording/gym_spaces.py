"""Gymnasium's spaces in a recording: one class each, which describes, encodes and restores the space.

A new kind of space is a class here and an entry in `_KINDS`. Values are decoded in `spaces`, from the layout
of their bytes, which needs no Gymnasium.
"""

from __future__ import annotations

import string
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, Generic, TypeVar

import numpy as np
from gymnasium import spaces

from runner.environments.gym_types import Space
from runner.errors import EnvironmentNotUsable
from runner.recording.gym_json import numbers_in, registered, structure_of, text_of
from runner.recording.spaces import MAX_VALUE_BYTES, Description, Value
from runner.util.jsonable import as_json
from runner.util.values import is_text

Keys = tuple[str | int, ...]
SpaceT = TypeVar("SpaceT", bound=Space)
_MAX_TEXT: Final = 4096
"""Declared length of the values of spaces that have no length of their own."""
_MAX_BOUNDS: Final = 64
"""The most different bounds of a box that are listed."""


@dataclass(frozen=True)
class Part:
    """A space inside of others that has no parts itself: how to get its value, and how to encode it."""

    keys: Keys
    """Keys of the `Dict`s and `Tuple`s around it, from the outermost in."""
    dtype: np.dtype[np.generic] | None
    """The dtype of an array with its shape; None for values that are recorded as text."""
    text: Callable[[object], str] | None = None
    """Returns the text of a value; None for an array."""

    @property
    def fields(self) -> tuple[str, ...]:
        """The keys as names of NumPy's fields."""
        return tuple(map(str, self.keys))

    def of(self, value: Value) -> Value:
        """Return the value of this part in a value of the whole space."""
        for key in self.keys:
            value = value[key]
        return value


def parts_of(space: Space, where: str) -> list[Part]:
    """Return the parts of a space in the order of its description.

    Raises:
        EnvironmentNotUsable: one of them cannot be recorded; the message names `where`.
    """
    parts = list(_kind(space).parts(space, where, ()))
    size = sum(part.dtype.itemsize for part in parts if part.dtype is not None)
    if size > MAX_VALUE_BYTES:
        raise EnvironmentNotUsable(
            f"{where} has values of {size:,} bytes, expected {MAX_VALUE_BYTES:,} at most: record a smaller "
            "observation by wrapping outside of the wrapper that makes it small."
        )
    return parts


def describe_space(space: Space) -> dict[str, object]:
    """Return a space as JSON, which `runner.recording.spaces` reads; `parts_of` has accepted the space."""
    return _kind(space).describe(space)


def restore_space(description: Description) -> Space:
    """Return the space that a recording describes; bounds and letters that are not listed are the widest.

    Raises:
        AssertionError, KeyError, TypeError, ValueError, OverflowError: Gymnasium has no such space.
    """
    return _BY_NAME[description["type"]].restore(description)


def widened(space: Space, value: object) -> Space:
    """Return an action space in whose dtypes an action, or a batch of actions, is exact.

    Only floating-point actions widen a space: whole numbers that it cannot hold are a mistake.
    """
    return _kind(space).widened(space, value)


def can_widen(space: Space) -> bool:
    """Return whether there are actions for which `widened` returns another space."""
    return _kind(space).can_widen(space)


class _Kind(Generic[SpaceT]):
    """A space whose values have no layout; they are recorded as JSON text."""

    def parts(self, space: SpaceT, where: str, keys: Keys) -> Iterator[Part]:  # noqa: ARG002
        yield Part(keys, None, partial(text_of, space))

    def describe(self, space: SpaceT) -> dict[str, object]:
        return {"type": "Text", "max_length": _MAX_TEXT, **structure_of(space, describe_space)}

    def restore(self, description: Description) -> Space:
        raise KeyError(description["type"])

    def widened(self, space: SpaceT, value: object) -> Space:  # noqa: ARG002
        return space

    def can_widen(self, space: SpaceT) -> bool:  # noqa: ARG002
        return False


class _Text(_Kind[spaces.Text]):
    def parts(self, space: spaces.Text, where: str, keys: Keys) -> Iterator[Part]:  # noqa: ARG002
        yield Part(keys, None, _checked_text)

    def describe(self, space: spaces.Text) -> dict[str, object]:
        return {"type": "Text", "max_length": int(space.max_length)}

    def restore(self, description: Description) -> Space:
        length = max(int(description["max_length"]), 1)
        return spaces.Text(length, min_length=0, charset=string.printable)


def _checked_text(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{type(value).__name__} is not a text")
    return value


class _Dict(_Kind[spaces.Dict]):
    def parts(self, space: spaces.Dict, where: str, keys: Keys) -> Iterator[Part]:
        for key, part in space.spaces.items():
            if not is_text(str(key)):
                raise EnvironmentNotUsable(
                    f"{where}: found a part called {str(key)[:40]!r}, expected a short, printable name."
                )
            yield from _kind(part).parts(part, where, (*keys, key))

    def describe(self, space: spaces.Dict) -> dict[str, object]:
        parts = {str(key): describe_space(part) for key, part in space.spaces.items()}
        return {"type": "Dict", "spaces": parts}

    def restore(self, description: Description) -> Space:
        return spaces.Dict({name: restore_space(part) for name, part in description["spaces"].items()})

    def widened(self, space: spaces.Dict, value: object) -> Space:
        if not isinstance(value, Mapping):
            return space
        parts = {
            key: widened(part, value[key]) if key in value else part for key, part in space.spaces.items()
        }
        is_same = all(parts[key] is space.spaces[key] for key in parts)
        return space if is_same else spaces.Dict(parts)

    def can_widen(self, space: spaces.Dict) -> bool:
        return any(map(can_widen, space.spaces.values()))


class _Tuple(_Kind["spaces.Tuple[Any]"]):
    def parts(self, space: spaces.Tuple[Any], where: str, keys: Keys) -> Iterator[Part]:
        for i, part in enumerate(space.spaces):
            yield from _kind(part).parts(part, where, (*keys, i))

    def describe(self, space: spaces.Tuple[Any]) -> dict[str, object]:
        return {"type": "Tuple", "spaces": [describe_space(part) for part in space.spaces]}

    def restore(self, description: Description) -> Space:
        return spaces.Tuple([restore_space(part) for part in description["spaces"]])

    def widened(self, space: spaces.Tuple[Any], value: object) -> Space:
        if not isinstance(value, Sequence):
            return space
        parts = tuple(widened(part, own) for part, own in zip(space.spaces, value, strict=False))
        return space if all(map(lambda a, b: a is b, parts, space.spaces)) else spaces.Tuple(parts)

    def can_widen(self, space: spaces.Tuple[Any]) -> bool:
        return any(map(can_widen, space.spaces))


class _Box(_Kind[SpaceT]):
    """A box, and any space of another library whose values are arrays of one shape and dtype."""

    name = "Box"

    def parts(self, space: SpaceT, where: str, keys: Keys) -> Iterator[Part]:
        dtype = np.dtype(space.dtype)
        if dtype.kind not in "biuf" or dtype.itemsize > 8:
            raise EnvironmentNotUsable(
                f"{where}: found {space} of dtype {dtype}, expected numbers of at most 64 bits."
            )
        yield Part(keys, np.dtype((dtype.newbyteorder("<"), space.shape or ())))

    def describe(self, space: SpaceT) -> dict[str, object]:
        dtype = np.dtype(space.dtype).newbyteorder("<").str
        shape = [int(n) for n in space.shape or ()]
        return {"type": self.name, "dtype": dtype, "shape": shape, **self.details(space)}

    def details(self, space: SpaceT) -> dict[str, object]:
        return {name: _bound(getattr(space, name, None)) for name in ("low", "high")}

    def restore(self, description: Description) -> Space:
        dtype, shape = _dtype(description), tuple(description["shape"])
        if dtype.kind == "f":
            least, most = -np.inf, np.inf
        else:
            least, most = (0, 1) if dtype.kind == "b" else (np.iinfo(dtype).min, np.iinfo(dtype).max)
        low, high = (
            np.broadcast_to(np.array(widest if bound is None else numbers_in(bound), dtype), shape)
            for bound, widest in ((description["low"], least), (description["high"], most))
        )
        return spaces.Box(low, high, shape, dtype.type)

    def widened(self, space: SpaceT, value: object) -> Space:
        try:
            found = np.asarray(value).dtype
        except (TypeError, ValueError):
            return space
        if not isinstance(space, spaces.Box) or found.kind != "f" or found.itemsize > 8:
            return space
        if np.can_cast(found, space.dtype):
            return space
        return spaces.Box(space.low.astype(found), space.high.astype(found), dtype=found.type)

    def can_widen(self, space: SpaceT) -> bool:
        return isinstance(space, spaces.Box) and not np.can_cast(np.float64, space.dtype)


class _Discrete(_Box[spaces.Discrete]):
    name = "Discrete"

    def details(self, space: spaces.Discrete) -> dict[str, object]:
        return {"n": int(space.n), "start": int(space.start)}

    def restore(self, description: Description) -> Space:
        return spaces.Discrete(int(description["n"]), start=int(description["start"]))


class _MultiDiscrete(_Box[spaces.MultiDiscrete]):
    name = "MultiDiscrete"

    def details(self, space: spaces.MultiDiscrete) -> dict[str, object]:
        return {"nvec": np.asarray(space.nvec).tolist()}

    def restore(self, description: Description) -> Space:
        return spaces.MultiDiscrete(np.array(description["nvec"]), dtype=_dtype(description).type)


class _MultiBinary(_Box[spaces.MultiBinary]):
    name = "MultiBinary"

    def details(self, space: spaces.MultiBinary) -> dict[str, object]:  # noqa: ARG002
        return {}

    def restore(self, description: Description) -> Space:
        shape = tuple(description["shape"])
        return spaces.MultiBinary(shape[0] if len(shape) == 1 else shape)


_JSON: Final = _Kind[Space]()
_KINDS: Final[dict[type[Space], _Kind[Any]]] = {
    spaces.Dict: _Dict(),
    spaces.Tuple: _Tuple(),
    spaces.Text: _Text(),
    spaces.Graph: _JSON,
    spaces.Sequence: _JSON,
    spaces.OneOf: _JSON,
    spaces.Discrete: _Discrete(),
    spaces.MultiDiscrete: _MultiDiscrete(),
    spaces.MultiBinary: _MultiBinary(),
    spaces.Box: _Box[Space](),
}
_BY_NAME: Final = {kind.__name__: own for kind, own in _KINDS.items()}


def _kind(space: Space) -> _Kind[Any]:
    if registered(space) is not None:
        return _JSON
    for kind, own in _KINDS.items():
        if isinstance(space, kind):
            return own
    has_layout = space.shape is not None and space.dtype is not None
    return _KINDS[spaces.Box] if has_layout and np.dtype(space.dtype).kind in "biuf" else _JSON


def _dtype(description: Description) -> np.dtype[Any]:
    return np.dtype(description["dtype"]).newbyteorder("=")


def _bound(bound: object) -> object:
    """Return a bound of a box: one number if it is the same everywhere; None for too many."""
    values = np.asarray(bound)
    if not values.size or values.dtype.kind not in "biuf":
        return None
    if (values == values.flat[0]).all():
        return as_json(values.flat[0].item())
    return as_json(values.tolist()) if values.size <= _MAX_BOUNDS else None
