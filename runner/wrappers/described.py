"""Gymnasium's spaces and environments, described as a recording carries them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from gymnasium import spaces

from runner.environments import mdp_of
from runner.errors import EnvironmentNotUsable
from runner.mdp import Mdp
from runner.recording.spaces import MAX_VALUE_BYTES
from runner.scene import is_text

Keys = tuple[str | int, ...]
_RECORDABLE: Final = "Discrete, MultiDiscrete, MultiBinary, Box, Text, and Tuple and Dict of these"
_BOUNDS_LISTED: Final = 64
"""Bounds of a box are told one by one up to so many; of a larger box only if all are the same."""


@dataclass(frozen=True)
class Part:
    """A leaf of a space: how to get at it in a value, its dtype (None for a text)."""

    keys: Keys
    fields: tuple[str, ...]
    """The names of the same way in NumPy's records."""
    dtype: np.dtype[Any] | None

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

    def spaces(self) -> dict[str, Any]:
        """Return the descriptions of both spaces."""
        return {
            name: describe_space(space, f"the {name} space of {self.env_id}")
            for name, space in (("observation", self.observation), ("action", self.action))
        }


def describe(env: Any, observation: spaces.Space[Any], action: spaces.Space[Any]) -> Described:
    """Return what is to be said of a Gymnasium environment with these spaces.

    Raises:
        EnvironmentNotUsable: one of its spaces cannot be recorded.
    """
    spec = getattr(env, "spec", None)
    kwargs = as_json(dict(spec.kwargs)) if spec is not None else {}
    kind, mdp = kind_of(observation, action), None
    if kind == "step":
        mdp = _tabular(env, kwargs, observation, action)
    joint = mdp is not None and len(mdp.agents) > 1
    return Described(
        kind=kind,
        observation=observation,
        action=action,
        env_id=spec.id if spec is not None else type(getattr(env, "unwrapped", env)).__qualname__,
        kwargs=kwargs,
        step_limit=int((spec.max_episode_steps if spec is not None else None) or 0),
        agents=("agency" if joint else mdp.agents[0] if mdp is not None else "agent",),
        mdp=mdp,
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
        return "step"
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
    elif isinstance(space, spaces.Text):
        yield Part(keys, fields, None)
    else:
        yield Part(keys, fields, np.dtype((_dtype(space, where), space.shape or ())))


def _dtype(space: spaces.Space[Any], where: str) -> np.dtype[Any]:
    """Return the little-endian dtype of an array space."""
    known = (spaces.Box, spaces.Discrete, spaces.MultiBinary, spaces.MultiDiscrete)
    if not isinstance(space, known):
        raise EnvironmentNotUsable(f"{where}: found {space}; what can be recorded is {_RECORDABLE}.")
    dtype = np.dtype(space.dtype)
    if dtype.kind not in "biuf" or dtype.itemsize > 8:
        raise EnvironmentNotUsable(
            f"{where}: found {space} of dtype {dtype}, expected numbers of at most 64 bits."
        )
    return dtype.newbyteorder("<")


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
    array = {"dtype": _dtype(space, where).str, "shape": [int(n) for n in space.shape or ()]}
    if isinstance(space, spaces.Discrete):
        return {"type": "Discrete", **array, "n": int(space.n), "start": int(space.start)}
    if isinstance(space, spaces.MultiDiscrete):
        return {"type": "MultiDiscrete", **array, "nvec": np.asarray(space.nvec).tolist()}
    if isinstance(space, spaces.MultiBinary):
        return {"type": "MultiBinary", **array}
    assert isinstance(space, spaces.Box)
    return {"type": "Box", **array, "low": _bound(space.low), "high": _bound(space.high)}


def _bound(bound: Any) -> Any:
    """Return a bound of a box: one number if it is the same everywhere; None for too many."""
    values = np.asarray(bound)
    if not values.size:
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


def as_json(value: Any) -> Any:
    """Return what JSON can hold of a value; what it cannot hold by how Python shows it.

    Arrays become lists; numbers that are none (NaN, infinities) become text.
    """
    if value is None or isinstance(value, int | str):
        return value
    if isinstance(value, np.generic | np.ndarray):
        return as_json(value.tolist()) if value.dtype.kind in "biufU" else repr(value)
    if isinstance(value, float):
        return value if math.isfinite(value) else repr(value)
    if isinstance(value, Mapping):
        return {str(key): as_json(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [as_json(part) for part in value]
    return repr(value)
