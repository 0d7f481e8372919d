"""One recorded episode as arrays, for replays, films and notebooks.

Frame k is the state after k steps, with the step that led there and the Q-values of the next choice. So an
episode of T steps has T + 1 frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from runner.environments.mdp import Mdp, events_of
from runner.errors import RecordingError
from runner.export.contents import ENDINGS, ending_of, require_steps
from runner.export.episodes import EpisodePlace, no_step, place_of
from runner.recording import schema
from runner.recording.reader import Recording
from runner.replay.steps import check_steps, steps_of
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
    first: int = 0
    """Steps of the episode before this part."""
    before: tuple[float, ...] = ()
    """Sum of each learner's rewards in them; empty if there are none."""


def outcome_in_words(length: int, ended: str, total: float | None) -> str:
    """Return length, end and return of an episode as text; a return of None is unknown."""
    rewards = "" if total is None else f" Rewards sum to {total:g}."
    return f"{length:,} step{'s' if length != 1 else ''}, {ENDINGS[ended]}.{rewards}"


def trial(recording: Recording, after: int, number: int, limit: int = MAX_STEPS, first: int = 0) -> Episode:
    """Return at most `limit` steps of a trial, counted from 0."""
    return episode_at(recording, place_of(recording, (after, number)), limit, first)


def episode_at(recording: Recording, place: EpisodePlace, limit: int = MAX_STEPS, first: int = 0) -> Episode:
    """Return at most `limit` steps of an episode from step `first` on, even if it never ended."""
    require_steps(recording, "show", may_redo=True)
    steps, ended = (
        steps_of(recording, place.phase, place.number),
        ending_of(recording, place.phase, place.number),
    )
    shown = steps[first : first + limit]
    if not len(shown):
        raise no_step(recording, place.title, len(steps), first)
    check_steps(shown, recording.mdp, str(recording.path))
    return episode_of(
        place, recording.mdp, steps, ended, _values(recording, shown, place.table_step), first, limit
    )


def episode_of(
    place: EpisodePlace,
    mdp: Mdp,
    steps: NDArray[np.void],
    ended: str,
    values: tuple[NDArray[np.float64], ...],
    first: int = 0,
    limit: int = MAX_STEPS,
) -> Episode:
    """Return a part of an episode from all of its steps, which the environment can have.

    `ended` is a key of `ENDINGS`; `values` are for each learner the Q-values in the states of the part, [T,
    actions].
    """
    shown = steps[first : first + limit]
    return Episode(
        title=place.title,
        phase=place.phase,
        number=place.number,
        length=len(steps),
        total=float(steps["rewards"].sum()),
        ended=ended,
        states=np.append(shown["state"], shown["next_state"][-1]).astype(np.int64),
        actions=shown["action"].astype(np.int64),
        rewards=shown["rewards"].astype(np.float64),
        events=events_of(mdp, shown).astype(np.int64),
        explored=shown["explored"].astype(np.int64),
        times=(shown["log_time"] // schema.STEP_NANOSECONDS).astype(np.int64),
        values=values,
        first=first,
        before=tuple(steps["rewards"][:first].sum(axis=0).tolist()) if first else (),
    )


def _values(
    recording: Recording, steps: NDArray[np.void], table_step: int
) -> tuple[NDArray[np.float64], ...]:
    """Return each learner's Q-values in the states of steps; empty if they are unknown."""
    if not recording.has_tables:
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
