"""How far the training of two runs is the same after they diverged, and how often each visited a state."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from runner.analysis.diff.divergence import FIELDS, differing_steps, unbroken
from runner.environments.mdp import Mdp
from runner.environments.naming import states_in_words
from runner.errors import RecordingError
from runner.recording.reader import Recording
from runner.util.arrays import Ints, Records

_MAX_STATES: Final = 5
"""States that are named."""
_BATCH_EPISODES: Final = 4096
_BATCH_STEPS: Final = 1 << 15
_ALIGNED: Final = FIELDS[2:]
"""The fields compared of steps of the same time in the same episode."""


@dataclass(frozen=True)
class Overlap:
    """How far two runs' training is the same, aligned by episode and time in it."""

    steps_a: int
    steps_b: int
    episodes: int
    """Episodes that both runs have."""
    equal_episodes: int
    """Episodes that are the same step by step."""
    equal_steps: int
    """Steps that agree with the other run's step of the same episode and time."""
    compared_steps: int
    """Steps of the longer of each two episodes."""
    mean_length_a: float
    mean_length_b: float


@dataclass(frozen=True)
class StateVisits:
    """How often two runs acted in a state, given by its name."""

    state: str
    a: int
    b: int


@dataclass(frozen=True)
class VisitsDiff:
    """How the training steps of two runs spread over the states."""

    states_a: int
    """States that A acted in at all."""
    states_b: int
    alike: float
    """Overlap of the two distributions over states, 0 to 1: the sum of the lower share of each state."""
    most_apart: list[StateVisits]
    """The states whose shares of all steps differ most."""


def training_overlap(a: Recording, b: Recording) -> tuple[Overlap, tuple[Ints, Ints]]:
    """Return how far the training of two runs is the same, and the visits to each state, [S], of either."""
    left, right = _Steps(a), _Steps(b)
    episodes = equal_episodes = equal_steps = compared = 0
    total = np.zeros(2, np.int64)
    for ours, theirs in _common_lengths(a, b):
        agree = _agreement(left, right, ours, theirs)
        episodes += len(ours)
        equal_steps += int(agree.sum())
        compared += int(np.maximum(ours, theirs).sum())
        equal_episodes += int(((ours == theirs) & (agree == ours)).sum())
        total += ours.sum(), theirs.sum()
    mean_a, mean_b = (total / max(episodes, 1)).tolist()
    steps_a, steps_b = (recording.train.steps.count() for recording in (a, b))
    overlap = Overlap(steps_a, steps_b, episodes, equal_episodes, equal_steps, compared, mean_a, mean_b)
    return overlap, (left.count_all_visits(), right.count_all_visits())


def visits_diff(mdp: Mdp, a: Ints, b: Ints) -> VisitsDiff:
    """Return how two runs' visits to states, [S] each, differ."""
    shares = [visits / max(visits.sum(), 1) for visits in (a, b)]
    apart = np.abs(shares[0] - shares[1])
    words = states_in_words(mdp)
    most = [int(state) for state in np.argsort(-apart, kind="stable")[:_MAX_STATES] if apart[state] > 0]
    return VisitsDiff(
        states_a=int(np.count_nonzero(a)),
        states_b=int(np.count_nonzero(b)),
        alike=float(np.minimum(*shares).sum()),
        most_apart=[StateVisits(str(words[state]), int(a[state]), int(b[state])) for state in most],
    )


def _common_lengths(a: Recording, b: Recording) -> Iterator[tuple[Ints, Ints]]:
    """Yield the lengths of successive episodes of both runs, in batches of about `_BATCH_STEPS` steps.

    An episode longer than that comes alone.
    """
    lengths = [unbroken(recording) for recording in (a, b)]
    common = min(count for _, count in lengths)
    for first in range(0, common, _BATCH_EPISODES):
        last = min(first + _BATCH_EPISODES, common)
        records = [recording.train.episodes.array(first, last) for recording in (a, b)]
        whole = min(
            int(np.searchsorted(episodes["last_step"], steps))
            for episodes, (steps, _) in zip(records, lengths, strict=True)
        )
        ours, theirs = (episodes["length"][:whole].astype(np.int64) for episodes in records)
        longer = np.maximum(ours, theirs)
        apart = np.diff(np.cumsum(longer) // _BATCH_STEPS) > 0
        apart |= (longer[:-1] > _BATCH_STEPS) | (longer[1:] > _BATCH_STEPS)
        cuts = np.flatnonzero(apart) + 1
        if whole:
            yield from zip(np.split(ours, cuts), np.split(theirs, cuts), strict=True)
        if whole < last - first:
            return


class _Steps:
    """A run's training steps, taken in order; the visits to each state are counted on the way."""

    def __init__(self, recording: Recording) -> None:
        self._path = recording.path
        self._blocks = recording.train.steps.blocks()
        self._rest: Records = np.empty(0, recording.train.steps.row_dtype)
        self._visits = np.zeros(recording.mdp.states, np.int64)

    def take(self, count: int) -> Records:
        """Return the next steps."""
        parts = [self._rest[:0]]
        while count > 0:
            if not len(self._rest) and not self._read_block():
                raise RecordingError(f"{self._path}: found fewer training steps than its episodes are long.")
            parts.append(self._rest[:count])
            self._rest = self._rest[count:]
            count -= len(parts[-1])
        if len(parts) == 2:
            return parts[1]
        return np.concatenate([_without_fields(part) for part in parts]).view(self._rest.dtype)

    def skip(self, count: int) -> None:
        """Pass over the next steps."""
        for first in range(0, count, _BATCH_STEPS):
            self.take(min(_BATCH_STEPS, count - first))

    def count_all_visits(self) -> Ints:
        """Read to the end, and return how often each state was acted in, [S]."""
        while self._read_block():
            pass
        return self._visits

    def _read_block(self) -> bool:
        block = next(self._blocks, None)
        if block is None:
            return False
        states = len(self._visits)
        if (highest := int(block["state"].max(initial=0))) >= states:
            raise RecordingError(
                f"{self._path}: found state {highest} in training step {block['step'][0]} or soon after, "
                f"expected less than {states}; `dualtaxi verify` names the step."
            )
        self._visits += np.bincount(block["state"], minlength=states)
        self._rest = block
        return True


def _agreement(left: _Steps, right: _Steps, ours: Ints, theirs: Ints) -> Ints:
    """Return, for each of the next episodes, how many steps agree with the other's of the same time."""
    common = np.minimum(ours, theirs)
    if len(ours) == 1:  # it may be longer than a batch
        agree = 0
        for first in range(0, int(common[0]), _BATCH_STEPS):
            n = min(_BATCH_STEPS, int(common[0]) - first)
            agree += n - int(differing_steps(left.take(n), right.take(n), _ALIGNED).sum())
        left.skip(int(ours[0] - common[0]))
        right.skip(int(theirs[0] - common[0]))
        return np.array([agree])
    episode = np.repeat(np.arange(len(common)), common)
    t = np.arange(len(episode)) - np.repeat(np.cumsum(common) - common, common)
    at = [(np.cumsum(lengths) - lengths)[episode] + t for lengths in (ours, theirs)]
    agree_at = _agreeing_pairs(left.take(int(ours.sum())), right.take(int(theirs.sum())), at[0], at[1])
    return np.bincount(episode[agree_at], minlength=len(common))


def _agreeing_pairs(left: Records, right: Records, ours: Ints, theirs: Ints) -> Ints:
    """Return which of the pairs of steps (`ours` in `left`, `theirs` in `right`) agree in all but number."""
    if len(left) == len(right) == len(ours):
        return np.flatnonzero(~differing_steps(left, right, _ALIGNED))
    agree = np.flatnonzero(left["state"][ours] == right["state"][theirs])  # most that differ do so there
    pairs = [
        _without_fields(steps)[at[agree]].view(steps.dtype) for steps, at in ((left, ours), (right, theirs))
    ]
    return agree[~differing_steps(pairs[0], pairs[1], _ALIGNED)]


def _without_fields(steps: Records) -> Records:
    """Return steps as plain bytes: NumPy copies fields one by one, and this ten times as fast."""
    return steps.view(f"V{steps.itemsize}")
