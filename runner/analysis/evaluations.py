"""Evaluations, known by the training episodes before them, and their trials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from runner.analysis.frames import trained_before
from runner.errors import RecordingError
from runner.recording.reader import Recording
from runner.recording.schema import TRAIN_EPISODE


@dataclass(frozen=True)
class Evaluation:
    """One evaluation's trials."""

    after: int
    """Training episodes before it."""
    train_step: int
    """Training steps before it."""
    start: int
    """First trial, counted over all evaluations."""
    stop: int
    number: int = 0
    """Counted from 0 in the order made, also where a repair lost others."""

    def trial(self, number: int, where: str) -> int:
        """Return the number of a trial, counted from 0, among those of all evaluations.

        Raises:
            RecordingError: there is no such trial; the message begins with `where`.
        """
        trials = self.stop - self.start
        if not 0 <= number < trials:
            raise RecordingError(
                f"{where}: found no trial {number:,} of the evaluation after {self.after:,} episodes; "
                f"it has {trials:,}, from 0."
            )
        return self.start + number


def evaluations_of(recording: Recording) -> list[Evaluation]:
    """Return a run's evaluations: those with metrics; of a loop, its trials between training episodes."""
    if not recording.is_job:
        return _of_loop(recording)
    found: list[Evaluation] = []
    for metrics in recording.metrics("eval"):
        trials = int(metrics["trials"])
        number = int(metrics["evaluation"])  # a repair may have lost the metrics of others
        start = number * trials
        found.append(Evaluation(int(metrics["episode"]), int(metrics["step"]), start, start + trials, number))
    return found


def evaluation_after(evaluations: Sequence[Evaluation], episodes: int, where: str) -> Evaluation:
    """Return the evaluation after so many training episodes.

    Raises:
        RecordingError: there is none; the message begins with `where`.
    """
    found = {one.after: one for one in evaluations}
    if episodes in found:
        return found[episodes]
    known = "it has none at all."
    if found:
        nearest = min(found, key=lambda after: abs(after - episodes))
        known = f"it has {len(found):,}, the nearest after {nearest:,}."
    raise RecordingError(f"{where}: found no evaluation after {episodes:,} episodes; {known}")


def _of_loop(recording: Recording) -> list[Evaluation]:
    steps = [block["last_step"].astype(np.int64) + 1 for block in recording.blocks(TRAIN_EPISODE)]
    done = np.concatenate([np.zeros(1, np.int64), *steps])
    found = np.unique(trained_before(recording), return_index=True, return_counts=True)
    return [
        Evaluation(after, int(done[after]), start, start + trials)
        for after, start, trials in zip(*(part.tolist() for part in found), strict=True)
    ]
