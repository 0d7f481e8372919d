"""Gymnasium's spaces without parts in a recording: one class each, which describes and encodes its values.

`gym_spaces` has the spaces that hold others, and finds the class of a space.
"""

from __future__ import annotations

import json
import string
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, Generic, TypeVar

import numpy as np
from gymnasium import spaces

from runner.environments.gym_types import Space
from runner.errors import EnvironmentNotUsable
from runner.recording.spaces import Description, Value
from runner.util.jsonable import as_json

Keys = tuple[str | int, ...]
SpaceT = TypeVar("SpaceT", bound=Space)
_MAX_TEXT: Final = 4096
"""Declared length of the values of spaces that have no length of their own."""
_MAX_BOUNDS: Final = 64
"""The most different bounds of a box that are listed."""
_MAX_REPR: Final = 1000


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


class Kind(Generic[SpaceT]):
    """A kind of space, of which Gymnasium knows nothing more: its values are recorded as text.

    The text of a string is the string, of other values JSON, or their `repr`.
    """

    from_text = False
    """Whether the text is JSON that gives the value back."""

    def parts(self, space: SpaceT, where: str, keys: Keys) -> Iterator[Part]:  # noqa: ARG002
        """Yield the parts of a space at `keys`, in the order of its description; errors name `where`."""
        yield Part(keys, None, partial(self.text, space))

    def text(self, space: SpaceT, value: Value) -> str:
        """Return a value as text."""
        is_plain = isinstance(value, str) and not self.from_text
        return value if is_plain else json.dumps(self.to_json(space, value))

    def to_json(self, space: SpaceT, value: Value) -> Value:  # noqa: ARG002
        """Return a value as JSON can hold it."""
        return as_json(value)

    def from_json(self, space: SpaceT, data: Value) -> Value:  # noqa: ARG002
        """Return the value for what `to_json` returned, in the dtypes of the space."""
        raise ValueError(f"{type(space).__name__} is no space whose values come back from JSON")

    def batch(self, space: SpaceT, values: Value) -> Value:
        """Return many values, of which `to_json` returned these, as Gymnasium batches them."""
        return tuple(self.from_json(space, own) for own in values)

    def describe(self, space: SpaceT) -> dict[str, object]:
        """Return the space as JSON, which `runner.recording.spaces` reads."""
        structure = self.structure(space)
        own = {"type": "Text", "max_length": _MAX_TEXT, "holds": repr(space)[:_MAX_REPR]}
        return own | ({"space": structure} if structure else {})

    def structure(self, space: SpaceT) -> Mapping[str, object]:  # noqa: ARG002
        """Return what describes the space of values that are recorded as text; empty if it is unknown."""
        return {}

    def restore(self, description: Description) -> Space:
        """Return the space that is described."""
        raise KeyError(description["type"])

    def widened(self, space: SpaceT, value: object) -> Space:  # noqa: ARG002
        """Return an action space in whose dtypes an action, or a batch of actions, is exact."""
        return space

    def can_widen(self, space: SpaceT) -> bool:  # noqa: ARG002
        """Return whether there are actions for which `widened` returns another space."""
        return False


class _Text(Kind[spaces.Text]):
    def parts(self, space: spaces.Text, where: str, keys: Keys) -> Iterator[Part]:  # noqa: ARG002
        yield Part(keys, None, _checked_text)

    def from_json(self, space: spaces.Text, data: Value) -> Value:  # noqa: ARG002
        return str(data)

    def describe(self, space: spaces.Text) -> dict[str, object]:
        return {"type": "Text", "max_length": int(space.max_length)}

    def restore(self, description: Description) -> Space:
        length = max(int(description["max_length"]), 1)
        return spaces.Text(length, min_length=0, charset=string.printable)


def _checked_text(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{type(value).__name__} is not a text")
    return value


class _Box(Kind[SpaceT]):
    """A box, and any space of another library whose values are arrays of one shape and dtype."""

    name = "Box"

    def parts(self, space: SpaceT, where: str, keys: Keys) -> Iterator[Part]:
        dtype = np.dtype(space.dtype)
        if dtype.kind not in "biuf" or dtype.itemsize > 8:
            raise EnvironmentNotUsable(
                f"{where}: found {space} of dtype {dtype}, expected numbers of at most 64 bits."
            )
        yield Part(keys, np.dtype((dtype.newbyteorder("<"), space.shape or ())))

    def from_json(self, space: SpaceT, data: Value) -> Value:
        return self.batch(space, [data])[0]

    def batch(self, space: SpaceT, values: Value) -> Value:
        return np.array(_numbers_in(values), space.dtype).reshape(-1, *(space.shape or ()))

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
            np.broadcast_to(np.array(widest if bound is None else _numbers_in(bound), dtype), shape)
            for bound, widest in ((description["low"], least), (description["high"], most))
        )
        return spaces.Box(low, high, shape, dtype.type)

    def widened(self, space: SpaceT, value: object) -> Space:
        try:
            dtype = np.asarray(value).dtype
        except (TypeError, ValueError):
            return space
        if not isinstance(space, spaces.Box) or dtype.kind != "f" or dtype.itemsize > 8:
            return space
        if np.can_cast(dtype, space.dtype):
            return space
        return spaces.Box(space.low.astype(dtype), space.high.astype(dtype), dtype=dtype.type)

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


LEAVES: Final[dict[type[Space], Kind[Any]]] = {
    spaces.Text: _Text(),
    spaces.Discrete: _Discrete(),
    spaces.MultiDiscrete: _MultiDiscrete(),
    spaces.MultiBinary: _MultiBinary(),
    spaces.Box: _Box[Space](),
}
"""Gymnasium's spaces without parts."""


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


def _numbers_in(data: object) -> object:
    """Return nested numbers; in JSON, NaN and infinities are text."""
    if isinstance(data, list):
        return [_numbers_in(part) for part in data]
    return float(data) if isinstance(data, str) else data
