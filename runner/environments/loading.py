"""Make a tabular Gymnasium environment, and read it into arrays.

The environment offers them as documented attributes of `env.unwrapped` (`transitions`, `agents`,
`agent_action_counts`, `event_names`, `success_events`, `penalty_below`, `scene`, `scene_cells`,
`scene_carriers`), or only Gymnasium's customary `P` and `initial_state_distrib`; for Gymnasium's own grid
worlds `runner.environments.toy_text` adds the rest. An attribute that is missing stays unknown.
"""

from __future__ import annotations

import contextlib
import difflib
import functools
import importlib
import json
import traceback
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from runner.environments.mdp import Mdp, Transitions, check_mdp
from runner.environments.toy_text import grid_world
from runner.errors import EnvironmentNotUsable
from runner.util.values import JsonView


def load_mdp(env_id: str, kwargs: JsonView, rewards: str = "team") -> Mdp:
    """Make the environment and return its arrays.

    Args:
        env_id: a Gymnasium id; the part before a colon is a module to import first.
        kwargs: arguments of the environment.
        rewards: `team`, or `individual` for a reward of each agent (the environment's `competitive=True`).

    Raises:
        EnvironmentNotUsable: it is unknown, cannot be made, or has no transition table.
    """
    env = _make(env_id, dict(kwargs) | ({"competitive": True} if rewards == "individual" else {}))
    try:
        with contextlib.closing(env):
            mdp = _read(env_id, kwargs, env, rewards)
    except EnvironmentNotUsable:
        raise
    except Exception as error:  # its attributes may raise anything
        raise EnvironmentNotUsable(
            f"environment {env_id!r}: its attributes cannot be read "
            f"({type(error).__name__}: {error}); docs/architecture.md lists what is expected."
        ) from error
    check_mdp(mdp)
    if rewards == "individual" and mdp.rewards.shape[-1] != len(mdp.agents):
        raise _one_reward_only(env_id)
    return mdp


def load_once(env_id: str, kwargs: JsonView, rewards: str) -> Mdp:
    """Return what `load_mdp` does; a process that needs the same environment again does not make it again."""
    return _loaded(env_id, json.dumps(dict(kwargs), sort_keys=True, default=dict), rewards)


@functools.lru_cache(maxsize=16)
def _loaded(env_id: str, kwargs: str, rewards: str) -> Mdp:
    return load_mdp(env_id, json.loads(kwargs), rewards)


def mdp_of(env: Any, kwargs: JsonView) -> Mdp:
    """Return the arrays of an environment made with `kwargs`, whose agents share the reward.

    Raises:
        EnvironmentNotUsable: it has no transition table, or one that is invalid.
    """
    spec = env.spec
    env_id = spec.id if spec is not None else type(env.unwrapped).__qualname__
    try:
        mdp = _read(env_id, kwargs, env, "team")
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise EnvironmentNotUsable(
            f"environment {env_id!r}: its attributes contradict each other."
        ) from error
    check_mdp(mdp)
    return mdp


def _read(env_id: str, kwargs: JsonView, env: Any, rewards: str) -> Mdp:
    """Return the attributes of an environment, not yet checked; a team shares the summed reward."""
    from runner.config.values import plain  # reading a recording needs none of it

    base = env.unwrapped
    limit = env.spec.max_episode_steps if env.spec is not None else None
    transitions = _transitions(env_id, base)
    joint = transitions["next_state"].shape[1]
    described = grid_world(env_id, base, transitions)
    source: Any = described or base
    if described is not None:
        transitions["events"] = described.events
    if rewards == "team":
        transitions["rewards"] = transitions["rewards"].sum(axis=-1, keepdims=True)
    return Mdp(
        env_id=env_id,
        kwargs=plain(kwargs),
        **transitions,
        start=np.ascontiguousarray(base.initial_state_distrib, dtype=np.float64),
        step_limit=int(limit or 0),
        agents=tuple(getattr(source, "agents", ("agent",))),
        action_counts=tuple(int(n) for n in getattr(base, "agent_action_counts", (joint,))),
        event_names=tuple(getattr(source, "event_names", ())),
        success_events=tuple(getattr(source, "success_events", ())),
        penalty_below=float(getattr(source, "penalty_below", -np.inf)),
        scene=getattr(source, "scene", None),
        scene_cells=getattr(source, "scene_cells", None),
        scene_carriers=getattr(source, "scene_carriers", None),
    )


def _one_reward_only(env_id: str) -> EnvironmentNotUsable:
    return EnvironmentNotUsable(
        f"environment {env_id!r} does not reward its agents individually: set `rewards: team` "
        "(`mode: competitive` means individual rewards)."
    )


def _make(env_id: str, kwargs: JsonView) -> Any:
    """Return the environment, without the wrappers that only check or render."""
    import gymnasium

    module, _, name = env_id.rpartition(":")
    if module:
        try:
            importlib.import_module(module)
        except ModuleNotFoundError as error:
            raise EnvironmentNotUsable(
                f"environment {env_id!r}: there is no module {error.name!r}; "
                "install its package, set PYTHONPATH to its folder, or correct `env.id`."
            ) from error
        except Exception as error:  # a module may raise anything
            raise EnvironmentNotUsable(
                f"environment {env_id!r}: the module {module!r} cannot be imported ({_raised(error)})."
            ) from error
    if name not in gymnasium.registry:
        stems = {
            env_name.rpartition("-v")[0]: env_name for env_name in gymnasium.registry
        }  # the newest comes last
        near = difflib.get_close_matches(name.rpartition("-v")[0], stems, n=1, cutoff=0.6)
        before = (
            f"{module}:" if module and near and stems[near[0]].startswith(name.rpartition("-v")[0]) else ""
        )
        hint = f" Did you mean '{before}{stems[near[0]]}'?" if near else ""
        raise EnvironmentNotUsable(f"environment {env_id!r}: Gymnasium knows no such id.{hint}")
    try:
        return gymnasium.make(name, disable_env_checker=True, **kwargs)
    except Exception as error:  # an environment may raise anything
        if "competitive" in kwargs and "keyword argument 'competitive'" in str(error):
            raise _one_reward_only(env_id) from error
        given = ", ".join(f"{key}={value!r}" for key, value in kwargs.items()) or "no arguments"
        is_clear = isinstance(error, TypeError | ValueError | ImportError | gymnasium.error.Error)
        raise EnvironmentNotUsable(
            f"environment {env_id!r} cannot be made with {given}: {error if is_clear else _raised(error)}"
        ) from error


def _raised(error: Exception) -> str:
    """Return the error and its place in other code: `KeyError: 'goal' (corridor.py, line 12)`."""
    place = traceback.extract_tb(error.__traceback__)[-1]
    at = "" if isinstance(error, SyntaxError) else f" ({Path(place.filename).name}, line {place.lineno})"
    return f"{type(error).__name__}: {error}{at}"


def _transitions(env_id: str, base: object) -> Transitions:
    """Return the transition arrays, from the environment's own or from its `P`."""
    if hasattr(base, "transitions"):
        own = base.transitions
        return {
            "next_state": np.ascontiguousarray(own.next_state, dtype=np.int32),
            "probability": np.ascontiguousarray(own.probability, dtype=np.float64),
            "rewards": np.ascontiguousarray(own.rewards, dtype=np.float64),
            "terminated": np.ascontiguousarray(own.terminated, dtype=np.bool_),
            "events": np.ascontiguousarray(own.events, dtype=np.uint32),
        }
    if not hasattr(base, "P") or not hasattr(base, "initial_state_distrib"):
        raise EnvironmentNotUsable(
            f"environment {env_id!r} offers no transition table (`P` and `initial_state_distrib`), which "
            "tabular learning here needs. DualTaxi-v1, Taxi-v4, FrozenLake-v1 and CliffWalking-v1 have one."
        )
    return _transitions_from_p(base.P)


def _transitions_from_p(
    p: Mapping[int, Mapping[int, list[tuple[float, int, ArrayLike, bool]]]],
) -> Transitions:
    """Return arrays from Gymnasium's `P[state][action] = [(probability, next state, reward, terminated)]`."""
    states = len(p)
    actions = len(p[0])
    most = max(len(outcomes) for row in p.values() for outcomes in row.values())
    shape = (states, actions, most)
    next_state = np.zeros(shape, np.int32)
    probability = np.zeros(shape)
    rewards = np.zeros((*shape, 1))
    terminated = np.zeros(shape, np.bool_)
    for s, row in p.items():
        for a, outcomes in row.items():
            for k, (chance, successor, reward, over) in enumerate(outcomes):
                next_state[s, a, k], probability[s, a, k] = successor, chance
                rewards[s, a, k, 0] = float(np.sum(reward))
                terminated[s, a, k] = over
    return {
        "next_state": next_state,
        "probability": probability,
        "rewards": rewards,
        "terminated": terminated,
        "events": np.zeros(shape, np.uint32),
    }
