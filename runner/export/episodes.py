"""Which episode of a run is shown: one that was named, the best, the worst or a typical one; its name."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from runner.analysis.evaluations import evaluation_after, evaluations_of
from runner.environments.naming import trial_in_words
from runner.errors import NotInRecording, RecordingError
from runner.export.contents import require_steps
from runner.recording.reader import Recording
from runner.replay.steps import check_steps, steps_of


@dataclass(frozen=True)
class EpisodePlace:
    """Where an episode stands in its recording."""

    phase: str
    number: int
    """Counted over the phase."""
    title: str
    table_step: int = -1
    """Training steps before the evaluation of a trial."""


def place_of(recording: Recording, which: tuple[int, ...]) -> EpisodePlace:
    """Return where an episode stands: (episode,) of training, or (training episodes before, trial)."""
    if len(which) == 1:
        return EpisodePlace("train", which[0], f"training episode {which[0]:,}")
    after, number = which
    where = str(recording.path)
    evaluation = evaluation_after(evaluations_of(recording), after, where)
    title = trial_in_words(after, number)
    return EpisodePlace("eval", evaluation.trial(number, where), title, evaluation.train_step)


def first_state(recording: Recording, which: tuple[int, ...]) -> int:
    """Return the state in which an episode of a tabular environment begins; `which` is as for `place_of`."""
    require_steps(recording, "show", may_redo=True)
    place = place_of(recording, which)
    steps = steps_of(recording, place.phase, place.number)[:1]
    check_steps(steps, recording.mdp, str(recording.path))
    return int(steps["state"][0])


def no_step(recording: Recording, title: str, steps: int, t: int) -> NotInRecording:
    """Return the error that an episode with this title and number of steps has no step `t`."""
    return NotInRecording(f"{recording.path}: {title} has {steps:,} steps, from 0; found no step {t:,}.")


def chosen_episode(recording: Recording, episode: int | None, trial: tuple[int, int] | None) -> EpisodePlace:
    """Return a training episode, or a trial (training episodes before, number); without any, a typical one.

    That is `default_trial`, or the last training episode of a run without evaluations.
    """
    require_steps(recording, "show", may_redo=True)
    if episode is not None:
        return place_of(recording, (episode,))
    return place_of(recording, trial or default_trial(recording) or (last_episode(recording),))


def ranked_episodes(recording: Recording) -> tuple[str, NDArray[np.int64]]:
    """Return the phase and the numbers of its episodes from worst to best: by success, return and length.

    They are the trials of all evaluations; of a run without trials the training episodes.

    Raises:
        RecordingError: no episode ended, or there are no steps.
    """
    require_steps(recording, "show", may_redo=True)
    phase = "eval" if recording.eval.episodes.count() else "train"
    records = recording.phase(phase).episodes.array()
    records = records[records["last_step"] < recording.phase(phase).steps.total()]
    if not len(records):
        raise RecordingError(f"{recording.path}: found no episode that ended; --episode 0 shows the first.")
    return phase, _by_rank(records)


def extreme_episode(recording: Recording, best: bool) -> EpisodePlace:
    """Return the best or the worst of the episodes that `ranked_episodes` ranks; errors as there."""
    phase, ranked = ranked_episodes(recording)
    return named_episode(recording, phase, int(ranked[-1 if best else 0]))


def named_episode(recording: Recording, phase: str, number: int) -> EpisodePlace:
    """Return where an episode of a phase stands, counted over the phase."""
    if phase == "train":
        return place_of(recording, (number,))
    for one in evaluations_of(recording):
        if one.start <= number < one.stop:
            return place_of(recording, (one.after, number - one.start))
    return EpisodePlace(phase, number, f"evaluation episode {number:,}")


def ranked_trials(recording: Recording, after: int) -> tuple[int, int, int]:
    """Return the worst, the median and the best trial of an evaluation: by success, return and length."""
    evaluation = evaluation_after(evaluations_of(recording), after, str(recording.path))
    worst, median, best = ranked(recording, "eval", evaluation.start, evaluation.stop)
    return worst - evaluation.start, median - evaluation.start, best - evaluation.start


def ranked(recording: Recording, phase: str, start: int, stop: int) -> tuple[int, int, int]:
    """Return the worst, the median and the best of some episodes: by success, return and length."""
    ranked_numbers = _by_rank(recording.phase(phase).episodes.array(start, stop))
    worst, median, best = (int(ranked_numbers[i]) for i in (0, len(ranked_numbers) // 2, -1))
    return worst, median, best


def _by_rank(records: NDArray[np.void]) -> NDArray[np.int64]:
    """Return the numbers of episodes from worst to best; a return that is no number is the worst."""
    with np.errstate(over="ignore", invalid="ignore"):  # rewards may be infinite
        returns = records["returns"].sum(axis=1)
    returns[np.isnan(returns)] = -np.inf
    order = np.lexsort((-records["length"].astype(np.int64), returns, records["success"]))
    return records["episode"][order].astype(np.int64)


def typical_trial(recording: Recording) -> tuple[int, int]:
    """Return the last evaluation (training episodes before it) and its median trial.

    Raises:
        RecordingError: there is no evaluation, or no steps.
    """
    require_steps(recording, "show", may_redo=True)
    after = last_whole_evaluation(recording)
    if after is None:
        raise RecordingError(f"{recording.path}: has no whole evaluation; choose a training episode.")
    return after, ranked_trials(recording, after)[1]


def default_trial(recording: Recording) -> tuple[int, int] | None:
    """Return the trial to show if the user names none: training episodes before it, and its number.

    It is the typical trial of the last whole evaluation. In a loop, where the number of trials of an
    evaluation is unknown, it is the first trial after the last training. None if there is no such trial.
    """
    if recording.eval.has_metrics:
        return typical_trial(recording) if last_whole_evaluation(recording) is not None else None
    evaluations = evaluations_of(recording)
    return (evaluations[-1].after, 0) if evaluations else None


def last_episode(recording: Recording) -> int:
    """Return the number of the last training episode that ended; 0 if none did."""
    return max(0, recording.train.episodes.count() - 1)


def last_whole_evaluation(recording: Recording) -> int | None:
    """Return the training episodes before the last evaluation whose trials were all recorded.

    A recording that was cut off may have an evaluation's metrics without its trials. The evaluations of a
    loop are the trials that were recorded.
    """
    episodes, steps = recording.eval.episodes.count(), recording.eval.steps.total()
    for one in reversed(evaluations_of(recording)):
        if (
            one.stop <= episodes
            and recording.eval.episodes.array(one.stop - 1, one.stop)[0]["last_step"] < steps
        ):
            return one.after
    return None
