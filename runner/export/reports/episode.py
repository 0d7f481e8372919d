"""One recorded episode as arrays, for replays, films and notebooks.

Frame k is the state after k steps, with the step that led there and the Q-values of the next choice. So an
episode of T steps has T + 1 frames.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from runner.analysis.evaluations import evaluation_after, evaluations_of
from runner.environments.mdp import events_of
from runner.environments.naming import (
    trial_in_words,
)
from runner.errors import RecordingError
from runner.export.contents import ENDINGS, ending_of, require_steps
from runner.recording import schema
from runner.recording.reader import Recording
from runner.replay.steps import check_steps
from runner.replay.tables import TableReplay, tables_at

MAX_STEPS: Final = 1000
"""Steps of an episode that a page shows; the page says so where an episode has more."""


@dataclass(frozen=True, eq=False)
class Episode:
    """A part of a recorded episode: arrays of T steps, and of T + 1 states."""

    title: str
    phase: str
    number: int
    length: int
    """Steps of the whole episode."""
    total: float
    """Sum of the rewards of the whole episode."""
    ended: str
    """A key of `ENDINGS`."""
    states: NDArray[np.int64]
    actions: NDArray[np.int64]
    rewards: NDArray[np.float64]
    """[T, learners]."""
    events: NDArray[np.int64]
    explored: NDArray[np.int64]
    times: NDArray[np.int64]
    """The number of all steps of the run that were executed after each step, [T]."""
    values: tuple[NDArray[np.float64], ...]
    """For each learner the Q-values in the first T states, [T, actions]; empty if they are unknown."""
    names: tuple[str, ...] = ()
    """Reasons for showing it, such as `best trial`."""
    first: int = 0
    """Steps of the episode before this part."""
    before: tuple[float, ...] = ()
    """Sum of each learner's rewards in them; empty if there are none."""

    @property
    def steps(self) -> int:
        """Number of steps of this part."""
        return len(self.actions)

    def called(self, name: str) -> Episode:
        """Return it with one more reason for showing it, such as `best trial`."""
        return replace(self, names=(*self.names, name))

    @property
    def heading(self) -> str:
        """Its reasons and its title: `best trial: trial 3 of ...`."""
        names = " and ".join(self.names)
        text = f"{names}: {self.title}" if names else self.title
        return text[0].upper() + text[1:]

    @property
    def description(self) -> str:
        """Length, end and return as text, and the number of steps if these are not all."""
        part = "" if self.steps == self.length else f" Shown are the first {self.steps:,} steps."
        return self.outcome + part

    @property
    def outcome(self) -> str:
        """Length, end and return as text."""
        return outcome_in_words(self.length, self.ended, self.total)


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
    """Return where an episode stands.

    Args:
        recording: the run.
        which: (episode,) of training, or (training episodes before, trial) of an evaluation.

    Raises:
        RecordingError: there is no such evaluation or trial.
    """
    if len(which) == 1:
        return EpisodePlace("train", which[0], f"training episode {which[0]:,}")
    after, number = which
    where = str(recording.path)
    evaluation = evaluation_after(evaluations_of(recording), after, where)
    title = trial_in_words(after, number)
    return EpisodePlace("eval", evaluation.trial(number, where), title, evaluation.train_step)


def outcome_in_words(length: int, ended: str, total: float | None) -> str:
    """Return length, end and return of an episode as text; a return of None is unknown."""
    rewards = "" if total is None else f" Rewards sum to {total:g}."
    return f"{length:,} steps, {ENDINGS[ended]}.{rewards}"


def training_episode(recording: Recording, number: int, limit: int = MAX_STEPS, first: int = 0) -> Episode:
    """Return at most `limit` steps of a training episode, counted from 0, even if it never ended.

    Raises:
        RecordingError: there is no such episode, or no steps.
    """
    return episode_at(recording, place_of(recording, (number,)), limit, first)


def trial(recording: Recording, after: int, number: int, limit: int = MAX_STEPS, first: int = 0) -> Episode:
    """Return at most `limit` steps of a trial, counted from 0.

    Args:
        recording: the run.
        after: training episodes before the evaluation.
        number: the trial.
        limit: the largest number of steps.
        first: the first step.

    Raises:
        RecordingError: there is no such evaluation or trial, or no steps.
    """
    return episode_at(recording, place_of(recording, (after, number)), limit, first)


def ranked_trials(recording: Recording, after: int) -> tuple[int, int, int]:
    """Return the worst, the median and the best trial of an evaluation: by success, return and length."""
    evaluation = evaluation_after(evaluations_of(recording), after, str(recording.path))
    worst, median, best = ranked(recording, "eval", evaluation.start, evaluation.stop)
    return worst - evaluation.start, median - evaluation.start, best - evaluation.start


def ranked(recording: Recording, phase: str, start: int, stop: int) -> tuple[int, int, int]:
    """Return the worst, the median and the best of some episodes: by success, return and length."""
    records = recording.episodes(phase, start, stop)
    with np.errstate(over="ignore", invalid="ignore"):  # rewards may be infinite
        returns = records["returns"].sum(axis=1)
    order = np.lexsort((-records["length"].astype(np.int64), returns, records["success"]))
    worst, median, best = (int(records["episode"][order[i]]) for i in (0, len(order) // 2, -1))
    return worst, median, best


def typical_trial(recording: Recording) -> tuple[int, int]:
    """Return the last evaluation (training episodes before it) and its median trial.

    Raises:
        RecordingError: there is no evaluation, or no steps.
    """
    require_steps(recording, "show")
    after = last_whole_evaluation(recording)
    if after is None:
        raise RecordingError(f"{recording.path}: has no whole evaluation; choose a training episode.")
    return after, ranked_trials(recording, after)[1]


def default_trial(recording: Recording) -> tuple[int, int] | None:
    """Return the trial to show if the user names none: training episodes before it, and its number.

    It is the typical trial of the last whole evaluation. In a loop, where the number of trials of an
    evaluation is unknown, it is the first trial after the last training. None if there is no such trial.
    """
    if recording.is_job:
        return typical_trial(recording) if last_whole_evaluation(recording) is not None else None
    evaluations = evaluations_of(recording)
    return (evaluations[-1].after, 0) if evaluations else None


def last_episode(recording: Recording) -> int:
    """Return the number of the last training episode that ended; 0 if none did."""
    return max(0, recording.count(schema.TRAIN_EPISODE) - 1)


def last_whole_evaluation(recording: Recording) -> int | None:
    """Return the training episodes before the last evaluation whose trials were all recorded.

    A recording that was cut off may have an evaluation's metrics without its trials. The evaluations of a
    loop are the trials that were recorded.
    """
    episodes, steps = recording.count(schema.EVAL_EPISODE), recording.count(schema.EVAL_STEP)
    for one in reversed(evaluations_of(recording)):
        if (
            one.stop <= episodes
            and recording.episodes("eval", one.stop - 1, one.stop)[0]["last_step"] < steps
        ):
            return one.after
    return None


def episode_at(recording: Recording, place: EpisodePlace, limit: int = MAX_STEPS, first: int = 0) -> Episode:
    """Return at most `limit` steps of an episode from step `first` on, even if it never ended.

    Raises:
        RecordingError: there is no such episode or step, or no steps.
    """
    require_steps(recording, "show")
    phase, number, title = place.phase, place.number, place.title
    steps = recording.episode_steps(phase, number)
    shown = steps[first : first + limit]
    if not len(shown):
        raise RecordingError(
            f"{recording.path}: {title} has {len(steps):,} steps, from 0; found no step {first:,}."
        )
    mdp = recording.mdp
    check_steps(shown, mdp, str(recording.path))
    return Episode(
        title=title,
        phase=phase,
        number=number,
        length=len(steps),
        total=float(steps["rewards"].sum()),
        ended=ending_of(recording, phase, number),
        states=np.append(shown["state"], shown["next_state"][-1]).astype(np.int64),
        actions=shown["action"].astype(np.int64),
        rewards=shown["rewards"].astype(np.float64),
        events=events_of(mdp, shown).astype(np.int64),
        explored=shown["explored"].astype(np.int64),
        times=(shown["log_time"] // schema.STEP_NANOSECONDS).astype(np.int64),
        values=_values(recording, shown, place.table_step),
        first=first,
        before=tuple(steps["rewards"][:first].sum(axis=0).tolist()) if first else (),
    )


def _values(
    recording: Recording, steps: NDArray[np.void], table_step: int
) -> tuple[NDArray[np.float64], ...]:
    """Return each learner's Q-values in the states of steps; empty if they are unknown."""
    if not recording.is_job:
        return ()
    try:
        if table_step >= 0:
            tables = tables_at(recording, table_step)
            return tuple(table[steps["state"]] for table in tables)
        first = int(steps["step"][0])
        replay = TableReplay(recording, first)
        widths = [table.shape[1] for table in replay.tables]
        rows = replay.rows(first + len(steps))
    except RecordingError:
        return ()
    return tuple(rows[:, i, :width] for i, width in enumerate(widths))
