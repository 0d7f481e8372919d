"""The first step at which two runs diverge, in training and in evaluation.

Steps are compared in blocks, so memory does not grow with the runs. Where a repair lost steps, training is
compared up to the first of them, and evaluations that lost trials are left out.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from runner.analysis.episodes import EpisodeRef
from runner.analysis.evaluations import evaluations_of
from runner.errors import shortened
from runner.recording import schema
from runner.recording.layout import HEADER_BYTES
from runner.recording.reader import Recording
from runner.recording.spaces import Value, decode
from runner.replay.recorded import ended_episode
from runner.replay.steps import episode_blocks
from runner.runs.branches import BranchOrigin
from runner.util.arrays import Flags, Records
from runner.util.differences import differing_rows

_NOT_COMPARED: Final = ("step", "environment")
_CHOICE: Final = ("explored", "acted")
"""The fields that tell how an action came about: a difference there comes before that of the action."""
_OTHERS: Final = [name for name in schema.STEP_COLUMNS if name not in _NOT_COMPARED + _CHOICE]
_AT_ACTION: Final = _OTHERS.index("action")
_COMPARED: Final = (*_OTHERS[:_AT_ACTION], *_CHOICE, *_OTHERS[_AT_ACTION:])
"""The fields of steps of any kind that are compared, in the order in which a step comes about."""
FIELDS: Final = tuple(name for name in _COMPARED if name in [field.name for field in schema.STEP.fields])
"""The fields that are compared of steps of jobs."""
_EVALUATION_FIELDS: Final = FIELDS[1:]  # trials are numbered over all evaluations of a run
_MAX_LETTERS: Final = 300
"""The longest text of a value of varying size."""
_MAX_NUMBERS: Final = 16
"""Where a value has more numbers, the first that differs is reported."""


@dataclass(frozen=True, eq=False)
class Divergence:
    """The first step at which two runs differ in a phase."""

    phase: str
    step: int
    """The step's number in its phase, in run A."""
    episode: int
    """Training episode, or trial within the evaluation."""
    t: int
    field: str
    """Field of the step; `step` where one run ends first; `reset.observation` of the reset before it;
    `digest` where only actions are recorded: observations or rewards of the episode differ by then."""
    a: Value
    b: Value
    a_step: np.void | None = None
    """The whole step in A; None if A has none there."""
    b_step: np.void | None = None
    evaluation: int | None = None
    """Number of the evaluation of run A, from 0; None in training."""
    after: int | None = None
    """Training episodes before that evaluation; None in training."""
    trained: tuple[int, int] | None = None
    """Training steps before that evaluation, in A and in B; None in training and of loops."""
    actions_alone: bool = False
    """Whether actions and ends of episodes were compared, since of a run nothing else is recorded."""

    @property
    def reference(self) -> EpisodeRef:
        """The step."""
        return EpisodeRef(self.episode, self.t, self.after)

    @property
    def frame(self) -> EpisodeRef:
        """The first frame of a replay that differs: the one after the step, unless it began differently."""
        began = self.field == "state" or self.field.startswith("reset.")
        return self.reference if began else self.reference.outcome


def first_difference(
    a: Iterator[Records], b: Iterator[Records], fields: tuple[str, ...] = FIELDS
) -> tuple[Records | None, Records | None]:
    """Return the first records, a block of one each, in which two streams of records differ.

    A stream that ends before the other has None in place of its record; None twice if both are the same.
    """
    left: Records | None = None
    right: Records | None = None
    while True:
        left = left if left is not None and len(left) else next(a, None)
        right = right if right is not None and len(right) else next(b, None)
        if left is None or right is None:
            return None if left is None else left[:1], None if right is None else right[:1]
        n = min(len(left), len(right))
        differs = differing_steps(left[:n], right[:n], fields)
        if differs.any():
            k = int(np.argmax(differs))
            return left[k : k + 1], right[k : k + 1]
        left, right = left[n:], right[n:]


def differing_steps(a: Records, b: Records, fields: tuple[str, ...]) -> Flags:
    """Return which of two equally long blocks of records differ in any of the fields."""
    if a.dtype == b.dtype and not a.dtype.hasobject and "digest" not in (a.dtype.names or ()):
        left, right = (
            np.ascontiguousarray(block).view(np.uint8).reshape(-1, block.itemsize) for block in (a, b)
        )
        if left[:, HEADER_BYTES:].tobytes() == right[:, HEADER_BYTES:].tobytes():
            return np.zeros(len(a), np.bool_)
    differs = np.zeros(len(a), np.bool_)
    for name in fields:
        differs |= _differs(a, b, name)
    return differs


def _differs(a: Records, b: Records, name: str) -> Flags:
    """Return where one field differs; rewards of other numbers of learners are compared summed."""
    left, right = a[name], b[name]
    if name in ("explored", "rewards") and a["rewards"].shape != b["rewards"].shape:
        left, right = (left != 0, right != 0) if name == "explored" else (left.sum(1), right.sum(1))
    differs = differing_rows(left, right)
    if name == "digest":  # recorded at some steps only
        for values in (left, right):
            differs &= differing_rows(values, np.zeros_like(values))
    return differs


def training_divergence(a: Recording, b: Recording) -> Divergence | None:
    """Return where the training of two jobs diverges; None if it takes the same steps, equally many."""
    streams = [recording.train.steps.blocks(0, unbroken(recording)[0]) for recording in (a, b)]
    return _divergence("train", streams[0], streams[1])


def evaluation_divergences(a: Recording, b: Recording) -> Iterator[Divergence]:
    """Yield where evaluations diverge that both jobs made after as many training episodes."""
    others = {evaluation.after: evaluation for evaluation in evaluations_of(b)}
    for left in evaluations_of(a):
        right = others.get(left.after)
        if right is None:
            continue
        trials = min(left.trials, right.trials)
        ours, theirs = _trial_steps(a, left.start, trials), _trial_steps(b, right.start, trials)
        if ours is None or theirs is None:
            continue
        if (divergence := _divergence("eval", ours, theirs, _EVALUATION_FIELDS)) is not None:
            start = right.start if divergence.a_step is None else left.start
            yield replace(
                divergence,
                episode=divergence.episode - start,
                evaluation=left.number,
                after=left.after,
                trained=(left.train_step, right.train_step),
            )


def unbroken(recording: Recording) -> tuple[int, int]:
    """Return how many steps and episodes of training precede the first that were lost, if any."""
    counts = []
    for table in (recording.train.steps, recording.train.episodes):
        lost = [start for start, _ in table.lost]
        counts.append(min([table.count() if table else 0, *lost]))
    steps, episodes = counts
    return steps, episodes


def _trial_steps(recording: Recording, first: int, trials: int) -> Iterator[Records] | None:
    """Return the steps of some trials; None unless all of them are there."""
    ends = recording.eval.episodes.array(first, first + trials)
    if not trials or len(ends) < trials:
        return None
    start, stop = int(ends[0]["first_step"]), int(ends[-1]["last_step"]) + 1
    lost = recording.lost.get(schema.EVAL_STEP.name, [])
    if stop > recording.eval.steps.count() or any(a < stop and b > start for a, b in lost):
        return None
    return recording.eval.steps.blocks(start, stop)


def _divergence(
    phase: str, a_steps: Iterator[Records], b_steps: Iterator[Records], fields: tuple[str, ...] = FIELDS
) -> Divergence | None:
    """Return where two streams of steps differ."""
    left, right = first_difference(a_steps, b_steps, fields)
    ours, theirs = (None if block is None else block[0] for block in (left, right))
    step = theirs if ours is None else ours
    if step is None:
        return None
    name = "step"
    a = "none" if ours is None else "one more"
    b = "none" if theirs is None else "one more"
    if left is not None and right is not None:
        name = next(name for name in fields if _differs(left, right, name)[0])
        name, a, b = _differing_part(name, left[name][0], right[name][0])
    return Divergence(
        phase, int(step["step"]), int(step["episode"]), int(step["t"]), name, a, b, ours, theirs
    )


def _differing_part(name: str, a: Value, b: Value) -> tuple[str, Value, Value]:
    """Return the first part of a value that differs: of a Dict its entry, of many numbers one of them."""
    if isinstance(a, bytes):
        return name, a, b
    for entry in a.dtype.names or ():
        if a[entry].tobytes() != b[entry].tobytes():
            return _differing_part(f"{name}.{entry}", a[entry], b[entry])
    if a.size <= _MAX_NUMBERS:
        return name, a.tolist(), b.tolist()
    differs = differing_rows(a.reshape(-1), b.reshape(-1))
    index = np.unravel_index(int(differs.argmax()), a.shape)
    return f"{name}[{', '.join(map(str, index))}]", a[index].tolist(), b[index].tolist()


# --- loops --------------------------------------------------------------------------------------------


def have_same_spaces(a: Recording, b: Recording) -> bool:
    """Return whether the steps of two recordings, of which one is of a loop, are in the same spaces."""
    return a.spaces == b.spaces and a.agents == b.agents


def loop_divergence(a: Recording, b: Recording, phase: str) -> Divergence | None:
    """Return the first step of a phase at which two recordings in the same spaces diverge.

    Where a recording has the actions of its steps alone, these are compared, and the digests of episodes if
    both have them; None if a recording left its steps out. If they diverge in what a reset observed, it is
    the step after it, and the field is `reset.observation`.
    """
    if any(recording.leaves_out_steps and not recording.has_actions for recording in (a, b)):
        return None
    divergence = _first_in_phase(a, b, phase)
    if divergence is None or phase == "train":
        return divergence
    number = divergence.episode
    evaluations = evaluations_of(a)
    for evaluation in (*evaluations, *evaluations_of(b)):
        if evaluation.start <= number < evaluation.stop:
            return replace(
                divergence,
                episode=number - evaluation.start,
                evaluation=evaluation.number,
                after=evaluation.after,
            )
    # Neither run finished the trial, so it follows all training.
    after = a.train.episodes.count()
    starts = (evaluation.start for evaluation in evaluations if evaluation.after == after)
    return replace(divergence, episode=number - next(starts, a.eval.episodes.count()), after=after)


def _compared(a: Recording, b: Recording, phase: str) -> tuple[str, ...]:
    """Return the fields in which steps are compared: those that both recordings have.

    Whether an action was explored is unknown of a loop, and 0 in its steps.
    """
    ours, theirs = (recording.phase(phase).steps.row_dtype.names or () for recording in (a, b))
    return tuple(name for name in _COMPARED if name in ours and name in theirs and name != "explored")


def _first_in_phase(a: Recording, b: Recording, phase: str) -> Divergence | None:
    """Return where a phase diverges, see `loop_divergence`; a trial is counted over all evaluations."""
    ours, theirs = (recording.phase(phase).steps for recording in (a, b))
    alone = [steps.are_actions for steps in (ours, theirs)]
    fields = (*_compared(a, b, phase), *(("digest",) if all(alone) else ()))
    divergence = _divergence(phase, ours.rows(), theirs.rows(), fields)
    if not a.has_states:  # where it has, a step has the state before it
        last = math.inf if divergence is None else divergence.step
        divergence = _reset_divergence(a, b, phase, last) or divergence
    if divergence is None:
        return None
    if isinstance(divergence.a, bytes):
        divergence = replace(
            divergence,
            a=_legible(a, divergence.field, divergence.a),
            b=_legible(b, divergence.field, divergence.b),
        )
    if any(alone) or ours.dtype is None:
        divergence = replace(divergence, a_step=None, b_step=None, actions_alone=any(alone))
    if ours.have_turns:  # a row counts the episodes of its environment, and the phase those of all
        for recording, steps in ((a, ours), (b, theirs)):
            if divergence.step < steps.total():
                row = steps.one(divergence.step)
                ended = ended_episode(recording, phase, int(row["environment"]), divergence.step)
                if ended is not None:
                    return replace(divergence, episode=ended)
    return divergence


def _legible(recording: Recording, field: str, value: bytes) -> str:
    """Return a digest, or a value of varying size, as text."""
    if field == "digest":
        return value.hex()
    space = "action" if field == "action" else "observation"
    return shortened(str(decode(recording.spaces[space], value, str(recording.path))), _MAX_LETTERS)


def branch_divergence(a: Recording, b: Recording, origin: BranchOrigin) -> Divergence | None:
    """Return where a branched episode of a loop and its branch diverge, as the parent numbers it.

    Either is given first; they have the same spaces, and their steps one size.
    """
    ours, theirs = (
        episode_blocks(recording, origin.phase, origin.episode if recording.run_id == origin.run else 0)
        for recording in (a, b)
    )
    fields = tuple(name for name in _compared(a, b, origin.phase) if name != "episode")
    divergence = _divergence(origin.phase, ours, theirs, fields)
    if divergence is None:
        return None
    at = EpisodeRef.parse(origin.at)
    return replace(divergence, episode=at.episode, after=at.after, a_step=None, b_step=None)


def _reset_divergence(a: Recording, b: Recording, phase: str, last: float) -> Divergence | None:
    """Return where what a reset observed differs, if that is before the end of the step `last`."""
    ours, theirs = (
        itertools.takewhile(lambda block: block["step"][0] <= last, recording.phase(phase).resets.rows())
        for recording in (a, b)
    )
    left, right = first_difference(ours, theirs, ("observation",))
    if left is None or right is None or left["step"][0] > last:
        return None
    part = _differing_part("reset.observation", left["observation"][0], right["observation"][0])
    return Divergence(phase, int(left["step"][0]), int(left["episode"][0]), 0, *part)
