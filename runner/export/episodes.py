"""Which episode of a run is shown: the one that was named, the best, the worst, or a typical one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from runner.analysis.evaluations import evaluation_after, evaluations_of
from runner.environments.naming import trial_in_words
from runner.errors import RecordingError
from runner.export.contents import require_steps
from runner.export.reports.episode import default_trial, last_episode
from runner.recording import schema
from runner.recording.reader import Recording


@dataclass(frozen=True)
class EpisodeChoice:
    """An episode of a run."""

    phase: str
    """`train` or `eval`."""
    number: int
    """Among the episodes of the phase, counted from 0."""
    title: str
    """Its name as text: `training episode 12`, `trial 3 of the evaluation after 40 episodes`."""


def chosen_episode(recording: Recording, episode: int | None, trial: tuple[int, int] | None) -> EpisodeChoice:
    """Return the training episode or trial of these numbers; without any, a typical one.

    That is `default_trial`, or the last training episode of a run without evaluations.

    Args:
        recording: the run.
        episode: a training episode.
        trial: the training episodes before an evaluation, and a trial of it.

    Raises:
        RecordingError: there is no such evaluation or trial, or no steps.
    """
    require_steps(recording, "show")
    if episode is None and trial is None:
        trial = default_trial(recording)
    if trial is None:
        number = last_episode(recording) if episode is None else episode
        return EpisodeChoice("train", number, f"training episode {number:,}")
    after, number = trial
    where = str(recording.path)
    index = evaluation_after(evaluations_of(recording), after, where).trial(number, where)
    return EpisodeChoice("eval", index, trial_in_words(after, number))


def ranked_episodes(recording: Recording) -> tuple[str, NDArray[np.int64]]:
    """Return the phase and the numbers of its episodes from worst to best: by success, return and length.

    They are the trials of all evaluations; of a run without trials the training episodes.

    Raises:
        RecordingError: no episode ended, or there are no steps.
    """
    require_steps(recording, "show")
    phase = "eval" if recording.count(schema.EVAL_EPISODE) else "train"
    records = recording.episodes(phase)
    records = records[records["last_step"] < recording.count(recording.topic(f"/{phase}/step"))]
    if not len(records):
        raise RecordingError(f"{recording.path}: found no episode that ended; --episode 0 shows the first.")
    returns = np.nan_to_num(records["returns"].sum(axis=1), nan=-np.inf, posinf=np.inf, neginf=-np.inf)
    order = np.lexsort((-records["length"].astype(np.int64), returns, records["success"]))
    return phase, records["episode"][order].astype(np.int64)


def named_episode(recording: Recording, phase: str, number: int) -> EpisodeChoice:
    """Return an episode with its name."""
    if phase == "train":
        return EpisodeChoice(phase, number, f"training episode {number:,}")
    for evaluation in evaluations_of(recording):
        if evaluation.start <= number < evaluation.stop:
            return EpisodeChoice(phase, number, trial_in_words(evaluation.after, number - evaluation.start))
    return EpisodeChoice(phase, number, f"evaluation episode {number:,}")
