"""Names of states, joint actions, and events for people.

They are derived from the scene that the environment, or the recording, includes:

    taxi 1 (0,0), taxi 2 (3,2), passenger at R, destination B        a state
    south + pickup                                                   a joint action

Without a scene the names are `state 17` and `action 3`.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from runner.environments.mdp import Mdp, SceneDescription, Thing
from runner.errors import ConfigError, nearest

MAX_LISTED: Final = 8
"""Names that an error lists."""


def states_in_words(mdp: Mdp) -> NDArray[np.object_]:
    """Return the name of every state, [S] of str: index it by a state, or by an array of states."""
    scene, cells = mdp.scene, mdp.scene_cells
    if scene is None or cells is None:
        return np.array([f"state {state}" for state in range(mdp.states)], object)
    placed = zip(scene["things"], cells.T, mdp.carriers.T, strict=True)
    things = [_thing_in_words(scene, thing, where, carriers) for thing, where, carriers in placed]
    return np.array([", ".join(words) for words in zip(*things, strict=True)], object)


def actions_in_words(mdp: Mdp) -> NDArray[np.object_]:
    """Return the name of every joint action, [J] of str: `south + pickup`."""
    named = action_names(mdp)
    if named is None:
        return np.array([f"action {action}" for action in range(mdp.joint_actions)], object)
    return np.array([" + ".join(words) for words in itertools.product(*named)], object)


def action_names(mdp: Mdp) -> list[list[str]] | None:
    """Return the names of each agent's actions; None where the scene does not name them."""
    actions = [] if mdp.scene is None else mdp.scene["actions"]
    if any(count != len(actions) for count in mdp.action_counts):
        return None
    names = [spoken(action["name"]) for action in actions]
    return [names for _ in mdp.agents]


def agent_actions_in_words(mdp: Mdp) -> list[str]:
    """Return every joint action as text, with its agents: `taxi 1 south, taxi 2 pickup`."""
    words: list[str] = actions_in_words(mdp).tolist()
    if len(mdp.agents) < 2 or action_names(mdp) is None:
        return words
    names = [spoken(agent) for agent in mdp.agents]
    return [
        ", ".join(f"{name} {action}" for name, action in zip(names, word.split(" + "), strict=True))
        for word in words
    ]


def numbered_actions(mdp: Mdp) -> list[list[str]]:
    """Return the names of each agent's actions; `action 3` where the scene does not name them."""
    return action_names(mdp) or [[f"action {i}" for i in range(count)] for count in mdp.action_counts]


def agent_of(mdp: Mdp, name: str) -> int:
    """Return the number of the agent with this name, written as in the environment or as people write it.

    Raises:
        ConfigError: there is none.
    """
    numbers = {text: i for i, agent in enumerate(mdp.agents) for text in (agent, spoken(agent))}
    if name not in numbers:
        raise ConfigError(
            f"found the agent {name[:60]!r}, expected {' or '.join(mdp.agents)}.{nearest(name, mdp.agents)}"
        )
    return numbers[name]


def state_of(mdp: Mdp, text: str) -> int:
    """Return a state from its name, such as `taxi 1 (0,0), passenger at B`, or its number."""
    return numbered(text, states_in_words(mdp).tolist(), "a state", 1)


def own_action(mdp: Mdp, agent: int, text: str) -> int:
    """Return an agent's action from its name or its number."""
    names = numbered_actions(mdp)[agent]
    return numbered(text, names, f"an action of {spoken(mdp.agents[agent])}")


def joint_action(mdp: Mdp, text: str) -> int:
    """Return a joint action from its name, such as `pickup + east`, or its number."""
    return numbered(text, actions_in_words(mdp).tolist(), "a joint action")


def numbered(text: str, names: list[str], what: str, listed: int = MAX_LISTED) -> int:
    """Return the number that a text is, or that it names; an error lists some names."""
    if text.isascii() and text.isdecimal() and len(text) <= 12 and int(text) < len(names):
        return int(text)
    wanted = " + ".join(part.strip() for part in spoken(text).split("+"))
    if wanted in names:
        return names.index(wanted)
    examples = "; ".join(names[:listed]) + ("; ..." if len(names) > listed else "")
    raise ConfigError(
        f"found {text[:60]!r}, expected {what}: {examples}; or a number from 0 to {len(names) - 1}."
        f"{nearest(wanted, names)}"
    )


def agent_actions(mdp: Mdp, action: int) -> tuple[int, ...]:
    """Return the action of each agent in a joint action."""
    return tuple(mdp.own_actions[action].tolist())


def exploration_in_words(mask: int, learners: Sequence[str]) -> str:
    """Return which learners explored in a step: `explored` if all did, `taxi 1 explored`, or nothing.

    Args:
        mask: the step's `explored`: bit i is learner i.
    """
    explorers = [spoken(name) for i, name in enumerate(learners) if mask >> i & 1]
    if not explorers or len(explorers) == len(learners):
        return "explored" if explorers else ""
    return f"{' and '.join(explorers)} explored"


def rewards_in_words(rewards: Iterable[float]) -> str:
    """Return the rewards of all learners in a step: `-1 and 20`."""
    return " and ".join(f"{reward:g}" for reward in rewards)


def event_in_words(name: str) -> str:
    """Return an event's name as people write it: `taxi_1.drop_off` is `taxi 1 drop-off`."""
    agent, _, event = name.rpartition(".")
    return f"{agent.replace('_', ' ')} {spoken(event)}".strip()


def events_in_words(mdp: Mdp, mask: int) -> str:
    """Return the names of the events of a bit mask, separated by commas."""
    return ", ".join(event_in_words(name) for bit, name in enumerate(mdp.event_names) if mask >> bit & 1)


def spoken(name: str) -> str:
    """Return a name as people write it: `drop_off` is `drop-off`, `illegal_pickup` is `illegal pickup`."""
    return name.replace("drop_off", "drop-off").replace("_", " ")


def _thing_in_words(
    scene: SceneDescription, thing: Thing, cells: NDArray[np.int16], carriers: NDArray[np.int8]
) -> list[str]:
    """Return the place of one thing in every state.

    A mover is at a cell; any other thing is in its carrier, at a landmark if there is one, or at a cell.
    """
    label = thing["label"]
    columns = scene["columns"]
    places = [f"{label} ({cell // columns},{cell % columns})" for cell in range(scene["rows"] * columns)]
    if thing["kind"] != "mover":
        between = " " if thing["kind"] == "goal" else " at "
        for mark in scene["landmarks"]:
            row, column = mark["cell"]
            places[row * columns + column] = f"{label}{between}{mark['name']}"
    carried = [f"{label} in {carrier['label']}" for carrier in scene["things"]]
    where: Sequence[int] = (np.where(carriers >= 0, carriers + len(places), cells)).tolist()
    words = places + carried
    return [words[index] for index in where]
