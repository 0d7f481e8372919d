"""The Q-tables at a step: their size and fill, one state with its history, all values as one array.

A job's tables are exact at every step. A loop's tables are the arrays [states, actions] that it recorded by
`snapshot`, the latest of each name.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import BinaryIO, NotRequired, TypedDict

import numpy as np

from runner.analysis.sections import Answer, Grid, Section
from runner.environments.mdp import Mdp
from runner.environments.naming import action_names, actions_in_words, numbered, state_of, states_in_words
from runner.errors import ConfigError, NotInRecording
from runner.learning.watching import new_watch
from runner.recording.messages import Snapshot
from runner.recording.reader import Recording
from runner.replay.steps import last_step, step_of_episode
from runner.replay.tables import TableReplay
from runner.util.arrays import Floats, Ints
from runner.util.humanize import UNKNOWN, number
from runner.util.values import Json


class TableSummary(TypedDict):
    """Size, fill and range of a learner's table."""

    agent: str
    states: int
    actions: int
    zero_cells: int
    percent_filled: float
    lowest: float
    highest: float
    snapshot_step: NotRequired[int]
    """The training steps before a loop recorded it."""


class ActionValue(TypedDict):
    """The value of one action of a learner in a state, with its history."""

    agent: str
    action: int
    action_in_words: str
    value: float
    policy: NotRequired[float]
    """Probability of the action, where the algorithm learns a policy."""
    greedy: bool
    visits: int | None
    """None if a loop did not record all its steps."""
    changed_step: int | None
    """The step that last changed the value; None if none did, and for a loop."""
    changed_episode: int | None


class TablesDescription(TypedDict):
    """The Q-tables at a step; if a state was chosen, with its values."""

    run_id: str
    step: int
    tables: list[TableSummary]
    state: NotRequired[int]
    state_in_words: NotRequired[str]
    visits: NotRequired[int | None]
    """Visits to the state up to the step."""
    values: NotRequired[list[ActionValue]]


@dataclass(frozen=True, eq=False)
class QTables(Answer):
    """The Q-tables at a step."""

    description: TablesDescription
    array: Floats
    """As `one_array` returns them."""

    def as_json(self) -> Json:
        """Return the description of the tables."""
        return dict(self.description)

    def write(self, stream: BinaryIO) -> None:
        """Write the tables as a NumPy file."""
        np.save(stream, self.array)

    def sections(self) -> list[Section]:
        """Return the facts of the tables; if a state was chosen, also its values in each table."""
        description = self.description
        facts = {"run": description["run_id"], "step": f"after {description['step']:,} training steps"}
        for table in description["tables"]:
            text = (
                f"{table['states']:,} states, {table['actions']} actions, {table['percent_filled']:.1f} % "
                f"filled, values from {table['lowest']:.4g} to {table['highest']:.4g}"
            )
            if "snapshot_step" in table:
                text += f"; the latest snapshot, after {table['snapshot_step']:,} steps"
            facts[table["agent"]] = text
        by_agent: dict[str, list[ActionValue]] = {}
        if "state" in description:
            facts["state"] = f"{description['state']}: {description['state_in_words']}"
            facts["visits"] = _count(description["visits"])
            for value in description["values"]:
                by_agent.setdefault(value["agent"], []).append(value)
        states = [Section(agent, grids=[_state_grid(rows)]) for agent, rows in by_agent.items()]
        return [Section("The table", facts=facts), *states]


def _state_grid(rows: Sequence[ActionValue]) -> Grid:
    """Return a learner's values in a state."""
    policy = ("policy",) if "policy" in rows[0] else ()
    cells = [
        (
            str(row["action"]),
            row["action_in_words"],
            number(row["value"], 4),
            *([number(row["policy"], 4)] if policy else []),
            "greedy" if row["greedy"] else "",
            *map(_count, (row["visits"], row["changed_step"], row["changed_episode"])),
        )
        for row in rows
    ]
    return Grid(
        ("action", "", "value", *policy, "greedy", "visits", "changed\nby step", "in\nepisode"), cells
    )


def _count(count: int | None) -> str:
    return UNKNOWN if count is None else f"{count:,}"


def tables_of(
    recording: Recording, step: int | None = None, episode: int | None = None, state: str | None = None
) -> QTables:
    """Return the tables after a number of training steps, or episodes, by default after the last.

    Args:
        state: a number or a name; its values are part of the description.

    Raises:
        ConfigError: there is no such state, or both a step and an episode are given.
        RecordingError: they are not recorded.
    """
    if step is not None and episode is not None:
        raise ConfigError("found a step and an episode, which exclude each other: choose one.")
    if episode is not None:
        step = step_of_episode(recording, episode)
    if not recording.has_tables:
        return _recorded(recording, step, state)
    mdp = recording.mdp
    step = last_step(recording) if step is None else step
    number = None if state is None else state_of(mdp, state)  # before the tables are replayed
    replay = TableReplay(recording, step)
    tables = [_summary(agent, q) for agent, q in zip(replay.agents, replay.tables, strict=True)]
    description: TablesDescription = {"run_id": recording.run_id, "step": replay.step, "tables": tables}
    if number is not None:
        history = history_of(recording, number, replay.step)
        description |= {
            "state": number,
            "state_in_words": str(states_in_words(mdp)[number]),
            "visits": int(history.visits[0].sum()),
            "values": list(_replayed_values(mdp, replay, history, number)),
        }
    return QTables(description, one_array(replay.tables))


def recorded_tables(recording: Recording) -> Iterator[Snapshot]:
    """Yield the arrays of [states, actions] that a loop recorded in training, in order.

    Raises:
        RunnerError: states or actions of the loop have no numbers.
    """
    shape = _shape(recording)
    for array in recording.arrays():
        if array.values.shape == shape and array.phase == "train":
            yield array


def _shape(recording: Recording) -> tuple[int, int]:
    """Return the numbers of states and of actions of a loop."""
    if not recording.has_states:
        recording.require_job("a Q-table", "A loop has one where states and actions are Discrete.")
    return recording.spaces["observation"]["n"], recording.spaces["action"]["n"]


def _recorded(recording: Recording, step: int | None, state: str | None) -> QTables:
    """Return the latest tables that a loop recorded, or the latest at a step."""
    arrays = list(recorded_tables(recording))
    last = max([recording.train.steps.total(), *(array.step for array in arrays)])
    step = last if step is None else step
    latest = {array.name: array for array in arrays if array.step <= step <= last}
    if not latest:
        raise NotInRecording(
            f"{recording.path}: found no table after {step:,} of {last:,} training "
            f"steps, expected an array of shape {list(_shape(recording))}, such as a loop records by "
            '`rec.snapshot("q", q)`.'
        )
    tables = {name: array.values.astype(np.float64) for name, array in latest.items()}
    description: TablesDescription = {
        "run_id": recording.run_id,
        "step": step,
        "tables": [{**_summary(name, q), "snapshot_step": latest[name].step} for name, q in tables.items()],
    }
    if state is not None:
        state_count, action_count = _shape(recording)
        states = list(map(str, states_in_words(recording.mdp) if recording.tabular else range(state_count)))
        number = numbered(state, states, "a state", 1)
        names = recording.train.action_names() or range(action_count)
        stop = max(array.step for array in latest.values())
        visits = None
        if recording.train.steps and recording.train.steps.count() >= stop:  # else steps are missing
            counts = np.zeros(action_count, np.int64)
            for block in recording.train.steps.blocks(0, stop):
                counts += np.bincount(block["action"][block["state"] == number], minlength=action_count)
            visits = counts.tolist()
        description |= {
            "state": number,
            "state_in_words": states[number],
            "visits": None if visits is None else sum(visits),
            "values": [
                value
                for table, q in tables.items()
                for value in _action_values(table, names, q[number], int(q[number].argmax()), visits)
            ],
        }
    return QTables(description, one_array(list(tables.values())))


def _action_values(
    agent: str,
    names: Iterable[object],
    values: Floats,
    greedy: int,
    visits: Sequence[int] | None,
) -> Iterator[ActionValue]:
    """Yield the values of a learner's actions in a state, whose changes are not known."""
    for action, name in enumerate(names):
        yield {
            "agent": agent,
            "action": action,
            "action_in_words": str(name),
            "value": float(values[action]),
            "greedy": action == greedy,
            "visits": None if visits is None else int(visits[action]),
            "changed_step": None,
            "changed_episode": None,
        }


def one_array(tables: Sequence[Floats]) -> Floats:
    """Return the tables as one array, [states, actions], of several learners [learners, states, actions].

    Where learners differ in their actions, cells beyond a learner's own actions are nan.
    """
    if len(tables) == 1:
        return tables[0]
    whole = np.full((len(tables), len(tables[0]), max(q.shape[1] for q in tables)), np.nan)
    for i, q in enumerate(tables):
        whole[i, :, : q.shape[1]] = q
    return whole


def _summary(agent: str, q: Floats) -> TableSummary:
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


def _replayed_values(
    mdp: Mdp, replay: TableReplay, history: StateHistory, state: int
) -> Iterator[ActionValue]:
    """Yield the values of all learners' actions in a state, with their history."""
    joint, of_agents = actions_in_words(mdp), action_names(mdp)
    for i, (agent, named) in enumerate(zip(replay.agents, replay.named_tables, strict=True)):
        q = named["q"]
        names = joint if q.shape[1] == mdp.joint_actions else of_agents[i] if of_agents else range(q.shape[1])
        greedy = int(replay.learner.tables.greedy[i, state])
        for value in _action_values(agent, names, q[state], greedy, history.visits[i]):
            action = value["action"]
            if (changed := int(history.changed_step[i, action])) >= 0:
                value["changed_step"] = changed
                value["changed_episode"] = int(history.changed_episode[i, action])
            if "policy" in named:
                value["policy"] = float(named["policy"][state, action])
            yield value


# --- the history of a state ----------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class StateHistory:
    """How often a state was visited, and when its values last changed; arrays [learners, most actions].

    An entry beyond a learner's own actions has no meaning.
    """

    visits: Ints
    """How often the learner took the action there."""
    changed_step: Ints
    """The step that last changed the value; -1 for never. An update by nothing changes nothing."""
    changed_episode: Ints
    """The episode of that step."""


def history_of(recording: Recording, state: int, step: int) -> StateHistory:
    """Return the history of a state's values in the first `step` training steps, by replaying them."""
    replay = TableReplay(recording)
    widths = np.array(replay.learner.model.width)
    is_action = np.arange(widths.max()) < widths[:, np.newaxis]
    visits: Ints = np.zeros(is_action.shape, np.int64)
    changed_step = np.full(widths.sum(), -1)
    changed_episode = np.full(widths.sum(), -1)
    offsets = zip(replay.learner.tables.offset, widths, strict=True)
    cells = np.concatenate([offset + state * width + np.arange(width) for offset, width in offsets])
    watch = new_watch(np.arange(replay.learner.mdp.states) == state, cells)
    before = replay.begin_watch(watch).q
    for steps in replay.blocks(step):
        changes = replay.watch(steps, watch)
        taken = replay.learner.model.own_action[steps["action"][steps["state"] == state]]
        for i, actions in enumerate(taken.T):
            visits[i] += np.bincount(actions, minlength=visits.shape[1])
        values = np.concatenate([before, changes.q])
        bits = values.view(np.int64)
        rows, cells = np.nonzero(bits[1:] != bits[:-1])
        changed_step[cells] = steps["step"][changes.row[rows]]  # of several the last
        changed_episode[cells] = steps["episode"][changes.row[rows]]
        before = values[-1:]
    history = StateHistory(visits, np.full(visits.shape, -1), np.full(visits.shape, -1))
    history.changed_step[is_action] = changed_step
    history.changed_episode[is_action] = changed_episode
    return history
