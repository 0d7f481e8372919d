"""Gymnasium's spaces in a recording: one class each, which describes, encodes and restores the space.

A new kind of space is a class here, or in `gym_leaves` if it has no parts, and an entry in `_KINDS`; a space
of a user's own becomes one by `register_space`:

    runner.register_space(Board, to_json=lambda board: board.cells, from_json=Board.of_cells)

Values are decoded in `spaces`, from the layout of their bytes, which needs no Gymnasium.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import iterate

from runner.environments.gym_types import Space
from runner.errors import ConfigError, EnvironmentNotUsable
from runner.recording.gym_leaves import LEAVES, Keys, Kind, Part
from runner.recording.spaces import MAX_VALUE_BYTES, Description, Value
from runner.util.jsonable import as_json
from runner.util.values import is_text


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
    _KINDS[cls] = _Registered(cls, to_json, from_json)


def parts_of(space: Space, where: str) -> list[Part]:
    """Return the parts of a space in the order of its description.

    Raises:
        EnvironmentNotUsable: one of them cannot be recorded; the message names `where`.
    """
    parts = list(_kind_of(space).parts(space, where, ()))
    size = sum(part.dtype.itemsize for part in parts if part.dtype is not None)
    if size > MAX_VALUE_BYTES:
        raise EnvironmentNotUsable(
            f"{where} has values of {size:,} bytes, expected {MAX_VALUE_BYTES:,} at most: record a smaller "
            "observation by wrapping outside of the wrapper that makes it small."
        )
    return parts


def describe_space(space: Space) -> dict[str, object]:
    """Return a space as JSON, which `runner.recording.spaces` reads; `parts_of` has accepted the space."""
    return _kind_of(space).describe(space)


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
    return _kind_of(space).widened(space, value)


def can_widen(space: Space) -> bool:
    """Return whether there are actions for which `widened` returns another space."""
    return _kind_of(space).can_widen(space)


def comes_from_text(space: Space) -> bool:
    """Return whether values of a space are recorded as text that gives them back."""
    return _kind_of(space).from_text


def text_of(space: Space, value: object) -> str:
    """Return a value as text: a string of an unknown space as it is, other values as JSON.

    Raises:
        TypeError, ValueError, LookupError, AttributeError: it is not of the space.
    """
    return _kind_of(space).text(space, value)


def value_of(space: Space, text: str) -> object:
    """Return the value of a text that `text_of` returned, in the dtypes of the space.

    Raises:
        ValueError: it is no value of the space, or of one whose values do not come back from JSON.
    """
    try:
        return _from_json(space, json.loads(text))
    except (TypeError, LookupError, AttributeError, OverflowError, RecursionError) as error:
        raise ValueError(f"{type(error).__name__}: {error}") from error


def _to_json(space: Space, value: Value) -> Value:
    return _kind_of(space).to_json(space, value)


def _from_json(space: Space, data: Value) -> Value:
    return _kind_of(space).from_json(space, data)


def _batch(space: Space, values: Value) -> Value:
    return _kind_of(space).batch(space, values)


class _Dict(Kind[spaces.Dict]):
    def parts(self, space: spaces.Dict, where: str, keys: Keys) -> Iterator[Part]:
        for key, part in space.spaces.items():
            if not is_text(str(key)):
                raise EnvironmentNotUsable(
                    f"{where}: found a part called {str(key)[:40]!r}, expected a short, printable name."
                )
            yield from _kind_of(part).parts(part, where, (*keys, key))

    def to_json(self, space: spaces.Dict, value: Value) -> Value:
        return {str(key): _to_json(part, value[key]) for key, part in space.spaces.items()}

    def from_json(self, space: spaces.Dict, data: Value) -> Value:
        return {key: _from_json(part, data[str(key)]) for key, part in space.spaces.items()}

    def batch(self, space: spaces.Dict, values: Value) -> Value:
        return {key: _batch(part, [own[str(key)] for own in values]) for key, part in space.spaces.items()}

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


class _Tuple(Kind["spaces.Tuple[Any]"]):
    def parts(self, space: spaces.Tuple[Any], where: str, keys: Keys) -> Iterator[Part]:
        for i, part in enumerate(space.spaces):
            yield from _kind_of(part).parts(part, where, (*keys, i))

    def to_json(self, space: spaces.Tuple[Any], value: Value) -> Value:
        return [_to_json(part, own) for part, own in zip(space.spaces, value, strict=True)]

    def from_json(self, space: spaces.Tuple[Any], data: Value) -> Value:
        return tuple(_from_json(part, own) for part, own in zip(space.spaces, data, strict=True))

    def batch(self, space: spaces.Tuple[Any], values: Value) -> Value:
        return tuple(_batch(part, [own[i] for own in values]) for i, part in enumerate(space.spaces))

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


class _Sequence(Kind[spaces.Sequence]):
    from_text = True

    def to_json(self, space: spaces.Sequence, value: Value) -> Value:
        values = iterate(space.stacked_feature_space, value) if space.stack else value
        return [_to_json(space.feature_space, own) for own in values]

    def from_json(self, space: spaces.Sequence, data: Value) -> Value:
        if space.stack:
            return _batch(space.feature_space, data)
        return tuple(_from_json(space.feature_space, own) for own in data)

    def structure(self, space: spaces.Sequence) -> Mapping[str, object]:
        parts = {"space": describe_space(space.feature_space), "stack": bool(space.stack)}
        return {"type": "Sequence", **parts}


class _OneOf(Kind["spaces.OneOf[Any]"]):
    from_text = True

    def to_json(self, space: spaces.OneOf[Any], value: Value) -> Value:
        index = int(value[0])
        return [index, _to_json(space.spaces[index], value[1])]

    def from_json(self, space: spaces.OneOf[Any], data: Value) -> Value:
        if not 0 <= data[0] < len(space.spaces):
            raise ValueError(f"found the part {data[0]} of {space}")
        return np.int64(data[0]), _from_json(space.spaces[data[0]], data[1])

    def structure(self, space: spaces.OneOf[Any]) -> Mapping[str, object]:
        return {"type": "OneOf", "spaces": [describe_space(part) for part in space.spaces]}


class _Graph(Kind[spaces.Graph]):
    from_text = True

    def to_json(self, space: spaces.Graph, value: Value) -> Value:
        nodes, edges = (
            None if part is None or own is None else [_to_json(part, each) for each in own]
            for part, own in ((space.node_space, value.nodes), (space.edge_space, value.edges))
        )
        return {"nodes": nodes, "edges": edges, "edge_links": as_json(value.edge_links)}

    def from_json(self, space: spaces.Graph, data: Value) -> Value:
        nodes, edges, links = (data[name] for name in ("nodes", "edges", "edge_links"))
        edge_space = space.edge_space
        return spaces.GraphInstance(
            nodes=_batch(space.node_space, nodes),
            edges=None if edges is None or edge_space is None else _batch(edge_space, edges),
            edge_links=None if links is None else np.array(links, np.int64).reshape(-1, 2),
        )

    def structure(self, space: spaces.Graph) -> Mapping[str, object]:
        edges = None if space.edge_space is None else describe_space(space.edge_space)
        return {"type": "Graph", "node_space": describe_space(space.node_space), "edge_space": edges}


class _Registered(Kind[Space]):
    """A space of a user's own."""

    from_text = True

    def __init__(
        self, cls: type[Space], to_json: Callable[[object], object], from_json: Callable[[Value], object]
    ) -> None:
        self._cls = cls
        self._to_json = to_json
        self._from_json = from_json

    def to_json(self, space: Space, value: Value) -> Value:  # noqa: ARG002
        return as_json(self._to_json(value))

    def from_json(self, space: Space, data: Value) -> Value:  # noqa: ARG002
        return self._from_json(data)

    def structure(self, space: Space) -> Mapping[str, object]:  # noqa: ARG002
        return {"type": f"{self._cls.__module__}:{self._cls.__qualname__}"}


_UNKNOWN: Final = Kind[Space]()
_KINDS: Final[dict[type[Space], Kind[Any]]] = {
    spaces.Dict: _Dict(),
    spaces.Tuple: _Tuple(),
    spaces.Graph: _Graph(),
    spaces.Sequence: _Sequence(),
    spaces.OneOf: _OneOf(),
    **LEAVES,
}
_BY_NAME: Final = {cls.__name__: kind for cls, kind in _KINDS.items()}


def _kind_of(space: Space) -> Kind[Any]:
    for cls in type(space).__mro__:
        if cls in _KINDS:
            return _KINDS[cls]
    has_layout = space.shape is not None and space.dtype is not None
    return _KINDS[spaces.Box] if has_layout and np.dtype(space.dtype).kind in "biuf" else _UNKNOWN
