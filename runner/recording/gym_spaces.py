"""Gymnasium's spaces in a recording: a class for each kind, which describes, encodes and restores the space.

A new kind of space is a class here and an entry in `_KINDS`; a space of a user's own becomes one by
`register_space`:

    runner.register_space(Board, to_json=lambda board: board.cells, from_json=Board.of_cells)

Values are decoded in `spaces`, from the layout of their bytes, which needs no Gymnasium.
"""

from __future__ import annotations

import json
import string
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, Final, Generic, TypeVar

import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import iterate

from runner.environments.gym_types import Space
from runner.errors import ConfigError, EnvironmentNotUsable
from runner.recording.spaces import MAX_VALUE_BYTES, Description, Value
from runner.util.arrays import DType
from runner.util.jsonable import as_json
from runner.util.values import is_text

Keys = tuple[str | int, ...]
"""Keys of the `Dict`s and `Tuple`s around a space, from the outermost in."""
SpaceT = TypeVar("SpaceT", bound=Space)
_MAX_TEXT: Final = 4096
"""Declared length of the values of spaces that have no length of their own."""
_MAX_BOUNDS: Final = 64
"""The most different bounds of a box that are listed."""
_MAX_REPR: Final = 1000


def register_space(
    cls: type[Space], *, to_json: Callable[[object], object], from_json: Callable[[Value], object]
) -> None:
    """Record the values of a space of your own exactly, so that episodes with such actions can be repeated.

    Call it in the module that defines the space: it is then registered wherever the environment is made.
    Without it, values are recorded as text: strings unchanged, others as JSON or their `repr`.

    Args:
        cls: the class of the space.
        to_json: returns a value of it as numbers, texts, arrays, lists and mappings.
        from_json: returns the value for what `to_json` returned, in which arrays have become lists.

    Raises:
        ConfigError: it is no class of spaces, or one of Gymnasium's own.
    """
    if not (isinstance(cls, type) and issubclass(cls, spaces.Space)) or cls.__module__.startswith(
        "gymnasium."
    ):
        raise ConfigError(
            f"register_space: found {cls!r}, expected a subclass of gymnasium.Space of your own"
        )
    _KINDS[cls] = partial(_Registered, cls, to_json, from_json)


def recorded_space(space: Space) -> RecordedSpace[Any]:
    """Return a space as it is recorded."""
    for cls in type(space).__mro__:
        if cls in _KINDS:
            return _KINDS[cls](space)
    is_array = space.shape is not None and space.dtype is not None and np.dtype(space.dtype).kind in "biuf"
    return _Box(space) if is_array else RecordedSpace(space)


def checked_leaves(space: Space, where: str) -> list[tuple[Keys, RecordedSpace[Any]]]:
    """Return the parts of a space that have no parts themselves, in the order of its description.

    Raises:
        EnvironmentNotUsable: one of them cannot be recorded; the message names `where`.
    """
    leaves = list(recorded_space(space).leaves(where))
    size = sum(leaf.dtype.itemsize for _, leaf in leaves if leaf.dtype is not None)
    if size > MAX_VALUE_BYTES:
        raise EnvironmentNotUsable(
            f"{where} has values of {size:,} bytes, expected {MAX_VALUE_BYTES:,} at most: record a smaller "
            "observation by wrapping outside of the wrapper that makes it small."
        )
    return leaves


def restore_space(description: Description) -> Space:
    """Return the space that a recording describes; bounds and letters that are not listed are the widest.

    Raises:
        AssertionError, KeyError, TypeError, ValueError, OverflowError: Gymnasium has no such space.
    """
    return _RESTORABLE[description["type"]].restore(description)


def value_of(space: Space, text: str) -> object:
    """Return the value of a text that `RecordedSpace.text` returned, in the dtypes of the space.

    Raises:
        ValueError: it is no value of the space, or of one whose values do not come back from JSON.
    """
    try:
        return recorded_space(space).from_json(json.loads(text))
    except (TypeError, LookupError, AttributeError, OverflowError, RecursionError) as error:
        raise ValueError(f"{type(error).__name__}: {error}") from error


class RecordedSpace(Generic[SpaceT]):
    """A space as it is recorded; here one that Gymnasium knows nothing more of: its values become text.

    The text of a string is the string, of other values JSON, or their `repr`.
    """

    comes_from_text = False
    """Whether values are recorded as JSON that gives them back."""
    dtype: DType | None = None
    """The dtype of a leaf's values with their shape; None for values that are recorded as text."""

    def __init__(self, space: SpaceT) -> None:
        self.space = space

    def leaves(self, where: str) -> Iterator[tuple[Keys, RecordedSpace[Any]]]:  # noqa: ARG002
        """Yield the parts without parts, and their keys, in the order of the description.

        Raises:
            EnvironmentNotUsable: one of them cannot be recorded; the message names `where`.
        """
        yield (), self

    def text(self, value: Value) -> str:
        """Return a value as text.

        Raises:
            TypeError, ValueError, LookupError, AttributeError: it is not of the space.
        """
        is_plain = isinstance(value, str) and not self.comes_from_text
        return value if is_plain else json.dumps(self.to_json(value))

    def to_json(self, value: Value) -> Value:
        """Return a value as JSON can hold it."""
        return as_json(value)

    def from_json(self, data: Value) -> Value:  # noqa: ARG002
        """Return the value for what `to_json` returned, in the dtypes of the space."""
        raise ValueError(f"{type(self.space).__name__} is no space whose values come back from JSON")

    def batch(self, values: Value) -> Value:
        """Return many values, of which `to_json` returned these, as Gymnasium batches them."""
        return tuple(map(self.from_json, values))

    def describe(self) -> Description:
        """Return the space as JSON, which `runner.recording.spaces` reads."""
        text = {"type": "Text", "max_length": _MAX_TEXT, "holds": repr(self.space)[:_MAX_REPR]}
        structure = self.structure()
        return text | ({"space": structure} if structure else {})

    def structure(self) -> Description:
        """Return what describes the space of values that are recorded as text; empty if it is unknown."""
        return {}

    @classmethod
    def restore(cls, description: Description) -> Space:
        """Return the space that is described."""
        raise KeyError(description["type"])

    def widened(self, value: object) -> Space:  # noqa: ARG002
        """Return an action space in whose dtypes an action, or a batch of actions, is exact.

        Only floating-point actions widen a space: whole numbers that it cannot hold are a mistake.
        """
        return self.space

    def can_widen(self) -> bool:
        """Return whether there are actions for which `widened` returns another space."""
        return False


class _Composite(RecordedSpace[SpaceT]):
    """A `Dict` or a `Tuple`; `parts` by their keys."""

    parts: Mapping[Any, RecordedSpace[Any]]

    def leaves(self, where: str) -> Iterator[tuple[Keys, RecordedSpace[Any]]]:
        for key, part in self.parts.items():
            if not is_text(str(key)):
                raise EnvironmentNotUsable(
                    f"{where}: found a part called {str(key)[:40]!r}, expected a short, printable name."
                )
            for keys, leaf in part.leaves(where):
                yield (key, *keys), leaf

    def can_widen(self) -> bool:
        return any(part.can_widen() for part in self.parts.values())


class _Dict(_Composite[spaces.Dict]):
    def __init__(self, space: spaces.Dict) -> None:
        super().__init__(space)
        self.parts = {key: recorded_space(part) for key, part in space.spaces.items()}

    def to_json(self, value: Value) -> Value:
        return {str(key): part.to_json(value[key]) for key, part in self.parts.items()}

    def from_json(self, data: Value) -> Value:
        return {key: part.from_json(data[str(key)]) for key, part in self.parts.items()}

    def batch(self, values: Value) -> Value:
        return {key: part.batch([value[str(key)] for value in values]) for key, part in self.parts.items()}

    def describe(self) -> Description:
        return {"type": "Dict", "spaces": {str(key): part.describe() for key, part in self.parts.items()}}

    @classmethod
    def restore(cls, description: Description) -> Space:
        return spaces.Dict({name: restore_space(part) for name, part in description["spaces"].items()})

    def widened(self, value: object) -> Space:
        if not isinstance(value, Mapping):
            return self.space
        wide = {
            key: part.widened(value[key]) if key in value else part.space for key, part in self.parts.items()
        }
        is_same = all(wide[key] is part.space for key, part in self.parts.items())
        return self.space if is_same else spaces.Dict(wide)


class _Tuple(_Composite["spaces.Tuple[Any]"]):
    def __init__(self, space: spaces.Tuple[Any]) -> None:
        super().__init__(space)
        self.parts = dict(enumerate(map(recorded_space, space.spaces)))

    def to_json(self, value: Value) -> Value:
        return [part.to_json(item) for part, item in zip(self.parts.values(), value, strict=True)]

    def from_json(self, data: Value) -> Value:
        return tuple(part.from_json(item) for part, item in zip(self.parts.values(), data, strict=True))

    def batch(self, values: Value) -> Value:
        return tuple(part.batch([value[i] for value in values]) for i, part in self.parts.items())

    def describe(self) -> Description:
        return {"type": "Tuple", "spaces": [part.describe() for part in self.parts.values()]}

    @classmethod
    def restore(cls, description: Description) -> Space:
        return spaces.Tuple(map(restore_space, description["spaces"]))

    def widened(self, value: object) -> Space:
        if not isinstance(value, Sequence):
            return self.space
        wide = [part.widened(item) for part, item in zip(self.parts.values(), value, strict=False)]
        is_same = all(part.space is space for part, space in zip(self.parts.values(), wide, strict=False))
        return self.space if is_same else spaces.Tuple(wide)


class _Sequence(RecordedSpace[spaces.Sequence]):
    comes_from_text = True

    def __init__(self, space: spaces.Sequence) -> None:
        super().__init__(space)
        self.part = recorded_space(space.feature_space)

    def to_json(self, value: Value) -> Value:
        values = iterate(self.space.stacked_feature_space, value) if self.space.stack else value
        return [*map(self.part.to_json, values)]

    def from_json(self, data: Value) -> Value:
        return self.part.batch(data) if self.space.stack else tuple(map(self.part.from_json, data))

    def structure(self) -> Description:
        return {"type": "Sequence", "space": self.part.describe(), "stack": bool(self.space.stack)}


class _OneOf(RecordedSpace["spaces.OneOf[Any]"]):
    comes_from_text = True

    def __init__(self, space: spaces.OneOf[Any]) -> None:
        super().__init__(space)
        self.parts = [*map(recorded_space, space.spaces)]

    def to_json(self, value: Value) -> Value:
        index = int(value[0])
        return [index, self.parts[index].to_json(value[1])]

    def from_json(self, data: Value) -> Value:
        if not 0 <= data[0] < len(self.parts):
            raise ValueError(f"found the part {data[0]} of {self.space}")
        return np.int64(data[0]), self.parts[data[0]].from_json(data[1])

    def structure(self) -> Description:
        return {"type": "OneOf", "spaces": [part.describe() for part in self.parts]}


class _Graph(RecordedSpace[spaces.Graph]):
    comes_from_text = True

    def __init__(self, space: spaces.Graph) -> None:
        super().__init__(space)
        self.node = recorded_space(space.node_space)
        self.edge = None if space.edge_space is None else recorded_space(space.edge_space)

    def to_json(self, value: Value) -> Value:
        nodes, edges = (
            None if part is None or items is None else [*map(part.to_json, items)]
            for part, items in ((self.node, value.nodes), (self.edge, value.edges))
        )
        return {"nodes": nodes, "edges": edges, "edge_links": as_json(value.edge_links)}

    def from_json(self, data: Value) -> Value:
        edges, links = data["edges"], data["edge_links"]
        return spaces.GraphInstance(
            nodes=self.node.batch(data["nodes"]),
            edges=None if edges is None or self.edge is None else self.edge.batch(edges),
            edge_links=None if links is None else np.array(links, np.int64).reshape(-1, 2),
        )

    def structure(self) -> Description:
        edge = None if self.edge is None else self.edge.describe()
        return {"type": "Graph", "node_space": self.node.describe(), "edge_space": edge}


class _Registered(RecordedSpace[Space]):
    """A space of a user's own."""

    comes_from_text = True

    def __init__(
        self,
        cls: type[Space],
        to_json: Callable[[object], object],
        from_json: Callable[[Value], object],
        space: Space,
    ) -> None:
        super().__init__(space)
        self._cls = cls
        self._to_json = to_json
        self._from_json = from_json

    def to_json(self, value: Value) -> Value:
        return as_json(self._to_json(value))

    def from_json(self, data: Value) -> Value:
        return self._from_json(data)

    def structure(self) -> Description:
        return {"type": f"{self._cls.__module__}:{self._cls.__qualname__}"}


class _Text(RecordedSpace[spaces.Text]):
    def text(self, value: Value) -> str:
        if not isinstance(value, str):
            raise TypeError(f"{type(value).__name__} is not a text")
        return value

    def from_json(self, data: Value) -> Value:
        return str(data)

    def describe(self) -> Description:
        return {"type": "Text", "max_length": int(self.space.max_length)}

    @classmethod
    def restore(cls, description: Description) -> Space:
        length = max(int(description["max_length"]), 1)
        return spaces.Text(length, min_length=0, charset=string.printable)


class _Box(RecordedSpace[SpaceT]):
    """A box, and any space of another library whose values are arrays of one shape and dtype."""

    name = "Box"
    dtype: DType

    def __init__(self, space: SpaceT) -> None:
        super().__init__(space)
        self.dtype = np.dtype((np.dtype(space.dtype).newbyteorder("<"), space.shape or ()))

    def leaves(self, where: str) -> Iterator[tuple[Keys, RecordedSpace[Any]]]:
        number = self.dtype.base
        if number.kind not in "biuf" or number.itemsize > 8:
            raise EnvironmentNotUsable(
                f"{where}: found {self.space} of dtype {number}, expected numbers of at most 64 bits."
            )
        yield (), self

    def from_json(self, data: Value) -> Value:
        return self.batch([data])[0]

    def batch(self, values: Value) -> Value:
        return np.array(_numbers_in(values), self.space.dtype).reshape(-1, *self.dtype.shape)

    def describe(self) -> Description:
        layout = {"dtype": self.dtype.base.str, "shape": list(self.dtype.shape)}
        return {"type": self.name, **layout, **self.details()}

    def details(self) -> Description:
        """Return what describes the space besides its dtype and shape."""
        return {name: _bound(getattr(self.space, name, None)) for name in ("low", "high")}

    @classmethod
    def restore(cls, description: Description) -> Space:
        dtype = _dtype(description)
        shape = tuple(description["shape"])
        if dtype.kind == "f":
            least, most = -np.inf, np.inf
        else:
            least, most = (0, 1) if dtype.kind == "b" else (np.iinfo(dtype).min, np.iinfo(dtype).max)
        low, high = (
            np.broadcast_to(np.array(widest if bound is None else _numbers_in(bound), dtype), shape)
            for bound, widest in ((description["low"], least), (description["high"], most))
        )
        return spaces.Box(low, high, shape, dtype.type)

    def widened(self, value: object) -> Space:
        space: Any = self.space
        try:
            dtype = np.asarray(value).dtype
        except (TypeError, ValueError):
            return self.space
        is_wider = dtype.kind == "f" and dtype.itemsize <= 8 and not np.can_cast(dtype, space.dtype)
        if not (is_wider and self.can_widen()):
            return self.space
        return spaces.Box(space.low.astype(dtype), space.high.astype(dtype), dtype=dtype.type)

    def can_widen(self) -> bool:
        return isinstance(self.space, spaces.Box) and not np.can_cast(np.float64, self.space.dtype)


class _Discrete(_Box[spaces.Discrete]):
    name = "Discrete"

    def details(self) -> Description:
        return {"n": int(self.space.n), "start": int(self.space.start)}

    @classmethod
    def restore(cls, description: Description) -> Space:
        return spaces.Discrete(int(description["n"]), start=int(description["start"]))


class _MultiDiscrete(_Box[spaces.MultiDiscrete]):
    name = "MultiDiscrete"

    def details(self) -> Description:
        return {"nvec": np.asarray(self.space.nvec).tolist()}

    @classmethod
    def restore(cls, description: Description) -> Space:
        return spaces.MultiDiscrete(np.array(description["nvec"]), dtype=_dtype(description).type)


class _MultiBinary(_Box[spaces.MultiBinary]):
    name = "MultiBinary"

    def details(self) -> Description:
        return {}

    @classmethod
    def restore(cls, description: Description) -> Space:
        shape = tuple(description["shape"])
        return spaces.MultiBinary(shape[0] if len(shape) == 1 else shape)


_RESTORABLE: Final[Mapping[str, type[RecordedSpace[Any]]]] = {
    "Dict": _Dict,
    "Tuple": _Tuple,
    "Text": _Text,
    "Discrete": _Discrete,
    "MultiDiscrete": _MultiDiscrete,
    "MultiBinary": _MultiBinary,
    "Box": _Box,
}
"""The kinds of spaces that a description can have as its `type`; values of the others are texts."""
_KINDS: Final[dict[type[Space], Callable[[Any], RecordedSpace[Any]]]] = {
    spaces.Graph: _Graph,
    spaces.Sequence: _Sequence,
    spaces.OneOf: _OneOf,
    **{getattr(spaces, name): kind for name, kind in _RESTORABLE.items()},
}


def _dtype(description: Description) -> DType:
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
