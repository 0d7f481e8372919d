"""Why two runs diverge at a step, as far as their recordings show it.

At the step where they diverge either the start state differs, or which learners explored, or which random
action one of them took, or which action was greedy, or what the same action led to. A greedy action differs
because the tables do: then the cause is the first update that made them differ, found by replaying both runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from runner.analysis.diff.divergence import Divergence
from runner.analysis.diff.tables import own_actions_in_words
from runner.environments.naming import actions_in_words, agent_actions, exploration_in_words, states_in_words
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.reader import Recording
from runner.replay.steps import check_steps

if TYPE_CHECKING:
    from runner.learning.learner import Held
    from runner.replay.tables import TableReplay

_BATCH_STEPS: Final = 1 << 16
_CAUSED_BY_TABLES: Final = ("greedy_action", "policy_action")


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
    """Descriptions of the inputs of the update that differ."""


@dataclass(frozen=True)
class Row:
    """The Q-values of one agent in a state, in both runs."""

    agent: str
    actions: list[str]
    """The name of each value's action."""
    a: list[float]
    b: list[float]


@dataclass(frozen=True)
class Cause:
    """Why two runs diverge at a step."""

    kind: str
    """start, exploration, random_action, greedy_action, policy_action, transition, or end."""
    text: str
    rows: list[Row] = field(default_factory=list)
    """The Q-values of each agent in the state in which the greedy actions differ."""
    update: Update | None = None


def find_cause(
    divergence: Divergence, a: Recording, b: Recording, training: tuple[Divergence, Cause] | None = None
) -> Cause:
    """Return why two runs diverge where they do, back to the update that made their tables differ.

    Args:
        divergence: where.
        a: one run.
        b: the other.
        training: where and why their training diverges, if known; it spares finding it again.
    """
    cause = find_kind(divergence, a, b)
    if cause.kind not in _CAUSED_BY_TABLES:
        return cause
    from runner.replay.tables import TableReplay

    steps = divergence.trained or (divergence.step, divergence.step)  # training steps before the choice
    known = training is not None and training[0].step < min(steps)
    try:
        if known or steps[0] != steps[1] or a.agents != b.agents:
            replays = [TableReplay(recording, step) for recording, step in zip((a, b), steps, strict=True)]
            update = training[1].update if training is not None and known else None
        else:
            replays, update = _replay_to(a, b, steps[0])
    except RecordingError as error:
        return replace(cause, text=f"{cause.text}; the tables there cannot be restored ({error})")
    assert divergence.a_step is not None
    return replace(cause, rows=_rows(replays, a, int(divergence.a_step["state"])), update=update)


def find_kind(divergence: Divergence, a: Recording, b: Recording) -> Cause:
    """Return what differs where two runs diverge, judged by the steps alone; no table is replayed."""
    left, right = divergence.a_step, divergence.b_step
    if left is None or right is None:
        longer = "B" if left is None else "A"
        return Cause("end", f"the same as far as the shorter goes; only {longer} continues")
    steps = ((a, left), (b, right))
    for recording, step in steps:
        name = schema.PHASE_NAMES[divergence.phase]
        check_steps(np.array([step]), recording.mdp, str(recording.path), name)
    if divergence.field in ("episode", "t"):
        return Cause("transition", f"an episode ended in one of them: {_outcome_text(divergence)}")
    if divergence.t == 0 and left["state"] != right["state"]:
        states = [states_in_words(recording.mdp)[step["state"]] for recording, step in steps]
        return Cause("start", f"other start state: {states[0]} in A, {states[1]} in B")
    explorers = [_explorers(recording, step) for recording, step in steps]
    alike = explorers[0] == explorers[1]
    if len(explorers[0]) != len(explorers[1]):  # other learners: whether any of them explored
        alike = any(explorers[0]) == any(explorers[1])
    if not alike:
        return Cause("exploration", _exploration_text(left, right, a, b))
    return _action_or_outcome(divergence, left, right, a, b)


def _action_or_outcome(
    divergence: Divergence, left: np.void, right: np.void, a: Recording, b: Recording
) -> Cause:
    """Return what differs where two runs diverge in the same state, and the same learners explored."""
    steps = ((a, left), (b, right))
    actions = [actions_in_words(recording.mdp)[step["action"]] for recording, step in steps]
    if left["action"] == right["action"]:
        outcome = _outcome_text(divergence, a, b)
        return Cause("transition", f"the same action ({actions[0]}) led to something else: {outcome}")
    text = f"{actions[0]} in A, {actions[1]} in B"
    if _differ_by_exploration(left, right, a, b):
        who = "both" if all(_explorers(a, left)) else "the same learners"
        return Cause("random_action", f"{who} explored, and drew another action: {text}")
    if _draws_actions(a, b):
        return Cause("policy_action", f"another action, drawn from a learned policy: {text}")
    return Cause("greedy_action", f"other greedy action: {text}")


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
    shown = ["all learners explored" if text == "explored" else text or "none explored" for text in words]
    return f"other learners explored: {shown[0]} in A, {shown[1]} in B"


def _draws_actions(a: Recording, b: Recording) -> bool:
    """Return whether either run draws the actions that do not explore from a learned policy."""
    return "wolf_phc" in (a.config.get("algorithm"), b.config.get("algorithm"))


def _differ_by_exploration(left: np.void, right: np.void, a: Recording, b: Recording) -> bool:
    """Return whether all learners that chose another action in B explored, in both runs."""
    explorers = _explorers(a, left)
    if len(explorers) != len(_explorers(b, right)) or len(explorers) != len(a.mdp.agents):
        return bool(left["explored"])
    own = [agent_actions(r.mdp, int(s["action"])) for r, s in ((a, left), (b, right))]
    return all(explored for explored, ours, theirs in zip(explorers, *own, strict=True) if ours != theirs)


def _outcome_text(divergence: Divergence, *recordings: Recording) -> str:
    """Return a text of what differs: `reward -10 in A, -7 in B`."""
    values, name = [divergence.a, divergence.b], divergence.field.replace("_", " ")
    if divergence.field in ("state", "next_state") and recordings:
        values = [states_in_words(r.mdp)[v] for r, v in zip(recordings, values, strict=True)]
    elif divergence.field == "rewards":
        name, values = "reward", [_reward_text(value) for value in values]
    return f"{name} {values[0]} in A, {values[1]} in B"


def _reward_text(rewards: list[float]) -> str:
    return " and ".join(f"{reward:g}" for reward in rewards)


def _rows(replays: Sequence[TableReplay], a: Recording, state: int) -> list[Row]:
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


# --- the first update that differs --------------------------------------------------------------------


def _replay_to(a: Recording, b: Recording, stop: int) -> tuple[list[TableReplay], Update | None]:
    """Return both runs' tables at a step up to which they took the same steps, and the first other update.

    Raises:
        RecordingError: the tables cannot be restored.
    """
    from runner.replay.tables import TableReplay

    start = _last_equal_snapshot(a, b, stop)
    replays = [TableReplay(recording, start) for recording in (a, b)]
    update = None
    if _are_equal(replays):
        for step in range(start, stop, _BATCH_STEPS):
            found = _first_other_update(replays, step, min(step + _BATCH_STEPS, stop))
            if found is not None:
                update = _describe_update(a, b, found, replays)
                break
    for replay in replays:
        replay.advance(stop)
    return replays, update


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


def _first_other_update(replays: Sequence[TableReplay], start: int, stop: int) -> int | None:
    """Replay both up to `stop`; return the step whose update made them differ first, by bisection.

    If there is one, both are left before that step.
    """
    before = [_copy(replay) for replay in replays]
    for replay in replays:
        replay.advance(stop)
    if _are_equal(replays):
        return None
    while stop - start > 1:
        middle = (start + stop) // 2
        for replay, contents in zip(replays, before, strict=True):
            replay.rewind(start, contents)
            replay.advance(middle)
        if _are_equal(replays):
            start, before = middle, [_copy(replay) for replay in replays]
        else:
            stop = middle
    for replay, contents in zip(replays, before, strict=True):
        replay.rewind(start, contents)
    return start


def _copy(replay: TableReplay) -> list[Held]:
    """Return a copy of all that the learners hold now."""
    return [{name: array.copy() for name, array in one.items()} for one in replay.held]


def _are_equal(replays: Sequence[TableReplay]) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(replays[0].tables, replays[1].tables, strict=True))


def _describe_update(a: Recording, b: Recording, step: int, replays: Sequence[TableReplay]) -> Update:
    """Return the update of a step that makes the tables differ; both replays are before it."""
    records = [next(recording.blocks(schema.TRAIN_STEP, step, step + 1))[0] for recording in (a, b)]
    for replay in replays:
        replay.advance(step + 1)
    state = int(records[0]["state"])
    ours, theirs = (replay.tables for replay in replays)
    learner, action = next(
        (
            (learner, int(np.argmax(left[state] != right[state])))
            for learner, (left, right) in enumerate(zip(ours, theirs, strict=True))
            if (left[state] != right[state]).any()
        ),
        (0, 0),
    )
    return Update(
        step=step,
        episode=int(records[0]["episode"]),
        state=str(states_in_words(a.mdp)[state]),
        action=own_actions_in_words(a.mdp, learner, ours[learner].shape[1])[action],
        agent=replays[0].agents[learner],
        a=float(ours[learner][state, action]),
        b=float(theirs[learner][state, action]),
        rewards_a=records[0]["rewards"].tolist(),
        rewards_b=records[1]["rewards"].tolist(),
        reasons=_reasons(a, b, records),
    )


def _reasons(a: Recording, b: Recording, records: Sequence[np.void]) -> list[str]:
    """Return descriptions of the inputs of an update that differ."""
    from runner.config import from_mapping
    from runner.learning.schedules import compile_schedule, schedule_value

    configs = [from_mapping(recording.config) for recording in (a, b)]
    episode, step = int(records[0]["episode"]), int(records[0]["step"])
    reasons = []
    rewards = [record["rewards"].tolist() for record in records]
    if rewards[0] != rewards[1]:
        reasons.append(f"the reward was {_reward_text(rewards[0])} in A, {_reward_text(rewards[1])} in B")
    for name in ("step_size", "discount"):
        schedules = [compile_schedule(getattr(config, name)) for config in configs]
        x, y = (float(schedule_value(schedule, episode, step)) for schedule in schedules)
        if x != y:
            reasons.append(f"the {name.replace('_', ' ')} was {x:g} in A, {y:g} in B")
    for name, text in (
        ("second_table_uses_first_action", "updated the second agent's table at the first agent's action"),
        (
            "bootstrap_after_termination",
            "added the value of the next state although the episode had ended",
        ),
    ):
        has = [getattr(config.quirks, name) for config in configs]
        if has[0] != has[1] and (name != "bootstrap_after_termination" or records[0]["terminated"]):
            reasons.append(f"{'A' if has[0] else 'B'} {text} (quirks.{name})")
    return reasons
