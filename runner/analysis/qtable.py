"""The Q-table of a moment, told: size and fill, one state with its history, all of it as one array."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runner.environments.naming import action_names, actions_in_words, states_in_words
from runner.errors import RunnerError
from runner.recording.reader import Recording
from runner.replay.history import history_of
from runner.replay.tables import TableReplay, last_step, step_of_episode


def at_moment(recording: Recording, step: int | None = None, episode: int | None = None) -> TableReplay:
    """Return the tables after so many training steps, or episodes; the last there are unless told.

    Raises:
        RecordingError: there is no such moment, or the steps before it are not recorded.
    """
    if episode is not None:
        step = step_of_episode(recording, episode)
    return TableReplay(recording, last_step(recording) if step is None else step)


def told_of(recording: Recording, replay: TableReplay, state: int | None = None) -> dict[str, Any]:
    """Return what is told of the tables where a replay stands, as JSON can hold it.

    Raises:
        RunnerError: there is no such state.
        RecordingError: the steps are not recorded, which a state's history needs.
    """
    told: dict[str, Any] = {"run": recording.run_id, "step": replay.step}
    pairs = zip(replay.agents, replay.tables, strict=True)
    told["tables"] = [summary_of(agent, values) for agent, values in pairs]
    return told if state is None else told | state_of(recording, replay, state)


def one_array(tables: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return the tables as one array, [states, actions], of several learners [learners, states, actions].

    Where learners differ in their actions, the places left over are nan.
    """
    if len(tables) == 1:
        return tables[0]
    whole = np.full((len(tables), len(tables[0]), max(values.shape[1] for values in tables)), np.nan)
    for i, values in enumerate(tables):
        whole[i, :, : values.shape[1]] = values
    return whole


def summary_of(agent: str, values: NDArray[np.float64]) -> dict[str, Any]:
    """Return size, fill and range of a learner's table, as JSON can hold them."""
    zeros = int(values.size - (values != 0).sum())
    return {
        "agent": agent,
        "states": values.shape[0],
        "actions": values.shape[1],
        "zero_cells": zeros,
        "percent_filled": 100.0 * (values.size - zeros) / values.size,
        "lowest": float(values.min()),
        "highest": float(values.max()),
    }


def state_of(recording: Recording, replay: TableReplay, state: int) -> dict[str, Any]:
    """Return the values of a state where the replay stands, their history, and its words.

    Raises:
        RunnerError: there is no such state.
        RecordingError: the steps are not recorded.
    """
    mdp = recording.mdp
    if state >= mdp.states:
        raise RunnerError(f"state: found {state}, expected one of 0 to {mdp.states - 1}.")
    history = history_of(recording, state, replay.step)
    joint, own = actions_in_words(mdp), action_names(mdp)
    values = []
    for i, (agent, held) in enumerate(zip(replay.agents, replay.held, strict=True)):
        q = held["q"]
        names = joint if q.shape[1] == mdp.joint_actions else own[i] if own else range(q.shape[1])
        for action, name in enumerate(names):
            changed = int(history.changed_step[i, action])
            values.append(
                {
                    "agent": agent,
                    "action": action,
                    "action_in_words": str(name),
                    "value": float(q[state, action]),
                    **({"policy": float(held["policy"][state, action])} if "policy" in held else {}),
                    "greedy": bool(replay.greedy[i, state] == action),
                    "visits": int(history.visits[i, action]),
                    "changed_step": None if changed < 0 else changed,
                    "changed_episode": None if changed < 0 else int(history.changed_episode[i, action]),
                }
            )
    words = str(states_in_words(mdp)[state])
    return {"state": state, "state_in_words": words, "visits": int(history.visits[0].sum()), "values": values}
