"""An environment and its spaces, as a recording describes them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final

from gymnasium import spaces

from runner.environments.gym_types import Space
from runner.environments.loading import mdp_of
from runner.environments.mdp import Mdp
from runner.errors import EnvironmentNotUsable
from runner.recording.gym_spaces import checked_leaves, recorded_space
from runner.recording.layout import Layout, layout_of
from runner.recording.metadata import Attachments, environment_attachments
from runner.util.jsonable import as_json

_NOT_SETTINGS: Final = frozenset({"num_envs", "vectorization_mode", "vector_kwargs", "wrappers", "base_path"})
"""What `gymnasium.make_vec` and EnvPool add to an environment's own settings."""


@dataclass(frozen=True)
class Copied:
    """What the steps of a recording depend on that others are copied into: of one environment at a time."""

    layout: Layout
    recorded_spaces: Mapping[str, Any]
    mdp: Mdp | None
    environments: int = 1


@dataclass(frozen=True)
class Described:
    """An environment and its spaces."""

    observation: Space
    action: Space
    env_id: str
    kwargs: dict[str, object] = field(default_factory=dict)
    step_limit: int = 0
    agents: tuple[str, ...] = ("agent",)
    """The agents: one reward column each."""
    environments: int = 1
    has_turns: bool = False
    """Whether environments take turns: there are several, or a vector of one resets it in place of a step."""
    mdp: Mdp | None = None
    """The environment's arrays, if it is tabular."""
    wide_action: Space | None = None
    """The action space in the dtype of the recorded actions, if that is wider than its own."""
    kind: str = "loop"
    """The kind of recording, a key of `schema.KINDS`."""

    def __post_init__(self) -> None:
        checked_leaves(self.observation, "the observation space")
        checked_leaves(self.action, "the action space")

    @property
    def recorded_action(self) -> Space:
        """The action space in the dtype in which actions are recorded."""
        return self.action if self.wide_action is None else self.wide_action

    @cached_property
    def _spaces(self) -> dict[str, Any]:
        """The descriptions of the environment's own spaces."""
        spaces_of = {"observation": self.observation, "action": self.action}
        return {name: recorded_space(space).describe() for name, space in spaces_of.items()}

    @cached_property
    def recorded_spaces(self) -> dict[str, Any]:
        """The descriptions of both spaces, of actions as they are recorded."""
        wide = {} if self.wide_action is None else {"action": recorded_space(self.wide_action).describe()}
        return self._spaces | wide

    @cached_property
    def layout(self) -> Layout:
        """The messages of its recordings."""
        events = len(self.mdp.event_names) if self.mdp else 0
        spaces_of = json.dumps(self.recorded_spaces)
        return layout_of(self.kind, len(self.agents), events, spaces_of, self.has_turns)

    @cached_property
    def common(self) -> str:
        """What all processes that record one run have in common, as JSON: spaces, agents of a game."""
        agents = list(map(str, self.agents)) if len(self.agents) > 1 else 1
        return json.dumps({**self._spaces, "agents": agents})

    def attachments(self) -> Attachments:
        """Return the attachments that describe the environment, with its arrays if it is tabular."""
        if self.mdp is not None:
            return environment_attachments(self.mdp.description(), self.mdp.arrays())
        description = {
            "env_id": self.env_id,
            "kwargs": self.kwargs,
            "step_limit": self.step_limit,
            "agents": list(self.agents),
            "action_counts": [],
            "event_names": [],
            "success_events": [],
            "penalty_below": None,
            "scene": None,
        }
        return environment_attachments(description, {})


def describe(env: object, observation: Space, action: Space) -> Described:
    """Return the description of a Gymnasium environment with these spaces."""
    env_id, kwargs, step_limit = _registration(env)
    mdp = _tabular(env, kwargs, observation, action)
    agents: tuple[str, ...] = ("agent",)
    if mdp is not None:
        agents = mdp.agents if len(mdp.agents) == 1 else ("agency",)
    return Described(observation, action, env_id, kwargs, step_limit, agents, mdp=mdp)


def _registration(env: object) -> tuple[str, dict[str, object], int]:
    """Return an environment's id, keyword arguments and step limit, as far as they are registered.

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


def _tabular(env: object, kwargs: dict[str, object], observation: Space, action: Space) -> Mdp | None:
    """Return the arrays of an environment if it is tabular and its observations are its states."""
    if not isinstance(observation, spaces.Discrete) or not isinstance(action, spaces.Discrete):
        return None
    base = getattr(env, "unwrapped", env)
    if not hasattr(base, "transitions") and not hasattr(base, "P"):
        return None
    try:
        mdp = mdp_of(env, kwargs)
    except EnvironmentNotUsable:
        return None  # an attribute of that name that means something else
    same = (int(observation.n), int(action.n)) == (mdp.states, mdp.joint_actions)
    return mdp if same and not observation.start and not action.start else None
