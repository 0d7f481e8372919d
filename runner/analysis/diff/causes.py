"""Why two trajectories part, as far as the recordings show it.

At the step where they part either the start state differs, or whether the learner explored, or which
random action it took, or which action was greedy, or what the same action led to. A greedy action differs
because the tables do: then the first update that made them differ is the cause, found by replaying both
runs up to there side by side.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runner.analysis.diff.trajectory import Parting
from runner.analysis.tables import TableReplay
from runner.recording import schema
from runner.recording.reader import Recording
from runner.words import actions_in_words, states_in_words

_STEPS_AT_ONCE = 1 << 16


@dataclass(frozen=True)
class Update:
    """The first update by which two runs' tables came to differ."""

    step: int
    episode: int
    state: str
    action: str
    agent: str
    a: float
    b: float
    """The value after the update, in each run."""
    rewards_a: list[float]
    rewards_b: list[float]


@dataclass(frozen=True)
class Cause:
    """Why two runs part at a step."""

    kind: str
    """start, exploration, random_action, greedy_action, transition, or end."""
    text: str
    rows: dict[str, dict[str, list[float]]] = field(default_factory=dict)
    """Agent to its Q-values in that state, in run a and b."""
    update: Update | None = None


def cause_of(parting: Parting, a: Recording, b: Recording) -> Cause:
    """Return why two runs part where they do."""
    left, right = parting.a_step, parting.b_step
    if left is None or right is None:
        longer = "B" if left is None else "A"
        return Cause("end", f"the same as far as the shorter goes; only {longer} goes on")
    if parting.t == 0 and left["state"] != right["state"]:
        states = [states_in_words(r.mdp)[s["state"]] for r, s in ((a, left), (b, right))]
        return Cause("start", f"other start state: {states[0]} in A, {states[1]} in B")
    if bool(left["explored"]) != bool(right["explored"]):
        explorer = "A" if left["explored"] else "B"
        return Cause("exploration", f"{explorer} explored there, the other took its greedy action")
    actions = [actions_in_words(r.mdp)[s["action"]] for r, s in ((a, left), (b, right))]
    if left["action"] != right["action"]:
        text = f"{actions[0]} in A, {actions[1]} in B"
        if left["explored"]:
            return Cause("random_action", f"both explored, and drew another action: {text}")
        return _greedy(parting, a, b, text)
    return Cause(
        "transition", f"the same action ({actions[0]}) led to something else: {_outcome_text(parting)}"
    )


def _outcome_text(parting: Parting) -> str:
    return f"{parting.field.replace('_', ' ')} {parting.a} in A, {parting.b} in B"


def _greedy(parting: Parting, a: Recording, b: Recording, text: str) -> Cause:
    """Return the cause of another greedy action, with both Q-rows, and the first update that differs."""
    step = _training_step(parting, a)
    replays = [TableReplay(recording, step) for recording in (a, b)]
    assert parting.a_step is not None
    state = int(parting.a_step["state"])
    rows = {
        agent: {name: replay.tables[i][state].tolist() for name, replay in zip("ab", replays, strict=True)}
        for i, agent in enumerate(replays[0].agents)
        if replays[0].agents == replays[1].agents
    }
    return Cause("greedy_action", f"other greedy action: {text}", rows, first_update(a, b, step))


def _training_step(parting: Parting, a: Recording) -> int:
    """Return how many training steps were taken when the parting step was chosen."""
    if parting.evaluation is None:
        return parting.step
    return int(a.metrics("eval")[parting.evaluation]["step"])


def first_update(a: Recording, b: Recording, stop: int) -> Update | None:
    """Return the first update within `stop` steps after which two runs' tables differ; None if none does.

    Both runs are replayed from their beginning, so this takes the time of reading that many steps twice.
    """
    start = _last_equal_snapshot(a, b, stop)
    left, right = TableReplay(a, start), TableReplay(b, start)
    if left.agents != right.agents or not _same(left, right):
        return None
    for step in range(start, stop, _STEPS_AT_ONCE):
        k = _first_difference(left, right, step, min(step + _STEPS_AT_ONCE, stop))
        if k is not None:
            return _update_at(a, b, k)
    return None


def _last_equal_snapshot(a: Recording, b: Recording, stop: int) -> int:
    """Return the last step before `stop` at which both runs have snapshots, all of them equal; or 0."""
    last = step = 0
    equal = True
    for left, right in zip(a.snapshots(), b.snapshots(), strict=False):
        if left.step != right.step or left.step > stop:
            break
        if left.step != step:
            last, step = (step if equal else last), left.step
        equal = equal and np.array_equal(left.values, right.values)
        if not equal:
            break
    return last


def _first_difference(left: TableReplay, right: TableReplay, start: int, stop: int) -> int | None:
    """Replay both up to `stop`; return the step whose update made them differ first, by bisection."""
    before = [[table.copy() for table in replay.tables] for replay in (left, right)]
    left.advance(stop)
    right.advance(stop)
    if _same(left, right):
        return None
    while stop - start > 1:
        middle = (start + stop) // 2
        for replay, tables in zip((left, right), before, strict=True):
            replay.rewind(start, tables)
            replay.advance(middle)
        if _same(left, right):
            start, before = middle, [[table.copy() for table in replay.tables] for replay in (left, right)]
        else:
            stop = middle
    return start


def _same(left: TableReplay, right: TableReplay) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(left.tables, right.tables, strict=True))


def _update_at(a: Recording, b: Recording, step: int) -> Update:
    """Return the update of a step, with its value in both runs."""
    records = [next(recording.blocks(schema.TRAIN_STEP, step, step + 1))[0] for recording in (a, b)]
    after = [TableReplay(recording, step + 1) for recording in (a, b)]
    state = int(records[0]["state"])
    learner, action = _changed_cell([replay.tables for replay in after], state)
    words = actions_in_words(a.mdp)[int(records[0]["action"])]
    return Update(
        step=step,
        episode=int(records[0]["episode"]),
        state=str(states_in_words(a.mdp)[state]),
        action=str(words),
        agent=after[0].agents[learner],
        a=float(after[0].tables[learner][state, action]),
        b=float(after[1].tables[learner][state, action]),
        rewards_a=records[0]["rewards"].tolist(),
        rewards_b=records[1]["rewards"].tolist(),
    )


def _changed_cell(tables: list[list[NDArray[Any]]], state: int) -> tuple[int, int]:
    """Return the learner and own action in which two sets of tables differ in a state."""
    for learner, (left, right) in enumerate(zip(*tables, strict=True)):
        differs = np.flatnonzero(left[state] != right[state])
        if len(differs):
            return learner, int(differs[0])
    return 0, 0
