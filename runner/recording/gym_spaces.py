"""Gymnasium's spaces in a recording: a class for each kind, which describes, encodes and restores the space.

A new kind of space is a class here, and an entry in `_KINDS`, and in `_RESTORE` unless its values are texts;
a space of a user's own becomes one by `register_space`:

    runner.register_space(Board, to_json=lambda board: board.cells, from_json=Board.of_cells)

Values are decoded in `spaces`, from the layout of their bytes, which needs no Gymnasium.
"""

from __future__ import annotations

import json
import string
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
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
    return _Numbers(space) if is_array else RecordedSpace(space)


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
    return _RESTORE[description["type"]](description)


def _restored_box(description: Description) -> spaces.Box:
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
    """A space as it is recorded. The base class is for spaces unknown to Gymnasium: values become text.

    The text of a string is the string, of other values JSON, or their `repr`.

    Args:
        structure: describes the space of values that are recorded as JSON which gives them back.
    """

    dtype: DType | None = None
    """The dtype of a leaf's values with their shape; None for values that are recorded as text."""

    def __init__(self, space: SpaceT, structure: Description | None = None) -> None:
        self.space = space
        self._structure = structure
        self.comes_from_text = structure is not None
        """Whether values are recorded as JSON that gives them back."""

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
        return text if self._structure is None else text | {"space": self._structure}

    def widened(self, value: object) -> Space:  # noqa: ARG002
        """Return an action space in whose dtypes an action, or a batch of actions, is exact.

        Only floating-point actions widen a space: whole numbers that it cannot hold are a mistake.
        """
        return self.space

    def can_widen(self) -> bool:
        """Return whether there are actions for which `widened` returns another space."""
        return False


class _Composite(RecordedSpace[Space]):
    """A `Dict` or a `Tuple`."""

    def __init__(self, space: spaces.Dict | spaces.Tuple[Any]) -> None:
        super().__init__(space)
        self.is_dict = isinstance(space, spaces.Dict)
        parts = space.spaces.items() if isinstance(space, spaces.Dict) else enumerate(space.spaces)
        self.parts: dict[Any, RecordedSpace[Any]] = {key: recorded_space(part) for key, part in parts}

    def _composed(self, parts: Iterable[object]) -> Any:
        """Return a value with these parts, in order."""
        return dict(zip(self.parts, parts, strict=True)) if self.is_dict else tuple(parts)

    def leaves(self, where: str) -> Iterator[tuple[Keys, RecordedSpace[Any]]]:
        for key, part in self.parts.items():
            if not is_text(str(key)):
                raise EnvironmentNotUsable(
                    f"{where}: found a part called {str(key)[:40]!r}, expected a short, printable name."
                )
            for keys, leaf in part.leaves(where):
                yield (key, *keys), leaf

    def to_json(self, value: Value) -> Value:
        if self.is_dict:
            return {str(key): part.to_json(value[key]) for key, part in self.parts.items()}
        return [part.to_json(item) for part, item in zip(self.parts.values(), value, strict=True)]

    def from_json(self, data: Value) -> Value:
        given = [data[str(key)] for key in self.parts] if self.is_dict else data
        return self._composed(
            [part.from_json(item) for part, item in zip(self.parts.values(), given, strict=True)]
        )

    def batch(self, values: Value) -> Value:
        names = map(str, self.parts) if self.is_dict else self.parts
        return self._composed(
            [
                part.batch([value[name] for value in values])
                for part, name in zip(self.parts.values(), names, strict=True)
            ]
        )

    def describe(self) -> Description:
        described = {str(key): part.describe() for key, part in self.parts.items()}
        kind = "Dict" if self.is_dict else "Tuple"
        return {"type": kind, "spaces": described if self.is_dict else [*described.values()]}

    def widened(self, value: Any) -> Space:
        if not isinstance(value, Mapping if self.is_dict else Sequence):
            return self.space
        items = value if self.is_dict else dict(enumerate(value))
        wide = [part.widened(items[key]) if key in items else part.space for key, part in self.parts.items()]
        if all(part.space is space for part, space in zip(self.parts.values(), wide, strict=True)):
            return self.space
        return spaces.Dict(self._composed(wide)) if self.is_dict else spaces.Tuple(wide)

    def can_widen(self) -> bool:
        return any(part.can_widen() for part in self.parts.values())


class _Sequence(RecordedSpace[spaces.Sequence]):
    def __init__(self, space: spaces.Sequence) -> None:
        self.part = recorded_space(space.feature_space)
        structure = {"type": "Sequence", "space": self.part.describe(), "stack": bool(space.stack)}
        super().__init__(space, structure)

    def to_json(self, value: Value) -> Value:
        values = iterate(self.space.stacked_feature_space, value) if self.space.stack else value
        return [*map(self.part.to_json, values)]

    def from_json(self, data: Value) -> Value:
        return self.part.batch(data) if self.space.stack else tuple(map(self.part.from_json, data))


class _OneOf(RecordedSpace["spaces.OneOf[Any]"]):
    def __init__(self, space: spaces.OneOf[Any]) -> None:
        self.parts = [*map(recorded_space, space.spaces)]
        super().__init__(space, {"type": "OneOf", "spaces": [part.describe() for part in self.parts]})

    def to_json(self, value: Value) -> Value:
        index = int(value[0])
        return [index, self.parts[index].to_json(value[1])]

    def from_json(self, data: Value) -> Value:
        if not 0 <= data[0] < len(self.parts):
            raise ValueError(f"found the part {data[0]} of {self.space}")
        return np.int64(data[0]), self.parts[data[0]].from_json(data[1])


class _Graph(RecordedSpace[spaces.Graph]):
    def __init__(self, space: spaces.Graph) -> None:
        self.node = recorded_space(space.node_space)
        self.edge = None if space.edge_space is None else recorded_space(space.edge_space)
        edge = None if self.edge is None else self.edge.describe()
        super().__init__(space, {"type": "Graph", "node_space": self.node.describe(), "edge_space": edge})

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


class _Registered(RecordedSpace[Space]):
    """A space of a user's own."""

    def __init__(
        self,
        cls: type[Space],
        to_json: Callable[[object], object],
        from_json: Callable[[Value], object],
        space: Space,
    ) -> None:
        super().__init__(space, {"type": f"{cls.__module__}:{cls.__qualname__}"})
        self._to_json = to_json
        self._from_json = from_json

    def to_json(self, value: Value) -> Value:
        return as_json(self._to_json(value))

    def from_json(self, data: Value) -> Value:
        return self._from_json(data)


class _Text(RecordedSpace[spaces.Text]):
    def text(self, value: Value) -> str:
        if not isinstance(value, str):
            raise TypeError(f"{type(value).__name__} is not a text")
        return value

    def from_json(self, data: Value) -> Value:
        return str(data)

    def describe(self) -> Description:
        return {"type": "Text", "max_length": int(self.space.max_length)}


class _Numbers(RecordedSpace[Space]):
    """A space, also of another library, whose values are numbers or arrays of one shape and dtype."""

    dtype: DType

    def __init__(self, space: Space) -> None:
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
        return np.array(_numbers_in(values), self.space.dtype).reshape(len(values), *self.dtype.shape)

    def describe(self) -> Description:
        layout = {"dtype": self.dtype.base.str, "shape": list(self.dtype.shape)}
        match self.space:
            case spaces.Discrete():
                return {"type": "Discrete", **layout, "n": int(self.space.n), "start": int(self.space.start)}
            case spaces.MultiDiscrete():
                return {"type": "MultiDiscrete", **layout, "nvec": np.asarray(self.space.nvec).tolist()}
            case spaces.MultiBinary():
                return {"type": "MultiBinary", **layout}
        bounds = {name: _bound(getattr(self.space, name, None)) for name in ("low", "high")}
        return {"type": "Box", **layout, **bounds}

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


_KINDS: Final[dict[type[Space], Callable[[Any], RecordedSpace[Any]]]] = {
    spaces.Dict: _Composite,
    spaces.Tuple: _Composite,
    spaces.Graph: _Graph,
    spaces.Sequence: _Sequence,
    spaces.OneOf: _OneOf,
    spaces.Text: _Text,
    **dict.fromkeys((spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary), _Numbers),
}


_RESTORE: Final[Mapping[str, Callable[[Description], Space]]] = {
    "Dict": lambda dict_: spaces.Dict({name: restore_space(part) for name, part in dict_["spaces"].items()}),
    "Tuple": lambda tuple_: spaces.Tuple(map(restore_space, tuple_["spaces"])),
    "Text": lambda text: spaces.Text(max(int(text["max_length"]), 1), min_length=0, charset=string.printable),
    "Discrete": lambda discrete: spaces.Discrete(int(discrete["n"]), start=int(discrete["start"])),
    "MultiDiscrete": lambda many: spaces.MultiDiscrete(np.array(many["nvec"]), dtype=_dtype(many).type),
    "MultiBinary": lambda binary: spaces.MultiBinary(
        binary["shape"][0] if len(binary["shape"]) == 1 else tuple(binary["shape"])
    ),
    "Box": _restored_box,
}
"""The kinds of spaces that a description can have as its `type`; values of the others are texts."""


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
