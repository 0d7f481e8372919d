"""The Q-tables at a step: their size and fill, one state with its history, all values as one array."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NotRequired, TypedDict

import numpy as np
from numpy.typing import NDArray

from runner.environments.naming import action_names, actions_in_words, states_in_words
from runner.errors import RunnerError
from runner.recording.reader import Recording
from runner.replay.history import history_of
from runner.replay.steps import last_step, step_of_episode
from runner.replay.tables import TableReplay


class TableSummary(TypedDict):
    """Size, fill and range of a learner's table."""

    agent: str
    states: int
    actions: int
    zero_cells: int
    percent_filled: float
    lowest: float
    highest: float


class ActionValue(TypedDict):
    """The value of one action of a learner in a state, with its history."""

    agent: str
    action: int
    action_in_words: str
    value: float
    policy: NotRequired[float]
    """Probability of the action, where the algorithm learns a policy."""
    greedy: bool
    visits: int
    changed_step: int | None
    changed_episode: int | None


class TablesDescription(TypedDict):
    """The Q-tables at a step; if a state was chosen, with its values."""

    run_id: str
    step: int
    tables: list[TableSummary]
    state: NotRequired[int]
    state_in_words: NotRequired[str]
    visits: NotRequired[int]
    """Visits to the state up to the step."""
    values: NotRequired[list[ActionValue]]


def replay_at(recording: Recording, step: int | None = None, episode: int | None = None) -> TableReplay:
    """Return the tables after a number of training steps, or episodes; by default after the last."""
    if episode is not None:
        step = step_of_episode(recording, episode)
    return TableReplay(recording, last_step(recording) if step is None else step)


def describe_tables(recording: Recording, replay: TableReplay, state: int | None = None) -> TablesDescription:
    """Return the tables at the step of a replay as JSON can hold them, with a state's values if given."""
    tables = [summarize(agent, q) for agent, q in zip(replay.agents, replay.tables, strict=True)]
    description: TablesDescription = {"run_id": recording.run_id, "step": replay.step, "tables": tables}
    if state is not None:
        _add_state(description, recording, replay, state)
    return description


def one_array(tables: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return the tables as one array, [states, actions], of several learners [learners, states, actions].

    Where learners differ in their actions, the places left over are nan.
    """
    if len(tables) == 1:
        return tables[0]
    whole = np.full((len(tables), len(tables[0]), max(q.shape[1] for q in tables)), np.nan)
    for i, q in enumerate(tables):
        whole[i, :, : q.shape[1]] = q
    return whole


def summarize(agent: str, q: NDArray[np.float64]) -> TableSummary:
    """Return size, fill and range of a learner's table [states, actions]."""
    zeros = int(q.size - np.count_nonzero(q))
    return {
        "agent": agent,
        "states": q.shape[0],
        "actions": q.shape[1],
        "zero_cells": zeros,
        "percent_filled": 100.0 * (q.size - zeros) / q.size,
        "lowest": float(q.min()),
        "highest": float(q.max()),
    }


def _add_state(description: TablesDescription, recording: Recording, replay: TableReplay, state: int) -> None:
    mdp = recording.mdp
    if state >= mdp.states:
        raise RunnerError(f"state: found {state}, expected one of 0 to {mdp.states - 1}.")
    history = history_of(recording, state, replay.step)
    joint, own = actions_in_words(mdp), action_names(mdp)
    values: list[ActionValue] = []
    for i, (agent, named) in enumerate(zip(replay.agents, replay.named_tables, strict=True)):
        q = named["q"]
        names = joint if q.shape[1] == mdp.joint_actions else own[i] if own else range(q.shape[1])
        for action, name in enumerate(names):
            changed = int(history.changed_step[i, action])
            value: ActionValue = {
                "agent": agent,
                "action": action,
                "action_in_words": str(name),
                "value": float(q[state, action]),
                "greedy": bool(replay.greedy[i, state] == action),
                "visits": int(history.visits[i, action]),
                "changed_step": None if changed < 0 else changed,
                "changed_episode": None if changed < 0 else int(history.changed_episode[i, action]),
            }
            if "policy" in named:
                value["policy"] = float(named["policy"][state, action])
            values.append(value)
    description["state"] = state
    description["state_in_words"] = str(states_in_words(mdp)[state])
    description["visits"] = int(history.visits[0].sum())
    description["values"] = values
