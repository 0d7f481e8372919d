"""The first update by which the tables of two runs came to differ, found by replaying both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from runner.analysis.diff.extent import own_actions_in_words
from runner.config import from_mapping
from runner.environments.naming import rewards_in_words, states_in_words
from runner.learning.learner import NamedTables
from runner.learning.schedules import compile_schedule, schedule_value
from runner.recording.reader import Recording
from runner.replay.tables import TableReplay

_BATCH_STEPS: Final = 1 << 16
_QUIRKS: Final = {
    "second_table_uses_first_action": "updated the second agent's table at the first agent's action",
    "bootstrap_after_termination": "added the value of the next state although the episode had ended",
}
"""Settings that change an update, and what an update with the setting did."""


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
    reasons: list[str]
    """Descriptions of the inputs of the update that differ."""


def replay_to(a: Recording, b: Recording, stop: int) -> tuple[list[TableReplay], Update | None]:
    """Return both runs' tables at a step up to which they took the same steps, and the first other update."""
    start = _last_equal_snapshot(a, b, stop)
    replays = [TableReplay(recording, start) for recording in (a, b)]
    update = None
    if _are_equal(replays):
        for first in range(start, stop, _BATCH_STEPS):
            step = _first_other_update(replays, first, min(first + _BATCH_STEPS, stop))
            if step is not None:
                update = _describe_update(a, b, step, replays)
                break
    for replay in replays:
        replay.advance(stop)
    return replays, update


def _last_equal_snapshot(a: Recording, b: Recording, stop: int) -> int:
    """Return the last step before `stop` at which both runs have snapshots, all of them equal; or 0."""
    last, step, equal = 0, 0, True
    for left, right in zip(a.snapshots(), b.snapshots(), strict=False):
        if left.step != right.step or left.step > stop:
            break
        if left.step != step:  # only now it is known that all tables of the last moment are there
            last = step if equal else last
            step = left.step
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
            start = middle
            before = [_copy(replay) for replay in replays]
        else:
            stop = middle
    for replay, contents in zip(replays, before, strict=True):
        replay.rewind(start, contents)
    return start


def _copy(replay: TableReplay) -> list[NamedTables]:
    """Return a copy of all that the learners hold now."""
    return [{name: array.copy() for name, array in tables.items()} for tables in replay.named_tables]


def _are_equal(replays: Sequence[TableReplay]) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(replays[0].tables, replays[1].tables, strict=True))


def _describe_update(a: Recording, b: Recording, step: int, replays: Sequence[TableReplay]) -> Update:
    """Return the update of a step that makes the tables differ; both replays are before it."""
    records = [next(recording.train.steps.blocks(step, step + 1))[0] for recording in (a, b)]
    for replay in replays:
        replay.advance(step + 1)
    ours, theirs = (replay.tables for replay in replays)
    gaps = [np.abs(left - right) for left, right in zip(ours, theirs, strict=True)]
    learner = next(learner for learner, gap in enumerate(gaps) if gap.any())
    state, action = map(int, np.unravel_index(gaps[learner].argmax(), gaps[learner].shape))
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
    episode, step = int(records[0]["episode"]), int(records[0]["step"])
    configs = [from_mapping(recording.config).from_step(step) for recording in (a, b)]
    reasons = []
    rewards = [record["rewards"].tolist() for record in records]
    if rewards[0] != rewards[1]:
        in_a, in_b = map(rewards_in_words, rewards)
        reasons.append(f"the reward was {in_a} in A, {in_b} in B")
    for name in ("step_size", "discount"):
        schedules = [compile_schedule(getattr(config, name)) for config in configs]
        x, y = (float(schedule_value(schedule, episode, step)) for schedule in schedules)
        if x != y:
            reasons.append(f"the {name.replace('_', ' ')} was {x:g} in A, {y:g} in B")
    for name, text in _QUIRKS.items():
        in_a, in_b = (getattr(config.quirks, name) for config in configs)
        if in_a != in_b and (name != "bootstrap_after_termination" or records[0]["terminated"]):
            reasons.append(f"{'A' if in_a else 'B'} {text} (quirks.{name})")
    return reasons
