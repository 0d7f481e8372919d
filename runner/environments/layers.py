"""What an environment is made of: its layers and their names, the parts of a vector."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from runner.util.values import MAX_TEXT

if TYPE_CHECKING:
    from gymnasium.envs.registration import EnvSpec

    from runner.environments.gym_types import AnyVectorEnv, Space


def layers_of(env: object) -> Iterator[Any]:
    """Yield an environment's wrappers from the outermost in, and the environment inside of them."""
    innermost = getattr(env, "unwrapped", env)
    while env is not innermost and env is not None:
        yield env
        # PettingZoo's wrappers look up what they do not have inside: `env` comes first.
        env = getattr(env, "env", None) or getattr(env, "aec_env", None)
    yield innermost


def class_name(instance: object) -> str:
    """Return `module:class` of an instance, cut at the length that a recording holds."""
    return f"{type(instance).__module__}:{type(instance).__qualname__}"[:MAX_TEXT]


def name_of(entry_point: Any) -> str:
    """Return `module:name` of an entry point, of the function in a partial; empty if there is none."""
    if entry_point is None or isinstance(entry_point, str):
        return entry_point or ""
    while isinstance(entry_point, functools.partial):
        entry_point = entry_point.func
    return f"{getattr(entry_point, '__module__', '')}:{getattr(entry_point, '__qualname__', '')}"


def top_package(module: str) -> str:
    """Return the top package of a module, or of `module:class`."""
    return module.partition(":")[0].partition(".")[0]


def creator_of(spec: EnvSpec) -> object:
    """Return the class or function that makes the environment of a specification."""
    from gymnasium.envs.registration import load_env_creator

    return load_env_creator(spec.entry_point) if isinstance(spec.entry_point, str) else spec.entry_point


def spaces_of_one(envs: AnyVectorEnv) -> tuple[Space, Space]:
    """Return the spaces of observation and action of one environment of a vector.

    Older vectors, such as SuperSuit's, have no `single_` spaces: their spaces are those of one environment.
    """
    observation = getattr(envs, "single_observation_space", None) or envs.observation_space
    return observation, getattr(envs, "single_action_space", None) or envs.action_space


def final_observations(infos: Any) -> Any:
    """Return the last observations of the episodes that ended in a step, by environment; None if none did."""
    if isinstance(infos, Mapping):
        return infos.get("final_obs")
    last = [info.get("terminal_observation") for info in infos]  # as SuperSuit's vectors return them
    return last if any(value is not None for value in last) else None
