"""Why two runs diverge at a step, as far as their recordings show it.

At the step where they diverge either the start state differs, or which learners explored, or which random
action one of them took, or which action was greedy, or what the same action led to. A greedy action differs
because the tables do: then the cause is the first update that made them differ, found by replaying both runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from runner.analysis.diff.divergence import Divergence
from runner.analysis.diff.extent import own_actions_in_words
from runner.environments.naming import (
    actions_in_words,
    agent_actions,
    exploration_in_words,
    rewards_in_words,
    states_in_words,
)
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.reader import Recording
from runner.runs.branches import training_branches

if TYPE_CHECKING:
    from runner.analysis.diff.updates import Update
    from runner.replay.tables import TableReplay

DRAWING: Final = ("wolf_phc",)
"""The algorithms that draw their actions: those of `learning.algorithms`, whose import would take most of the
time of `diff --first`. A test compares both."""
_CAUSED_BY_TABLES: Final = ("greedy_action", "policy_action")


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
    """start, exploration, random_action, greedy_action, policy_action, transition, end, or branch."""
    text: str
    rows: list[Row] = field(default_factory=list)
    """The Q-values of each agent in the state in which the greedy actions differ."""
    update: Update | None = None


class BranchRelation(NamedTuple):
    """How two jobs are related by branches."""

    step: int
    """The first training step at which either was changed and the other was not."""
    sets_actions: bool
    """Whether an action was set at this step."""
    text: str


def branch_relation(a: Recording, b: Recording) -> BranchRelation | None:
    """Return how two jobs are related, if one is a branch of the other, or both of a third one."""
    ours, theirs = training_branches(a.config), training_branches(b.config)
    while ours and theirs and ours[0] == theirs[0]:
        ours, theirs = ours[1:], theirs[1:]
    lines = [", then ".join(map(str, line)) for line in (ours, theirs)]
    if ours and theirs and ours[0].run == theirs[0].run:
        text = f"Both are branches of run {ours[0].run}: A {lines[0]}, B {lines[1]}"
    elif theirs and not ours and theirs[0].run == a.run_id:
        text = f"B is a branch of A, {lines[1]}"
    elif ours and not theirs and ours[0].run == b.run_id:
        text = f"A is a branch of B, {lines[0]}"
    else:
        return None
    step = min(origin.step for origin in (*ours, *theirs))
    return BranchRelation(
        step, any(origin.actions for origin in (*ours, *theirs) if origin.step == step), text
    )


def with_branch(cause: Cause, divergence: Divergence, relation: BranchRelation | None) -> Cause:
    """Return the cause of a divergence of training with the branch that explains it, if one does."""
    if relation is None or divergence.step < relation.step:
        return cause  # something else differs before
    text = f"{relation.text}; training is the same for {divergence.step:,} steps"
    if divergence.step > relation.step or not relation.sets_actions:
        text = f"{text}, then {cause.text}"
    return replace(cause, kind="branch", text=text)


class _Side(NamedTuple):
    """One of the runs, and the step at which it diverges from the other."""

    recording: Recording
    step: np.void

    @property
    def state(self) -> str:
        return str(states_in_words(self.recording.mdp)[self.step["state"]])

    @property
    def action(self) -> str:
        return str(actions_in_words(self.recording.mdp)[self.step["action"]])

    @property
    def explorers(self) -> list[bool]:
        """Whether each learner explored."""
        return [bool(int(self.step["explored"]) >> i & 1) for i in range(len(self.recording.agents))]


def find_cause(
    divergence: Divergence, a: Recording, b: Recording, training: tuple[Divergence, Cause] | None = None
) -> Cause:
    """Return why two runs diverge where they do, back to the update that made their tables differ.

    `training` is where and why their training diverges, if known; it spares finding it again.
    """
    cause = find_kind(divergence, a, b)
    if cause.kind not in _CAUSED_BY_TABLES:
        return cause
    from runner.analysis.diff.updates import replay_to  # needs Numba, which takes as long as all else here
    from runner.replay.tables import TableReplay

    steps = divergence.trained or (divergence.step, divergence.step)  # training steps before the choice
    is_after_training = training is not None and training[0].step < min(steps)
    try:
        if is_after_training or steps[0] != steps[1] or a.agents != b.agents:
            replays = [TableReplay(recording, step) for recording, step in zip((a, b), steps, strict=True)]
            update = training[1].update if training is not None and is_after_training else None
        else:
            replays, update = replay_to(a, b, steps[0])
    except RecordingError as error:
        return replace(cause, text=f"{cause.text}; the tables there cannot be restored ({error})")
    assert divergence.a_step is not None
    return replace(cause, rows=_rows(replays, a, int(divergence.a_step["state"])), update=update)


def find_kind(divergence: Divergence, a: Recording, b: Recording) -> Cause:
    """Return what differs where two runs diverge, judged by the steps alone; no table is replayed."""
    if divergence.a_step is None or divergence.b_step is None:
        longer = "B" if divergence.a_step is None else "A"
        return Cause("end", f"the same as far as the shorter goes; only {longer} continues")
    left, right = _Side(a, divergence.a_step), _Side(b, divergence.b_step)
    for recording, step in (left, right):
        name = schema.PHASE_NAMES[divergence.phase]
        recording.mdp.check_steps(np.array([step]), str(recording.path), name)
    if divergence.field in ("episode", "t"):
        return Cause("transition", f"an episode ended in one of them: {_outcome_text(divergence, a, b)}")
    if divergence.t == 0 and left.step["state"] != right.step["state"]:
        return Cause("start", f"other start state: {left.state} in A, {right.state} in B")
    explorers: list[object] = [left.explorers, right.explorers]
    if len(a.agents) != len(b.agents):
        explorers = [any(left.explorers), any(right.explorers)]
    if explorers[0] != explorers[1]:
        return Cause("exploration", _exploration_text(left, right))
    return _action_or_outcome(divergence, left, right)


def _action_or_outcome(divergence: Divergence, left: _Side, right: _Side) -> Cause:
    """Return what differs where two runs diverge in the same state, and the same learners explored."""
    a, b = left.recording, right.recording
    if left.step["action"] == right.step["action"]:
        outcome = _outcome_text(divergence, a, b)
        return Cause("transition", f"the same action ({left.action}) led to something else: {outcome}")
    text = f"{left.action} in A, {right.action} in B"
    if _differ_by_exploration(left, right):
        who = "both" if all(left.explorers) else "the same learners"
        return Cause("random_action", f"{who} explored, and drew another action: {text}")
    if _draws_actions(a, b):
        return Cause("policy_action", f"another action, drawn from a learned policy: {text}")
    return Cause("greedy_action", f"other greedy action: {text}")


def _exploration_text(left: _Side, right: _Side) -> str:
    """Return who explored in either run: `A explored there, B took its greedy action`."""
    words = [exploration_in_words(int(step["explored"]), run.agents) for run, step in (left, right)]
    if len(left.recording.agents) == len(right.recording.agents) == 1:
        explorer, other = ("A", "B") if words[0] else ("B", "A")
        draws = _draws_actions(left.recording, right.recording)
        acted = "an action of its learned policy" if draws else "its greedy action"
        return f"{explorer} explored there, {other} took {acted}"
    in_a, in_b = (
        "all learners explored" if text == "explored" else text or "none explored" for text in words
    )
    return f"other learners explored: {in_a} in A, {in_b} in B"


def _draws_actions(a: Recording, b: Recording) -> bool:
    """Return whether either run draws the actions that do not explore from a learned policy."""
    return any(run.config.get("algorithm") in DRAWING for run in (a, b))


def _differ_by_exploration(left: _Side, right: _Side) -> bool:
    """Return whether all learners that chose another action in B explored, in both runs."""
    explorers = left.explorers
    if len(explorers) != len(right.explorers) or len(explorers) != len(left.recording.mdp.agents):
        return bool(left.step["explored"])
    actions = [agent_actions(run.mdp, int(step["action"])) for run, step in (left, right)]
    return all(explored for explored, ours, theirs in zip(explorers, *actions, strict=True) if ours != theirs)


def _outcome_text(divergence: Divergence, a: Recording, b: Recording) -> str:
    """Return a text of what differs: `reward -10 in A, -7 in B`."""
    name = divergence.field.replace("_", " ")
    values: list[Any] = [divergence.a, divergence.b]
    if divergence.field in ("state", "next_state"):
        values = [states_in_words(run.mdp)[state] for run, state in zip((a, b), values, strict=True)]
    elif divergence.field == "rewards":
        name = "reward"
        values = list(map(rewards_in_words, values))
    return f"{name} {values[0]} in A, {values[1]} in B"


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
