"""The names of an environment's actions, and an action that a user gives, checked against its space."""

from __future__ import annotations

import enum
import json
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from gymnasium import ActionWrapper, spaces
from gymnasium.wrappers import StickyAction

from runner.environments.gym_types import Space
from runner.environments.naming import spoken
from runner.errors import ConfigError, nearest, shortened
from runner.recording.gym_spaces import recorded_space, value_of
from runner.recording.maker import MAX_NAMES
from runner.recording.spaces import Value
from runner.util.values import is_text

_MAX_TEXT: Final = 200
_MAX_BOUNDS: Final = 8
"""The most numbers of an action that are listed with their bounds."""
Names = Sequence[str] | Mapping[str, Sequence[str]]
"""Names of discrete actions, the least action's first; of a game by agent."""
_KNOWN: Final = {
    "AcrobotEnv": ("torque -1", "no torque", "torque 1"),
    "BlackjackEnv": ("stick", "hit"),
    "CarRacing": ("nothing", "steer right", "steer left", "gas", "brake"),
    "CartPoleEnv": ("left", "right"),
    "CartPoleVectorEnv": ("left", "right"),
    "LunarLander": ("no engine", "left engine", "main engine", "right engine"),
    "SimpleEnv": ("no action", "left", "right", "down", "up"),
    "MountainCarEnv": ("left", "no push", "right"),
}
"""The actions of well-known environments, by class, as their documentation names them."""
_KNOWN_IN: Final = ("gymnasium.envs.", "mpe2.")


def action_names(env: object, space: Space) -> tuple[str, ...]:
    """Return the names of an environment's discrete actions, the least action's first; empty if unknown.

    Args:
        space: of the actions as the user takes them: names are only returned if there is one for each.
    """
    layer = env
    base = getattr(env, "unwrapped", env)
    while layer is not base:
        if isinstance(layer, ActionWrapper) and not isinstance(layer, StickyAction):  # has other actions
            return ()
        layer = getattr(layer, "env", base)
    kinds = (kind for kind in type(base).__mro__ if kind.__module__.startswith(_KNOWN_IN))
    names: tuple[str, ...] = next((_KNOWN[kind.__name__] for kind in kinds if kind.__name__ in _KNOWN), ())
    meanings, named = getattr(base, "get_action_meanings", None), getattr(base, "actions", None)
    if callable(meanings):  # as ALE has
        try:
            names = tuple(map(str, meanings()))
        except Exception:  # the user's own function, by the same name, may be another thing
            names = ()
    elif isinstance(named, type) and issubclass(named, enum.IntEnum):  # as MiniGrid has
        names = tuple(action.name for action in named)
    is_complete = isinstance(space, spaces.Discrete) and int(space.n) == len(names) <= MAX_NAMES
    return names if is_complete and all(map(is_text, names)) else ()


def action_in_words(space: Space, action: Value, names: Names) -> str:
    """Return the name of an action, or of the action of each agent; empty if there is none."""
    if isinstance(names, Mapping):
        assert isinstance(space, spaces.Dict)
        words = (
            (agent, action_in_words(space[agent], value, names[str(agent)]))
            for agent, value in action.items()
        )
        return ", ".join(f"{agent} {name}" for agent, name in words if name)
    return (
        spoken(names[int(action) - int(space.start)]) if isinstance(space, spaces.Discrete) and names else ""
    )


def parsed_action(space: Space, given: object, recorded: Value, names: Names) -> Value:
    """Return an action in the dtypes of the recorded one.

    Args:
        given: text, or a value; of a game `AGENT=VALUE`, or a mapping by agent: the others act as recorded.
            None for the recorded action.
        recorded: the recorded action at the same step; of a game, the actions of the agents that acted.

    Raises:
        ConfigError: it is not in the space.
    """
    if given is None:
        return recorded
    if not isinstance(names, Mapping):
        return _parsed(space, given, recorded, names, "action")
    assert isinstance(space, spaces.Dict)
    if isinstance(given, str) and "=" in given:
        agent, _, value = given.partition("=")
        given = {agent: value}
    acting = {str(agent): agent for agent in recorded}
    agents = map(str, given) if isinstance(given, Mapping) else ()
    wrong = next((agent for agent in agents if agent not in acting), given)
    if wrong is not given or not isinstance(given, Mapping):
        raise ConfigError(
            f"action: found {_short(wrong)}, expected AGENT=VALUE of an agent that acts at this step: "
            f"{', '.join(acting)}.{nearest(str(wrong), acting)}"
        )
    return recorded | {
        (agent := acting[str(name)]): _parsed(
            space[agent], value, recorded[agent], names[str(agent)], f"action of {agent}"
        )
        for name, value in given.items()
    }


def space_in_words(space: Space) -> str:
    """Return what may be typed for an action: `0 to 5`, `2 numbers separated by commas, each -1 to 1`."""
    if isinstance(space, spaces.Discrete):
        return f"{space.start} to {space.start + space.n - 1}"
    if not isinstance(space, spaces.Box):
        kind = "JSON for" if recorded_space(space).comes_from_text else "numbers separated by commas, of"
        return f"{kind} {space}"
    bounds = [f"{low:g} to {high:g}" for low, high in zip(space.low.flat, space.high.flat, strict=True)]
    count = "" if len(bounds) == 1 else f"{len(bounds):,} numbers separated by commas"
    if len(set(bounds)) == 1:
        return f"{count}, each {bounds[0]}" if count else bounds[0]
    return f"{count}: {', '.join(bounds)}" if len(bounds) <= _MAX_BOUNDS else count


def _parsed(space: Space, given: object, recorded: Value, names: Sequence[str], where: str) -> object:
    if isinstance(space, spaces.Dict | spaces.Tuple):
        return _parsed_parts(space, given, recorded, where)
    if isinstance(space, spaces.Discrete):
        return _discrete(space, given, names, where)
    if isinstance(space, spaces.Text):
        if isinstance(given, str) and given in space:
            return given
        raise ConfigError(f"{where}: found {_short(given)}, expected a text of {space}")
    if recorded_space(space).comes_from_text:
        return _parsed_json(space, given, where)
    try:
        values = given.split(",") if isinstance(given, str) else given
        array = np.asarray(values, np.asarray(recorded).dtype).reshape(np.shape(recorded))
        numbers = np.asarray(values).reshape(array.shape)
        if array.dtype.kind != "f" and numbers.dtype.kind == "f" and (array != numbers).any():
            raise ValueError("fractions would be cut off")
    except (TypeError, ValueError, OverflowError) as error:
        raise ConfigError(f"{where}: found {_short(given)}, expected {space_in_words(space)}") from error
    if isinstance(space, spaces.Box):
        outside = ~((array >= space.low) & (array <= space.high))
        if outside.any():
            at = np.unravel_index(int(np.argmax(outside)), array.shape)
            index = f"[{', '.join(map(str, at))}]" if at else ""
            raise ConfigError(
                f"{where}{index}: found {array[at]:g}, expected {space.low[at]:g} to {space.high[at]:g}"
            )
    elif array not in space:
        raise ConfigError(f"{where}: found {_short(given)}, expected an element of {space}")
    return array


def _parsed_json(space: Space, given: object, where: str) -> object:
    """Return an action of a space that is recorded as text; text given for it is JSON."""
    try:
        value = value_of(space, given) if isinstance(given, str) else given
        if value in space:
            return value
    except ValueError as error:
        raise ConfigError(f"{where}: found {_short(given)}, expected JSON for {space} ({error})") from error
    raise ConfigError(f"{where}: found {_short(given)}, expected an element of {space}")


def _parsed_parts(space: Space, given: object, recorded: Value, where: str) -> object:
    """Return an action of a `Dict` or `Tuple`; text given for it is JSON."""
    try:
        values = json.loads(given) if isinstance(given, str) else given
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{where}: found {_short(given)}, expected JSON for {space} ({error})") from error
    if isinstance(space, spaces.Dict):
        keys = list(space.spaces)
        if not isinstance(values, Mapping) or set(values) != set(map(str, keys)):
            raise ConfigError(
                f"{where}: found {_short(values)}, expected an object with {', '.join(map(str, keys))}"
            )
        return {
            key: _parsed(space[key], values[str(key)], recorded[key], (), f"{where}[{key!r}]") for key in keys
        }
    assert isinstance(space, spaces.Tuple)
    if isinstance(values, str) or not isinstance(values, Sequence) or len(values) != len(space.spaces):
        raise ConfigError(f"{where}: found {_short(values)}, expected a list of {len(space.spaces)} parts")
    return tuple(
        _parsed(part, values[i], recorded[i], (), f"{where}[{i}]") for i, part in enumerate(space.spaces)
    )


def _discrete(space: spaces.Discrete, given: Value, names: Sequence[str], where: str) -> int:
    """Return a discrete action, given by its number or its name."""
    start = int(space.start)
    by_name = {spoken(name).casefold(): start + i for i, name in enumerate(names[: int(space.n)])}
    if isinstance(given, str) and spoken(given).casefold() in by_name:
        return by_name[spoken(given).casefold()]
    try:
        number = int(given)
        is_whole = isinstance(given, str) or number == given
    except (TypeError, ValueError, OverflowError):
        number, is_whole = -1, False
    if not is_whole or not start <= number < start + space.n:
        named = f", or a name: {', '.join(names)}" if names else ""
        raise ConfigError(
            f"{where}: found {_short(given)}, expected {space_in_words(space)}{named}."
            f"{nearest(str(given), names)}"
        )
    return number


def _short(value: object) -> str:
    return shortened(repr(value), _MAX_TEXT)
