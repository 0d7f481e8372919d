"""Where two trajectories part, and how far they are apart from there on.

Steps are compared in blocks: first by position until the first difference, then episode by episode,
aligned by their time in it. Memory does not grow with the runs.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runner.recording import schema
from runner.recording.reader import Recording

Block = NDArray[np.void]

FIELDS = ("episode", "t", "state", "explored", "action", "next_state", "rewards", "terminated", "truncated")
"""What is compared of a step, in the order in which a step comes about."""
_IN_AN_EVALUATION = tuple(name for name in FIELDS if name != "episode")
_EPISODES_AT_ONCE = 512


@dataclass(frozen=True, eq=False)
class Parting:
    """The first step at which two runs differ in a phase."""

    phase: str
    evaluation: int | None
    """Which evaluation, in the order made; None in training."""
    step: int
    """The step's number in its phase, in run A."""
    episode: int
    """Training episode, or trial within the evaluation."""
    t: int
    field: str
    a: Any
    b: Any
    a_step: np.void | None
    """The whole step in A; None if A has none there."""
    b_step: np.void | None


@dataclass(frozen=True)
class Overlap:
    """How far two runs' training is the same."""

    steps_a: int
    steps_b: int
    episodes: int
    """Episodes that both runs have."""
    equal_episodes: int
    """Of these, the ones that are the same step by step."""
    equal_steps: int
    """Steps that agree with the other run's step of the same episode and time."""
    compared_steps: int
    """Steps of the longer of each two episodes."""
    mean_length_a: float
    mean_length_b: float


def first_difference(
    a: Iterator[Block], b: Iterator[Block], fields: tuple[str, ...] = FIELDS
) -> tuple[int, Block | None, Block | None] | None:
    """Return the first position at which two streams of steps differ, and both steps there.

    A stream that ends before the other differs there, with None for its step; None if they are the same.
    """
    position = 0
    left: Block | None = None
    right: Block | None = None
    while True:
        left = left if left is not None and len(left) else next(a, None)
        right = right if right is not None and len(right) else next(b, None)
        if left is None or right is None:
            return None if left is None and right is None else (position, _head(left), _head(right))
        n = min(len(left), len(right))
        differs = rows_that_differ(left[:n], right[:n], fields)
        if differs.any():
            k = int(np.argmax(differs))
            return position + k, left[k : k + 1], right[k : k + 1]
        left, right, position = left[n:], right[n:], position + n


def _head(block: Block | None) -> Block | None:
    return None if block is None else block[:1]


def rows_that_differ(a: Block, b: Block, fields: tuple[str, ...] = FIELDS) -> NDArray[np.bool_]:
    """Return which of two equally long blocks of steps differ in any of the fields."""
    if a.dtype == b.dtype and fields is FIELDS:
        left, right = (np.ascontiguousarray(block).view(np.uint8).reshape(len(block), -1) for block in (a, b))
        if left[:, schema.HEADER_BYTES :].tobytes() == right[:, schema.HEADER_BYTES :].tobytes():
            return np.zeros(len(a), np.bool_)
    differs = np.zeros(len(a), np.bool_)
    for name in fields:
        differs |= _differs(a, b, name)
    return differs


def _differs(a: Block, b: Block, name: str) -> NDArray[np.bool_]:
    """Return where one field differs; rewards of other numbers of learners are compared summed."""
    left, right = a[name], b[name]
    other_learners = a["rewards"].shape != b["rewards"].shape
    if name == "explored" and other_learners:
        left, right = left != 0, right != 0
    if name == "rewards":
        left, right = (left.sum(1), right.sum(1)) if other_learners else (left, right)
    differs: NDArray[np.bool_] = np.not_equal(left, right).reshape(len(a), -1)
    return np.asarray(differs.any(axis=1))


def training_parting(a: Recording, b: Recording) -> Parting | None:
    """Return where the training of two runs parts; None if one goes as far as the other, the same way."""
    found = first_difference(a.blocks(schema.TRAIN_STEP), b.blocks(schema.TRAIN_STEP))
    return None if found is None else _parting("train", None, found, 0)


def evaluation_partings(a: Recording, b: Recording) -> list[Parting]:
    """Return, for each evaluation that both runs made of as many trials, where it parts, if it does."""
    partings = []
    for k, (left, right) in enumerate(zip(_evaluations(a), _evaluations(b), strict=False)):
        trials = min(left[1] - left[0], right[1] - right[0])
        found = first_difference(
            _trial_steps(a, left[0], trials), _trial_steps(b, right[0], trials), _IN_AN_EVALUATION
        )
        if found is not None:
            partings.append(_parting("eval", k, found, left[0]))
    return partings


def _evaluations(recording: Recording) -> list[tuple[int, int]]:
    """Return the first trial of each evaluation and the one behind its last, counted over the run.

    Evaluations of which a cut-off recording does not hold every trial are left out.
    """
    recorded = recording.count(schema.EVAL_EPISODE)
    ends = np.cumsum([metrics["trials"] for metrics in recording.metrics("eval")], dtype=np.int64).tolist()
    return [(first, end) for first, end in zip([0, *ends[:-1]], ends, strict=True) if end <= recorded]


def _trial_steps(recording: Recording, first: int, trials: int) -> Iterator[Block]:
    """Return the steps of some trials."""
    ends = recording.episodes("eval", first, first + trials)
    start = int(ends[0]["last_step"]) + 1 - int(ends[0]["length"])
    return recording.blocks(schema.EVAL_STEP, start, int(ends[-1]["last_step"]) + 1)


def _parting(
    phase: str, evaluation: int | None, found: tuple[int, Block | None, Block | None], first_trial: int
) -> Parting:
    _, left, right = found
    step = left if left is not None else right
    assert step is not None
    name, a, b = "step", "none" if left is None else "one", "none" if right is None else "one"
    if left is not None and right is not None:
        name = next(name for name in FIELDS if _differs(left, right, name)[0])
        a, b = left[name][0].tolist(), right[name][0].tolist()
    return Parting(
        phase,
        evaluation,
        int(step["step"][0]),
        int(step["episode"][0]) - first_trial,
        int(step["t"][0]),
        name,
        a,
        b,
        None if left is None else left[0],
        None if right is None else right[0],
    )


def training_overlap(a: Recording, b: Recording) -> Overlap:
    """Return how far the training of two runs is the same, aligned by episode and time in it."""
    totals = [recording.count(schema.TRAIN_STEP) for recording in (a, b)]
    episodes = min(recording.count(schema.TRAIN_EPISODE) for recording in (a, b))
    equal_episodes = equal_steps = compared = 0
    lengths = np.zeros(2)
    for first in range(0, episodes, _EPISODES_AT_ONCE):
        last = min(first + _EPISODES_AT_ONCE, episodes)
        left, right = (_Episodes(recording, first, last) for recording in (a, b))
        agree = left.agreement(right)
        equal_steps += int(agree.sum())
        compared += int(np.maximum(left.lengths, right.lengths).sum())
        equal_episodes += int(((left.lengths == right.lengths) & (agree == left.lengths)).sum())
        lengths += left.lengths.sum(), right.lengths.sum()
    mean = lengths / max(episodes, 1)
    return Overlap(
        steps_a=totals[0],
        steps_b=totals[1],
        episodes=episodes,
        equal_episodes=equal_episodes,
        equal_steps=equal_steps,
        compared_steps=compared,
        mean_length_a=float(mean[0]),
        mean_length_b=float(mean[1]),
    )


class _Episodes:
    """The steps of some successive training episodes of a run."""

    def __init__(self, recording: Recording, first: int, last: int) -> None:
        records = recording.episodes("train", first, last)
        self.lengths = records["length"].astype(np.int64)
        self.starts = np.cumsum(self.lengths) - self.lengths
        start = int(records[0]["last_step"]) + 1 - int(self.lengths[0])
        blocks = list(recording.blocks(schema.TRAIN_STEP, start, int(records[-1]["last_step"]) + 1))
        self.steps = np.concatenate(blocks)

    def agreement(self, other: _Episodes) -> NDArray[np.int64]:
        """Return, for each episode, how many steps agree with the other's of the same time."""
        common = np.minimum(self.lengths, other.lengths)
        episode = np.repeat(np.arange(len(common)), common)
        t = np.arange(len(episode)) - np.repeat(np.cumsum(common) - common, common)
        left = self.steps[self.starts[episode] + t]
        right = other.steps[other.starts[episode] + t]
        same = ~rows_that_differ(left, right, FIELDS[2:])
        return np.bincount(episode, weights=same, minlength=len(common)).astype(np.int64)


def visits(recording: Recording) -> NDArray[np.int64]:
    """Return how often each state was acted in while training, [S]."""
    counts = np.zeros(recording.mdp.states, np.int64)
    for block in recording.blocks(schema.TRAIN_STEP):
        counts += np.bincount(block["state"], minlength=len(counts))
    return counts
