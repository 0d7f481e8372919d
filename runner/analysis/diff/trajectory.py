"""Where two trajectories part, and how far they are apart from there on.

Steps are compared in blocks: first by position until the first difference, then episode by episode,
aligned by their time in it. Memory does not grow with the runs.

Where a repair lost steps, training is compared up to the first of them, and evaluations that lost trials
are left out.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runner.analysis.evaluations import Evaluation, evaluations_of
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.blocks import HEADER_BYTES
from runner.recording.reader import Recording

Block = NDArray[np.void]

FIELDS = ("episode", "t", "state", "explored", "action", "next_state", "rewards", "terminated", "truncated")
"""What is compared of a step, in the order in which a step comes about."""
_IN_AN_EVALUATION = tuple(name for name in FIELDS if name != "episode")
_EPISODES_AT_ONCE = 4096
_STEPS_AT_ONCE = 1 << 15


@dataclass(frozen=True, eq=False)
class Parting:
    """The first step at which two runs differ in a phase."""

    phase: str
    evaluation: int | None
    """Which evaluation of run A, counted from 0; None in training."""
    after: int | None
    """Training episodes before that evaluation; None in training."""
    step: int
    """The step's number in its phase, in run A."""
    episode: int
    """Training episode, or trial within the evaluation."""
    t: int
    field: str
    """Of the step; or `reset.observation`, of the reset before it."""
    a: Any
    b: Any
    a_step: np.void | None
    """The whole step in A; None if A has none there."""
    b_step: np.void | None
    trained: tuple[int, int] | None = None
    """Training steps before that evaluation, in A and in B; None in training."""


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
    if a.dtype == b.dtype:
        left, right = (
            np.ascontiguousarray(block).view(np.uint8).reshape(-1, block.itemsize) for block in (a, b)
        )
        if left[:, HEADER_BYTES:].tobytes() == right[:, HEADER_BYTES:].tobytes():
            return np.zeros(len(a), np.bool_)
    differs = np.zeros(len(a), np.bool_)
    for name in fields:
        differs |= _differs(a, b, name)
    return differs


def _differs(a: Block, b: Block, name: str) -> NDArray[np.bool_]:
    """Return where one field differs; rewards of other numbers of learners are compared summed."""
    left, right = a[name], b[name]
    if name in ("explored", "rewards") and a["rewards"].shape != b["rewards"].shape:
        left, right = (left != 0, right != 0) if name == "explored" else (left.sum(1), right.sum(1))
    differs: NDArray[np.bool_] = np.not_equal(left, right).reshape(len(a), -1)
    return np.asarray(differs.any(axis=1))


def training_parting(a: Recording, b: Recording) -> Parting | None:
    """Return where the training of two runs parts; None if one goes as far as the other, the same way."""
    streams = [recording.blocks(schema.TRAIN_STEP, 0, unbroken(recording)[0]) for recording in (a, b)]
    found = first_difference(streams[0], streams[1])
    return None if found is None else _parting("train", found)


def evaluation_partings(a: Recording, b: Recording) -> Iterator[Parting]:
    """Yield, for each evaluation that both runs made after as much training, where it parts, if it does."""
    others = {one.after: one for one in evaluations_of(b)}
    for left in evaluations_of(a):
        right = others.get(left.after)
        if right is None:
            continue
        trials = min(left.stop - left.start, right.stop - right.start)
        steps = [_trial_steps(one, first, trials) for one, first in ((a, left.start), (b, right.start))]
        if steps[0] is None or steps[1] is None:
            continue
        found = first_difference(steps[0], steps[1], _IN_AN_EVALUATION)
        if found is not None:
            yield _parting("eval", found, (left, right))


def unbroken(recording: Recording) -> tuple[int, int]:
    """Return how many steps and episodes of training are there before the first that were lost, if any."""
    steps, episodes = schema.PHASES["train"]
    ends = [
        min([recording.count(topic), *(start for start, _ in recording.lost.get(topic.name, []))])
        for topic in (steps, episodes)
    ]
    return ends[0], ends[1]


def _trial_steps(recording: Recording, first: int, trials: int) -> Iterator[Block] | None:
    """Return the steps of some trials; None unless all of them are there."""
    ends = recording.episodes("eval", first, first + trials)
    if not trials or len(ends) < trials:
        return None
    start, stop = int(ends[0]["last_step"]) + 1 - int(ends[0]["length"]), int(ends[-1]["last_step"]) + 1
    lost = recording.lost.get(schema.EVAL_STEP.name, [])
    if stop > recording.count(schema.EVAL_STEP) or any(a < stop and b > start for a, b in lost):
        return None
    return recording.blocks(schema.EVAL_STEP, start, stop)


def _parting(
    phase: str,
    found: tuple[int, Block | None, Block | None],
    evaluations: tuple[Evaluation, Evaluation] | None = None,
) -> Parting:
    _, left, right = found
    step = left if left is not None else right
    assert step is not None
    name, a, b = "step", "none" if left is None else "one", "none" if right is None else "one"
    if left is not None and right is not None:
        name = next(name for name in FIELDS if _differs(left, right, name)[0])
        a, b = left[name][0].tolist(), right[name][0].tolist()
    parting = Parting(
        phase,
        None,
        None,
        int(step["step"][0]),
        int(step["episode"][0]),
        int(step["t"][0]),
        name,
        a,
        b,
        None if left is None else left[0],
        None if right is None else right[0],
    )
    if evaluations is None:
        return parting
    own = evaluations[0] if left is not None else evaluations[1]
    return dataclasses.replace(
        parting,
        evaluation=evaluations[0].number,
        after=own.after,
        episode=parting.episode - own.start,
        trained=(evaluations[0].train_step, evaluations[1].train_step),
    )


def training_overlap(
    a: Recording, b: Recording
) -> tuple[Overlap, tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Return how far the training of two runs is the same, aligned by episode and time in it.

    Returns:
        the overlap; and how often each state was acted in, [S], in either run.

    Raises:
        RecordingError: steps and episodes of a recording contradict each other.
    """
    left, right = _Steps(a), _Steps(b)
    episodes = equal_episodes = equal_steps = compared = 0
    lengths = np.zeros(2, np.int64)
    for ours, theirs in _lengths_of_both(a, b):
        agree = _agreement(left, right, ours, theirs)
        episodes += len(ours)
        equal_steps += int(agree.sum())
        compared += int(np.maximum(ours, theirs).sum())
        equal_episodes += int(((ours == theirs) & (agree == ours)).sum())
        lengths += ours.sum(), theirs.sum()
    mean = lengths / max(episodes, 1)
    overlap = Overlap(
        steps_a=a.count(schema.TRAIN_STEP),
        steps_b=b.count(schema.TRAIN_STEP),
        episodes=episodes,
        equal_episodes=equal_episodes,
        equal_steps=equal_steps,
        compared_steps=compared,
        mean_length_a=float(mean[0]),
        mean_length_b=float(mean[1]),
    )
    return overlap, (left.all_visits(), right.all_visits())


def _lengths_of_both(a: Recording, b: Recording) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Yield the lengths of the same successive episodes in both runs, of some 100,000 steps together.

    An episode longer than that comes alone.
    """
    known = [unbroken(recording) for recording in (a, b)]
    episodes = min(count for _, count in known)
    for first in range(0, episodes, _EPISODES_AT_ONCE):
        last = min(first + _EPISODES_AT_ONCE, episodes)
        records = [recording.episodes("train", first, last) for recording in (a, b)]
        whole = min(
            int(np.searchsorted(one["last_step"], steps))
            for one, (steps, _) in zip(records, known, strict=True)
        )
        ours, theirs = (one["length"][:whole].astype(np.int64) for one in records)
        longer = np.maximum(ours, theirs)
        apart = np.diff(np.cumsum(longer) // _STEPS_AT_ONCE) > 0
        apart |= (longer[:-1] > _STEPS_AT_ONCE) | (longer[1:] > _STEPS_AT_ONCE)
        cuts = np.flatnonzero(apart) + 1
        if whole:
            yield from zip(np.split(ours, cuts), np.split(theirs, cuts), strict=True)
        if whole < last - first:
            return


class _Steps:
    """A run's training steps, taken in order; the visits to each state are counted on the way."""

    def __init__(self, recording: Recording) -> None:
        self._path = recording.path
        self._blocks = recording.blocks(schema.TRAIN_STEP)
        self._rest: Block = np.empty(0, recording.dtypes[schema.TRAIN_STEP])
        self._visits = np.zeros(recording.mdp.states, np.int64)

    def take(self, count: int) -> Block:
        """Return the next steps."""
        parts = [self._rest[:0]]
        while count > 0:
            if not len(self._rest) and not self._next():
                raise RecordingError(f"{self._path}: found fewer training steps than its episodes are long.")
            parts.append(self._rest[:count])
            self._rest = self._rest[count:]
            count -= len(parts[-1])
        if len(parts) == 2:
            return parts[1]
        whole = np.concatenate([_opaque(part) for part in parts])
        return whole.view(self._rest.dtype)

    def skip(self, count: int) -> None:
        """Go on behind the next steps."""
        for first in range(0, count, _STEPS_AT_ONCE):
            self.take(min(_STEPS_AT_ONCE, count - first))

    def all_visits(self) -> NDArray[np.int64]:
        """Read what is left, and return how often each state was acted in, [S]."""
        while self._next():
            pass
        return self._visits

    def _next(self) -> bool:
        """Go to the next block, if there is one."""
        block = next(self._blocks, None)
        if block is None:
            return False
        states = len(self._visits)
        if (found := int(block["state"].max(initial=0))) >= states:
            raise RecordingError(
                f"{self._path}: found state {found} in training step {block['step'][0]} or soon after, "
                f"expected less than {states}; `dualtaxi verify` names the step."
            )
        self._visits += np.bincount(block["state"], minlength=states)
        self._rest = block
        return True


def _agreement(
    left: _Steps, right: _Steps, ours: NDArray[np.int64], theirs: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return, for each of the next episodes, how many steps agree with the other's of the same time.

    Args:
        left: the steps of one run, at the first of these episodes.
        right: those of the other.
        ours: the lengths of the episodes in the one.
        theirs: in the other.
    """
    if len(ours) == 1:
        return _agreement_of_one(left, right, int(ours[0]), int(theirs[0]))
    common = np.minimum(ours, theirs)
    episode = np.repeat(np.arange(len(common)), common)
    t = np.arange(len(episode)) - np.repeat(np.cumsum(common) - common, common)
    at = [(np.cumsum(lengths) - lengths)[episode] + t for lengths in (ours, theirs)]
    agree = _that_agree(left.take(int(ours.sum())), right.take(int(theirs.sum())), at[0], at[1])
    return np.bincount(episode[agree], minlength=len(common))


def _that_agree(
    left: Block, right: Block, ours: NDArray[np.int64], theirs: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return which of the pairs of steps (`ours` in `left`, `theirs` in `right`) agree in all but number."""
    if len(left) == len(right) == len(ours):
        return np.flatnonzero(~rows_that_differ(left, right, FIELDS[2:]))
    agree = np.flatnonzero(left["state"][ours] == right["state"][theirs])  # most that differ do so there
    chosen = [_opaque(steps)[at[agree]].view(steps.dtype) for steps, at in ((left, ours), (right, theirs))]
    return agree[~rows_that_differ(chosen[0], chosen[1], FIELDS[2:])]


def _opaque(steps: Block) -> NDArray[np.void]:
    """Return steps without their fields: NumPy copies those one by one, and this ten times as fast."""
    return steps.view(f"V{steps.itemsize}")


def _agreement_of_one(left: _Steps, right: _Steps, ours: int, theirs: int) -> NDArray[np.int64]:
    common, agree = min(ours, theirs), 0
    for first in range(0, common, _STEPS_AT_ONCE):
        n = min(_STEPS_AT_ONCE, common - first)
        agree += n - int(rows_that_differ(left.take(n), right.take(n), FIELDS[2:]).sum())
    left.skip(ours - common)
    right.skip(theirs - common)
    return np.array([agree])
