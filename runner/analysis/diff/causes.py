"""Why two trajectories part, as far as the recordings show it.

At the step where they part either the start state differs, or which learners explored, or which random
action one of them took, or which action was greedy, or what the same action led to. A greedy action differs
because the tables do: then the first update that made them differ is the cause, found by replaying both
runs up to there side by side.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from runner.analysis.diff.tables import own_actions_in_words
from runner.analysis.diff.trajectory import Parting
from runner.environments.naming import actions_in_words, agent_actions, exploration_in_words, states_in_words
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.reader import Recording
from runner.replay.checks import check_steps

if TYPE_CHECKING:
    from runner.learning.learner import Held
    from runner.replay.tables import TableReplay

_STEPS_AT_ONCE = 1 << 16
_OF_TABLES = ("greedy_action", "policy_action")
"""Kinds of causes that lie in the tables."""


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
    reasons: list[str] = field(default_factory=list)
    """What went into the update and differs, in words."""


@dataclass(frozen=True)
class Row:
    """The Q-values of one agent in a state, in both runs."""

    agent: str
    actions: list[str]
    """What each value is of, in words."""
    a: list[float]
    b: list[float]


@dataclass(frozen=True)
class Cause:
    """Why two runs part at a step."""

    kind: str
    """start, exploration, random_action, greedy_action, policy_action, transition, or end."""
    text: str
    rows: list[Row] = field(default_factory=list)
    """The Q-values of each agent in the state in which the greedy actions differ."""
    update: Update | None = None


def cause_of(
    parting: Parting, a: Recording, b: Recording, training: tuple[Parting, Cause] | None = None
) -> Cause:
    """Return why two runs part where they do, back to the update that made their tables differ.

    Args:
        parting: where.
        a: one run.
        b: the other.
        training: where and why their training parts, if that is known; it spares finding it again.
    """
    cause = kind_of(parting, a, b)
    if cause.kind in _OF_TABLES:
        return _from_tables(cause, parting, a, b, training)
    return cause


def kind_of(parting: Parting, a: Recording, b: Recording) -> Cause:
    """Return what differs where two runs part, as the steps alone tell it; no table is replayed."""
    left, right = parting.a_step, parting.b_step
    if left is None or right is None:
        longer = "B" if left is None else "A"
        return Cause("end", f"the same as far as the shorter goes; only {longer} goes on")
    for recording, step in ((a, left), (b, right)):
        name = schema.PHASE_NAMES[parting.phase]
        check_steps(np.array([step]), recording.mdp, str(recording.path), name)
    if parting.field in ("episode", "t"):
        return Cause("transition", f"an episode ended in one of them: {_outcome_text(parting)}")
    if parting.t == 0 and left["state"] != right["state"]:
        states = [states_in_words(r.mdp)[s["state"]] for r, s in ((a, left), (b, right))]
        return Cause("start", f"other start state: {states[0]} in A, {states[1]} in B")
    explorers = [_explorers(recording, step) for recording, step in ((a, left), (b, right))]
    alike = explorers[0] == explorers[1]
    if len(explorers[0]) != len(explorers[1]):  # other learners: whether any of them explored
        alike = any(explorers[0]) == any(explorers[1])
    if not alike:
        return Cause("exploration", _exploration_text(left, right, a, b))
    return _action_or_outcome(parting, left, right, a, b)


def _explorers(recording: Recording, step: np.void) -> list[bool]:
    """Return whether each learner explored in a step."""
    return [bool(int(step["explored"]) >> i & 1) for i in range(len(recording.agents))]


def _exploration_text(left: np.void, right: np.void, a: Recording, b: Recording) -> str:
    """Return who explored in either run: `A explored there, B took its greedy action`."""
    words = [exploration_in_words(int(s["explored"]), r.agents) for r, s in ((a, left), (b, right))]
    if len(a.agents) == len(b.agents) == 1:
        explorer, other = ("A", "B") if words[0] else ("B", "A")
        acted = "an action of its learned policy" if _draws_actions(a, b) else "its greedy action"
        return f"{explorer} explored there, {other} took {acted}"
    said = ["all learners explored" if word == "explored" else word or "none explored" for word in words]
    return f"other learners explored: {said[0]} in A, {said[1]} in B"


def _draws_actions(a: Recording, b: Recording) -> bool:
    """Return whether either run draws the actions that do not explore from a learned policy."""
    return "wolf_phc" in (a.config.get("algorithm"), b.config.get("algorithm"))


def _action_or_outcome(parting: Parting, left: np.void, right: np.void, a: Recording, b: Recording) -> Cause:
    """Return what differs where two runs part in the same state, and the same learners explored."""
    actions = [actions_in_words(r.mdp)[s["action"]] for r, s in ((a, left), (b, right))]
    if left["action"] == right["action"]:
        told = _outcome_text(parting, a, b)
        return Cause("transition", f"the same action ({actions[0]}) led to something else: {told}")
    text = f"{actions[0]} in A, {actions[1]} in B"
    if _other_choices_are_random(left, right, a, b):
        who = "both" if all(_explorers(a, left)) else "the same learners"
        return Cause("random_action", f"{who} explored, and drew another action: {text}")
    if _draws_actions(a, b):
        return Cause("policy_action", f"another action, drawn from a learned policy: {text}")
    return Cause("greedy_action", f"other greedy action: {text}")


def _other_choices_are_random(left: np.void, right: np.void, a: Recording, b: Recording) -> bool:
    """Return whether all learners that chose another action in B explored, in both runs."""
    explorers = _explorers(a, left)
    if len(explorers) != len(_explorers(b, right)) or len(explorers) != len(a.mdp.agents):
        return bool(left["explored"])
    own = [agent_actions(r.mdp, int(s["action"])) for r, s in ((a, left), (b, right))]
    return all(explored for explored, ours, theirs in zip(explorers, *own, strict=True) if ours != theirs)


def _outcome_text(parting: Parting, *recordings: Recording) -> str:
    """Return what differs in words: `rewards [-10.0] in A, [-7.0] in B`."""
    values = [parting.a, parting.b]
    if parting.field in ("state", "next_state") and recordings:
        values = [states_in_words(r.mdp)[v] for r, v in zip(recordings, values, strict=True)]
    elif parting.field == "rewards":
        values = [_reward_text(value) for value in values]
    name = "reward" if parting.field == "rewards" else parting.field.replace("_", " ")
    return f"{name} {values[0]} in A, {values[1]} in B"


def _reward_text(rewards: list[float]) -> str:
    return " and ".join(f"{reward:g}" for reward in rewards)


def _from_tables(
    cause: Cause, parting: Parting, a: Recording, b: Recording, training: tuple[Parting, Cause] | None
) -> Cause:
    """Return the cause of another choice, with both Q-rows, and the first update that differs."""
    from runner.replay.tables import TableReplay

    steps = parting.trained or (parting.step, parting.step)  # taken when the step was chosen
    known = training is not None and training[0].step < min(steps)
    try:
        if known or steps[0] != steps[1] or a.agents != b.agents:
            replays = [TableReplay(recording, step) for recording, step in zip((a, b), steps, strict=True)]
            update = training[1].update if training is not None and known else None
        else:
            replays, update = _replayed(a, b, steps[0])
    except RecordingError as error:
        return dataclasses.replace(cause, text=f"{cause.text}; the tables there cannot be had ({error})")
    assert parting.a_step is not None
    return dataclasses.replace(cause, rows=_rows(replays, a, int(parting.a_step["state"])), update=update)


def _rows(replays: list[TableReplay], a: Recording, state: int) -> list[Row]:
    """Return the Q-values in a state; none if the runs have other agents."""
    left, right = replays
    if left.agents != right.agents:
        return []
    return [
        Row(
            agent, own_actions_in_words(a.mdp, i, ours.shape[1]), ours[state].tolist(), theirs[state].tolist()
        )
        for i, (agent, ours, theirs) in enumerate(zip(left.agents, left.tables, right.tables, strict=True))
    ]


def _replayed(a: Recording, b: Recording, stop: int) -> tuple[list[TableReplay], Update | None]:
    """Return both runs' tables at a step up to which they went alike, and the first update that differs.

    Raises:
        RecordingError: the tables cannot be had.
    """
    from runner.replay.tables import TableReplay

    start = _last_equal_snapshot(a, b, stop)
    left, right = TableReplay(a, start), TableReplay(b, start)
    update = None
    if _same(left, right):
        for step in range(start, stop, _STEPS_AT_ONCE):
            k = _first_difference(left, right, step, min(step + _STEPS_AT_ONCE, stop))
            if k is not None:
                update = _update_at(a, b, k, left, right)
                break
    for replay in (left, right):
        replay.advance(stop)
    return [left, right], update


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
    """Replay both up to `stop`; return the step whose update made them differ first, by bisection.

    If there is one, both are left before that step.
    """
    before = [_copied(replay) for replay in (left, right)]
    left.advance(stop)
    right.advance(stop)
    if _same(left, right):
        return None
    while stop - start > 1:
        middle = (start + stop) // 2
        for replay, contents in zip((left, right), before, strict=True):
            replay.rewind(start, contents)
            replay.advance(middle)
        if _same(left, right):
            start, before = middle, [_copied(replay) for replay in (left, right)]
        else:
            stop = middle
    for replay, contents in zip((left, right), before, strict=True):
        replay.rewind(start, contents)
    return start


def _copied(replay: TableReplay) -> list[Held]:
    """Return all that the learners hold now, to go back to."""
    return [{name: array.copy() for name, array in one.items()} for one in replay.held]


def _same(left: TableReplay, right: TableReplay) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(left.tables, right.tables, strict=True))


def _update_at(a: Recording, b: Recording, step: int, left: TableReplay, right: TableReplay) -> Update:
    """Return the update of a step that makes the tables differ; both replays stand before it."""
    records = [next(recording.blocks(schema.TRAIN_STEP, step, step + 1))[0] for recording in (a, b)]
    left.advance(step + 1)
    right.advance(step + 1)
    state = int(records[0]["state"])
    learner, action = _changed_cell(left.tables, right.tables, state)
    names = own_actions_in_words(a.mdp, learner, left.tables[learner].shape[1])
    return Update(
        step=step,
        episode=int(records[0]["episode"]),
        state=str(states_in_words(a.mdp)[state]),
        action=names[action],
        agent=left.agents[learner],
        a=float(left.tables[learner][state, action]),
        b=float(right.tables[learner][state, action]),
        rewards_a=records[0]["rewards"].tolist(),
        rewards_b=records[1]["rewards"].tolist(),
        reasons=_reasons(a, b, records),
    )


def _changed_cell(ours: list[NDArray[Any]], theirs: list[NDArray[Any]], state: int) -> tuple[int, int]:
    """Return the learner and own action in which two sets of tables differ in a state."""
    for learner, (left, right) in enumerate(zip(ours, theirs, strict=True)):
        differs = np.flatnonzero(left[state] != right[state])
        if len(differs):
            return learner, int(differs[0])
    return 0, 0


def _reasons(a: Recording, b: Recording, records: list[np.void]) -> list[str]:
    """Return what went into an update of both runs and differs, in words."""
    from runner.config import from_mapping
    from runner.learning.schedules import compile_schedule, schedule_value

    left, right = (from_mapping(recording.config) for recording in (a, b))
    episode, step = int(records[0]["episode"]), int(records[0]["step"])
    said = []
    rewards = [record["rewards"].tolist() for record in records]
    if rewards[0] != rewards[1]:
        said.append(f"the reward was {_reward_text(rewards[0])} in A, {_reward_text(rewards[1])} in B")
    for name in ("step_size", "discount"):
        if getattr(left, name) == getattr(right, name):
            continue
        schedules = [compile_schedule(getattr(config, name)) for config in (left, right)]
        x, y = (float(schedule_value(schedule, episode, step)) for schedule in schedules)
        if x != y:
            said.append(f"the {name.replace('_', ' ')} was {x:g} in A, {y:g} in B")
    if left.quirks.second_table_uses_first_action != right.quirks.second_table_uses_first_action:
        quirky = "A" if left.quirks.second_table_uses_first_action else "B"
        said.append(
            f"{quirky} updated the second agent's table at the first agent's action "
            "(quirks.second_table_uses_first_action)"
        )
    if left.quirks.bootstrap_after_termination != right.quirks.bootstrap_after_termination:
        quirky = "A" if left.quirks.bootstrap_after_termination else "B"
        if records[0]["terminated"]:
            said.append(
                f"{quirky} added the value of the next state although the episode had ended "
                "(quirks.bootstrap_after_termination)"
            )
    return said
