"""Gymnasium's spaces and environments, described as a recording carries them."""

from __future__ import annotations

import dataclasses
import json
import math
import os
from argparse import Namespace
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
from gymnasium import spaces

from runner.environments.loading import mdp_of
from runner.environments.mdp import Mdp
from runner.errors import EnvironmentNotUsable
from runner.recording.spaces import MAX_VALUE_BYTES
from runner.util.values import is_text

Keys = tuple[str | int, ...]
_STATES: Final = 2**32
"""The message for two `Discrete` spaces holds smaller numbers than this; larger spaces take `Transition`."""
_MAX_TEXT: Final = 4096
"""Length that is declared for values of spaces that have no length of their own."""
_BOUNDS_LISTED: Final = 64
"""Bounds of a box are told one by one up to so many; of a larger box only if all are the same."""


@dataclass(frozen=True)
class Part:
    """A leaf of a space: how to get at it in a value, its dtype or how to make a text of it."""

    keys: Keys
    fields: tuple[str, ...]
    """The names of the same way in NumPy's records."""
    dtype: np.dtype[Any] | None
    """The dtype of an array, its shape included; None for what is recorded as text."""
    text: Callable[[Any], str] | None = None
    """Makes the text that is recorded; None for an array."""

    def of(self, value: Any) -> Any:
        """Return the part that it is of a value of the space."""
        for key in self.keys:
            value = value[key]
        return value


@dataclass(frozen=True)
class Described:
    """What is to be said of an environment and its spaces."""

    kind: str
    """One of `schema.LOOP_TOPICS`."""
    observation: spaces.Space[Any]
    action: spaces.Space[Any]
    env_id: str
    kwargs: dict[str, Any]
    step_limit: int
    agents: tuple[str, ...]
    """Who is paid: one reward column each."""
    environments: int = 1
    mdp: Mdp | None = None
    """The environment's arrays, if it is tabular."""
    wide_action: spaces.Space[Any] | None = None
    """The action space in the dtype of the actions that came, if that is wider than its own."""

    @property
    def recorded_action(self) -> spaces.Space[Any]:
        """The action space in the dtype in which actions are recorded."""
        return self.action if self.wide_action is None else self.wide_action

    def spaces(self) -> dict[str, Any]:
        """Return the descriptions of both spaces."""
        return {
            name: describe_space(space, f"the {name} space of {self.env_id}")
            for name, space in (("observation", self.observation), ("action", self.recorded_action))
        }


def describe(env: Any, observation: spaces.Space[Any], action: spaces.Space[Any]) -> Described:
    """Return what is to be said of a Gymnasium environment with these spaces.

    Raises:
        EnvironmentNotUsable: one of its spaces cannot be recorded.
    """
    env_id, kwargs, step_limit = _registration(env)
    kind, mdp = kind_of(observation, action), None
    if kind == "step":
        mdp = _tabular(env, kwargs, observation, action)
    joint = mdp is not None and len(mdp.agents) > 1
    return Described(
        kind=kind,
        observation=observation,
        action=action,
        env_id=env_id,
        kwargs=kwargs,
        step_limit=step_limit,
        agents=("agency" if joint else mdp.agents[0] if mdp is not None else "agent",),
        mdp=mdp,
    )


_NOT_SETTINGS: Final = frozenset({"num_envs", "vectorization_mode", "vector_kwargs", "wrappers", "base_path"})
"""What `gymnasium.make_vec` and EnvPool add to an environment's own settings."""


def _registration(env: Any) -> tuple[str, dict[str, Any], int]:
    """Return an environment's id, keyword arguments and step limit, as far as it is registered.

    EnvPool's specification has a `config` and no id.
    """
    spec = getattr(env, "spec", None)
    given = getattr(spec, "kwargs", None)
    if not isinstance(given, Mapping):
        given = getattr(spec, "config", None)
        if callable(as_dict := getattr(given, "_asdict", None)):
            given = as_dict()
    try:
        kwargs = as_json({key: value for key, value in dict(given or {}).items() if key not in _NOT_SETTINGS})
    except (TypeError, ValueError, RecursionError):
        kwargs = {}
    name = getattr(spec, "id", None)
    limit = getattr(spec, "max_episode_steps", None) or kwargs.get("max_episode_steps")
    return (
        name if isinstance(name, str) else type(getattr(env, "unwrapped", env)).__qualname__,
        kwargs,
        limit if isinstance(limit, int) and limit > 0 else 0,
    )


def kind_of(observation: spaces.Space[Any], action: spaces.Space[Any]) -> str:
    """Return which of `schema.LOOP_TOPICS` a recording of these spaces has.

    Raises:
        EnvironmentNotUsable: one of them cannot be recorded.
    """
    parts = [
        *parts_of(observation, "the observation space"),
        *parts_of(action, "the action space"),
    ]
    if type(observation) is type(action) is spaces.Discrete:
        small = all(int(space.n) <= _STATES for space in (observation, action))
        return "step" if small else "transition"
    return "variable" if any(part.dtype is None for part in parts) else "transition"


def parts_of(space: spaces.Space[Any], where: str) -> list[Part]:
    """Return the leaves of a space in the order of its description.

    Raises:
        EnvironmentNotUsable: it has one that cannot be recorded; `where` is named.
    """
    parts = list(_parts(space, where, (), ()))
    size = sum(part.dtype.itemsize for part in parts if part.dtype is not None)
    if size > MAX_VALUE_BYTES:
        raise EnvironmentNotUsable(
            f"{where} has values of {size:,} bytes, expected {MAX_VALUE_BYTES:,} at most: record a smaller "
            "observation by wrapping outside of the wrapper that makes it small."
        )
    return parts


def _parts(space: spaces.Space[Any], where: str, keys: Keys, fields: tuple[str, ...]) -> Iterator[Part]:
    if isinstance(space, spaces.Dict):
        for key, part in space.spaces.items():
            if not is_text(str(key)):
                raise EnvironmentNotUsable(
                    f"{where}: found a part called {str(key)[:40]!r}, expected a short, printable name."
                )
            yield from _parts(part, where, (*keys, key), (*fields, str(key)))
    elif isinstance(space, spaces.Tuple):
        for i, part in enumerate(space.spaces):
            yield from _parts(part, where, (*keys, i), (*fields, str(i)))
    elif (dtype := _dtype(space, where)) is not None:
        yield Part(keys, fields, np.dtype((dtype, space.shape or ())))
    elif isinstance(space, spaces.Text):
        yield Part(keys, fields, None, str_of)
    else:
        yield Part(
            keys, fields, None, lambda value: value if isinstance(value, str) else _json_of(space, value)
        )


def str_of(value: Any) -> str:
    """Return a text; refuse everything else.

    Raises:
        TypeError: it is no text.
    """
    if not isinstance(value, str):
        raise TypeError(f"{type(value).__name__} is no text")
    return value


def _json_of(space: spaces.Space[Any], value: Any) -> str:
    """Return a value of a space that has no layout of its own, as JSON."""
    if isinstance(space, spaces.Graph):
        value = {"nodes": value.nodes, "edges": value.edges, "edge_links": value.edge_links}
    return json.dumps(as_json(value))


def _dtype(space: spaces.Space[Any], where: str) -> np.dtype[Any] | None:
    """Return the little-endian dtype of a space whose values are arrays of one shape; None for others.

    Spaces of other libraries count as arrays if they declare a shape and a dtype of numbers.

    Raises:
        EnvironmentNotUsable: its numbers are of a dtype that a recording cannot hold.
    """
    known = isinstance(space, spaces.Box | spaces.Discrete | spaces.MultiBinary | spaces.MultiDiscrete)
    without_layout = isinstance(space, spaces.Text | spaces.Sequence | spaces.Graph | spaces.OneOf)
    if without_layout or (not known and (space.shape is None or space.dtype is None)):
        return None
    dtype = np.dtype(space.dtype)
    if not known and dtype.kind not in "biuf":
        return None
    if dtype.kind not in "biuf" or dtype.itemsize > 8:
        raise EnvironmentNotUsable(
            f"{where}: found {space} of dtype {dtype}, expected numbers of at most 64 bits."
        )
    return dtype.newbyteorder("<")


def widened(space: spaces.Space[Any], value: Any) -> spaces.Space[Any]:
    """Return an action space in whose dtypes an action, or a batch of actions, is exact.

    Only floating-point actions widen a space: whole numbers that it cannot hold are a mistake.
    """
    if isinstance(space, spaces.Dict) and isinstance(value, Mapping):
        parts = {
            key: widened(part, value[key]) if key in value else part for key, part in space.spaces.items()
        }
        return space if all(parts[key] is space.spaces[key] for key in parts) else spaces.Dict(parts)
    if isinstance(space, spaces.Tuple) and isinstance(value, Sequence):
        inside = tuple(widened(part, own) for part, own in zip(space.spaces, value, strict=False))
        return space if all(map(lambda a, b: a is b, inside, space.spaces)) else spaces.Tuple(inside)
    if not isinstance(space, spaces.Box):
        return space
    try:
        found = np.asarray(value).dtype
    except (TypeError, ValueError):
        return space
    if found.kind != "f" or found.itemsize > 8 or np.can_cast(found, space.dtype):
        return space
    return spaces.Box(space.low.astype(found), space.high.astype(found), dtype=found.type)


def can_widen(space: spaces.Space[Any]) -> bool:
    """Return whether there are actions for which `widened` returns another space."""
    if isinstance(space, spaces.Dict):
        return any(map(can_widen, space.spaces.values()))
    if isinstance(space, spaces.Tuple):
        return any(map(can_widen, space.spaces))
    return isinstance(space, spaces.Box) and not np.can_cast(np.float64, space.dtype)


def describe_space(space: spaces.Space[Any], where: str) -> dict[str, Any]:  # noqa: PLR0911
    """Return a space as JSON, as `runner.recording.spaces` reads it.

    Raises:
        EnvironmentNotUsable: it cannot be recorded; `where` is named.
    """
    if isinstance(space, spaces.Dict):
        inside = {str(key): describe_space(part, where) for key, part in space.spaces.items()}
        return {"type": "Dict", "spaces": inside}
    if isinstance(space, spaces.Tuple):
        return {"type": "Tuple", "spaces": [describe_space(part, where) for part in space.spaces]}
    if isinstance(space, spaces.Text):
        return {"type": "Text", "max_length": int(space.max_length)}
    dtype = _dtype(space, where)
    if dtype is None:
        return {"type": "Text", "max_length": _MAX_TEXT, "holds": repr(space)[:1000]}
    array = {"dtype": dtype.str, "shape": [int(n) for n in space.shape or ()]}
    if isinstance(space, spaces.Discrete):
        return {"type": "Discrete", **array, "n": int(space.n), "start": int(space.start)}
    if isinstance(space, spaces.MultiDiscrete):
        return {"type": "MultiDiscrete", **array, "nvec": np.asarray(space.nvec).tolist()}
    if isinstance(space, spaces.MultiBinary):
        return {"type": "MultiBinary", **array}
    low, high = (_bound(getattr(space, name, None)) for name in ("low", "high"))
    return {"type": "Box", **array, "low": low, "high": high}


def _bound(bound: Any) -> Any:
    """Return a bound of a box: one number if it is the same everywhere; None for too many."""
    values = np.asarray(bound)
    if not values.size or values.dtype.kind not in "biuf":
        return None
    if (values == values.flat[0]).all():
        return as_json(values.flat[0].item())
    return as_json(values.tolist()) if values.size <= _BOUNDS_LISTED else None


def _tabular(env: Any, kwargs: dict[str, Any], observation: Any, action: Any) -> Mdp | None:
    """Return the arrays of an environment if it is tabular and its observations are its states."""
    base = getattr(env, "unwrapped", env)
    if not hasattr(base, "transitions") and not hasattr(base, "P"):
        return None
    try:
        mdp = mdp_of(env, kwargs)
    except EnvironmentNotUsable:
        return None  # an attribute of that name that means something else
    same = (int(observation.n), int(action.n)) == (mdp.states, mdp.joint_actions)
    return mdp if same and not observation.start and not action.start else None


_MAX_VALUES: Final = 4_000_000
_MAX_REPR: Final = 10_000


def as_json(value: Any) -> Any:
    """Return what JSON can hold of a value; what it cannot hold as its `repr`.

    Arrays become lists, dataclasses and namespaces mappings, paths text; numbers that JSON has no word
    for (NaN, infinities) become text.

    Raises:
        ValueError: the value contains itself, or more than 4,000,000 values.
        RecursionError: it is nested too deeply.
    """
    return _Plain().of(value)


class _Plain:
    """One conversion to plain values, bounded: a graph of few objects can stand for endless JSON."""

    def __init__(self) -> None:
        self._left = _MAX_VALUES
        self._path: set[int] = set()

    def of(self, value: Any) -> Any:
        self._count(1)
        if isinstance(value, Enum):
            value = value.value
        elif isinstance(value, np.generic | np.ndarray) and value.dtype.kind in "biufU":
            self._count(value.size)
            value = value.tolist()
        elif isinstance(value, os.PathLike):
            value = os.fspath(value)
        if value is None or isinstance(value, int | str):
            return value
        if isinstance(value, float):
            return value if math.isfinite(value) else repr(value)
        if id(value) in self._path:
            raise ValueError(f"a {type(value).__name__} contains itself")
        self._path.add(id(value))
        try:
            return self._inside(value)
        finally:
            self._path.discard(id(value))

    def _inside(self, value: Any) -> Any:
        if (fields := as_mapping(value)) is not None:
            return {str(key): self.of(part) for key, part in fields.items()}
        if isinstance(value, Sequence) and not isinstance(value, bytes | bytearray | memoryview):
            return [self.of(part) for part in value]
        return _repr(value)

    def _count(self, values: int) -> None:
        self._left -= values
        if self._left < 0:
            raise ValueError(f"it holds more than {_MAX_VALUES:,} values")


def as_mapping(value: Any) -> Mapping[Any, Any] | None:
    """Return the settings in a mapping, dataclass, namespace or Pydantic model; None for anything else."""
    if isinstance(value, Mapping):
        return value
    if isinstance(value, Namespace | SimpleNamespace):
        return vars(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if callable(dump := getattr(value, "model_dump", None)) and not isinstance(value, type):
        dumped = dump()
        return dumped if isinstance(dumped, Mapping) else None
    return None


def _repr(value: Any) -> str:
    try:
        return repr(value)[:_MAX_REPR]
    except Exception:  # a repr is anybody's code, and explains nothing if it fails
        return f"<{type(value).__name__}>"
