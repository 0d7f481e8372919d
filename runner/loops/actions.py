"""An action that a user gives, as text or as a value, checked against the space of an environment."""

from __future__ import annotations

import enum
import json
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from gymnasium import spaces

from runner.environments.naming import actions_in_words, spoken
from runner.errors import ConfigError, nearest
from runner.recording.gym_spaces import Space
from runner.recording.reader import Recording

_MAX_TEXT: Final = 200


def action_names(env: Any, recording: Recording) -> list[str]:
    """Return the names of discrete actions: of a tabular environment, Atari's, MiniGrid's; else none."""
    if recording.tabular:
        return [str(name) for name in actions_in_words(recording.mdp)]
    base = getattr(env, "unwrapped", env)
    meanings = getattr(base, "get_action_meanings", None)
    if callable(meanings):
        return [str(name) for name in meanings()]
    named: Any = getattr(base, "actions", None)
    is_enum = isinstance(named, type) and issubclass(named, enum.IntEnum)
    return [each.name for each in named] if is_enum else []


def parsed_action(space: Space, given: Any, recorded: Any, names: Sequence[str], is_game: bool) -> Any:
    """Return an action in the dtypes of the recorded one.

    Args:
        space: of the environment's actions; of a game a `Dict` by agent.
        given: text, or a value; of a game `AGENT=VALUE`, or a mapping by agent. None for the recorded action.
        recorded: the recorded action at the same step; of a game those of the agents that acted.
        names: of discrete actions, if known.
        is_game: whether it is a game; agents that are not given act as recorded.

    Raises:
        ConfigError: it is not in the space.
    """
    if given is None:
        return recorded
    if not is_game:
        return _parsed(space, given, recorded, names, "action")
    assert isinstance(space, spaces.Dict)
    if isinstance(given, str):
        agent, equals, value = given.partition("=")
        given = {agent: value} if equals else None
    acting = {str(agent): agent for agent in recorded}
    if not isinstance(given, Mapping) or not all(str(agent) in acting for agent in given):
        raise ConfigError(
            f"action: found {_short(given)}, expected AGENT=VALUE of an agent that acts at this step: "
            f"{', '.join(acting)}"
        )
    own = {acting[str(agent)]: value for agent, value in given.items()}
    return recorded | {
        agent: _parsed(space[agent], value, recorded[agent], names, f"action of {agent}")
        for agent, value in own.items()
    }


def _parsed(space: Space, given: Any, recorded: Any, names: Sequence[str], where: str) -> Any:
    if isinstance(space, spaces.Dict | spaces.Tuple):
        return _parsed_parts(space, given, recorded, where)
    if isinstance(space, spaces.Discrete):
        return _discrete(space, given, names, where)
    if isinstance(space, spaces.Text):
        if isinstance(given, str) and given in space:
            return given
        raise ConfigError(f"{where}: found {_short(given)}, expected a text of {space}")
    try:
        values = given.split(",") if isinstance(given, str) else given
        array = np.asarray(values, np.asarray(recorded).dtype).reshape(np.shape(recorded))
    except (TypeError, ValueError, OverflowError) as error:
        expected = f"numbers separated by commas, of {space}"
        raise ConfigError(f"{where}: found {_short(given)}, expected {expected}") from error
    if isinstance(space, spaces.Box):
        outside = ~((array >= space.low) & (array <= space.high))
        if outside.any():
            at = np.unravel_index(int(np.argmax(outside)), array.shape)
            place = f"[{', '.join(map(str, at))}]" if at else ""
            raise ConfigError(
                f"{where}{place}: found {array[at]:g}, expected {space.low[at]:g} to {space.high[at]:g}"
            )
    elif array not in space:
        raise ConfigError(f"{where}: found {_short(given)}, expected an element of {space}")
    return array


def _parsed_parts(space: Any, given: Any, recorded: Any, where: str) -> Any:
    """Return an action of a `Dict` or `Tuple`, whose text is JSON."""
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
    if not isinstance(values, Sequence) or len(values) != len(space.spaces):
        raise ConfigError(f"{where}: found {_short(values)}, expected a list of {len(space.spaces)} parts")
    return tuple(
        _parsed(part, values[i], recorded[i], (), f"{where}[{i}]") for i, part in enumerate(space.spaces)
    )


def _discrete(space: spaces.Discrete, given: Any, names: Sequence[str], where: str) -> int:
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
            f"{where}: found {_short(given)}, expected {start} to {start + int(space.n) - 1}{named}."
            f"{nearest(str(given), names)}"
        )
    return number


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= _MAX_TEXT else f"{text[:_MAX_TEXT]}…"
