"""Values of Gymnasium's spaces as JSON, and back: of the spaces whose values have no layout of their own.

runner.register_space(Board, to_json=lambda board: board.cells, from_json=Board.of_cells)
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import iterate

from runner.environments.gym_types import Space
from runner.errors import ConfigError
from runner.recording.spaces import Value
from runner.util.jsonable import as_json

_MAX_REPR: Final = 1000


class _Registered(NamedTuple):
    to_json: Callable[[object], object]
    from_json: Callable[[Value], object]


_REGISTERED: Final[dict[type[Space], _Registered]] = {}


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
    _REGISTERED[cls] = _Registered(to_json, from_json)


def registered(space: Space) -> type[Space] | None:
    """Return the registered class that a space is of; None if there is none."""
    return next((kind for kind in type(space).__mro__ if kind in _REGISTERED), None)


def text_of(space: Space, value: object) -> str:
    """Return a value as text: a string of an unknown space as it is, other values as JSON.

    Raises:
        TypeError, ValueError, LookupError, AttributeError: it is not of the space.
    """
    is_plain = registered(space) is None and not isinstance(
        space, spaces.Graph | spaces.OneOf | spaces.Sequence
    )
    return value if is_plain and isinstance(value, str) else json.dumps(_to_json(space, value))


def value_of(space: Space, text: str) -> object:
    """Return the value of a text that `text_of` returned, in the dtypes of the space.

    Raises:
        ValueError: it is no value of the space, or of one whose values do not come back from JSON.
    """
    try:
        return _from_json(space, json.loads(text))
    except (TypeError, LookupError, AttributeError, OverflowError, RecursionError) as error:
        raise ValueError(f"{type(error).__name__}: {error}") from error


def structure_of(space: Space, describe: Callable[[Space], object]) -> Mapping[str, object]:
    """Return what describes a space whose values are recorded as text."""
    kind, own = registered(space), {"holds": repr(space)[:_MAX_REPR]}
    if kind is not None:
        return own | {"space": {"type": f"{kind.__module__}:{kind.__qualname__}"}}
    if isinstance(space, spaces.Sequence):
        parts = {"space": describe(space.feature_space), "stack": bool(space.stack)}
        return own | {"space": {"type": "Sequence", **parts}}
    if isinstance(space, spaces.OneOf):
        return own | {"space": {"type": "OneOf", "spaces": [describe(part) for part in space.spaces]}}
    if isinstance(space, spaces.Graph):
        edges = None if space.edge_space is None else describe(space.edge_space)
        parts = {"node_space": describe(space.node_space), "edge_space": edges}
        return own | {"space": {"type": "Graph", **parts}}
    return own


def _to_json(space: Any, value: Value) -> Value:  # noqa: PLR0911 - one for each kind of space
    if (kind := registered(space)) is not None:
        return as_json(_REGISTERED[kind].to_json(value))
    if isinstance(space, spaces.Dict):
        return {str(key): _to_json(part, value[key]) for key, part in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return [_to_json(part, own) for part, own in zip(space.spaces, value, strict=True)]
    if isinstance(space, spaces.Sequence):
        values = iterate(space.stacked_feature_space, value) if space.stack else value
        return [_to_json(space.feature_space, own) for own in values]
    if isinstance(space, spaces.OneOf):
        index = int(value[0])
        return [index, _to_json(space.spaces[index], value[1])]
    if isinstance(space, spaces.Graph):
        nodes, edges = (
            None if part is None or own is None else [_to_json(part, each) for each in own]
            for part, own in ((space.node_space, value.nodes), (space.edge_space, value.edges))
        )
        return {"nodes": nodes, "edges": edges, "edge_links": as_json(value.edge_links)}
    return as_json(value)


def _from_json(space: Any, data: Value) -> Value:  # noqa: PLR0911 - one for each kind of space
    if (kind := registered(space)) is not None:
        return _REGISTERED[kind].from_json(data)
    if isinstance(space, spaces.Dict):
        return {key: _from_json(part, data[str(key)]) for key, part in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(_from_json(part, own) for part, own in zip(space.spaces, data, strict=True))
    if isinstance(space, spaces.Text):
        return str(data)
    if isinstance(space, spaces.Sequence):
        if space.stack:
            return _batch(space.feature_space, data)
        return tuple(_from_json(space.feature_space, own) for own in data)
    if isinstance(space, spaces.OneOf):
        if not 0 <= data[0] < len(space.spaces):
            raise ValueError(f"found the part {data[0]} of {space}")
        return np.int64(data[0]), _from_json(space.spaces[data[0]], data[1])
    if isinstance(space, spaces.Graph):
        nodes, edges, links = (data[name] for name in ("nodes", "edges", "edge_links"))
        return spaces.GraphInstance(
            nodes=_batch(space.node_space, nodes),
            edges=None if edges is None else _batch(space.edge_space, edges),
            edge_links=None if links is None else np.array(links, np.int64).reshape(-1, 2),
        )
    return _batch(space, [data])[0]


def _batch(space: Any, values: Value) -> Value:
    """Return many values as Gymnasium batches them."""
    if isinstance(space, spaces.Dict):
        return {key: _batch(part, [own[str(key)] for own in values]) for key, part in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(_batch(part, [own[i] for own in values]) for i, part in enumerate(space.spaces))
    if space.shape is None or np.dtype(space.dtype).kind not in "biuf" or registered(space) is not None:
        return tuple(_from_json(space, own) for own in values)
    return np.array(numbers_in(values), space.dtype).reshape(-1, *space.shape)


def numbers_in(data: object) -> object:
    """Return nested numbers; in JSON, NaN and infinities are text."""
    if isinstance(data, list):
        return [numbers_in(part) for part in data]
    return float(data) if isinstance(data, str) else data
