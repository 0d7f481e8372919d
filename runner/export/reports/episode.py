"""One recorded episode as arrays, for replays, films and notebooks.

Frame k is the state after k steps, with the step that led there and the Q-values of the next choice. So an
episode of T steps has T + 1 frames.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.analysis.evaluations import evaluation_after, evaluations_of
from runner.drawing import svg
from runner.environments.mdp import Mdp, events_of
from runner.environments.naming import (
    actions_in_words,
    agent_actions,
    deeds_in_words,
    event_in_words,
    numbered_actions,
    spoken,
    states_in_words,
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
MAX_VALUES: Final = 6
"""Q-values of a state that a page shows: the highest, and that of the action taken."""


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
        return f"{self.length:,} steps, {ENDINGS[self.ended]}. Rewards sum to {self.total:g}."


def training_episode(recording: Recording, number: int, limit: int = MAX_STEPS, first: int = 0) -> Episode:
    """Return at most `limit` steps of a training episode, counted from 0, even if it never ended.

    Raises:
        RecordingError: there is no such episode, or no steps.
    """
    require_steps(recording, "show")
    title = f"training episode {number:,}"
    return _episode(recording, "train", number, title, range(first, first + limit))


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
    require_steps(recording, "show")
    where = str(recording.path)
    evaluation = evaluation_after(evaluations_of(recording), after, where)
    index = evaluation.trial(number, where)
    shown = range(first, first + limit)
    return _episode(recording, "eval", index, trial_in_words(after, number), shown, evaluation.train_step)


def ranked_trials(recording: Recording, after: int) -> tuple[int, int, int]:
    """Return the worst, the median and the best trial of an evaluation: by success, return and length."""
    evaluation = evaluation_after(evaluations_of(recording), after, str(recording.path))
    records = recording.episodes("eval", evaluation.start, evaluation.stop)
    order = np.lexsort(
        (-records["length"].astype(np.int64), records["returns"].sum(axis=1), records["success"])
    )
    return int(order[0]), int(order[len(order) // 2]), int(order[-1])


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

    A recording that was cut off may have an evaluation's metrics without its trials. None for a loop, where
    the end of an evaluation is unknown.
    """
    if not recording.is_job:
        return None
    episodes, steps = recording.count(schema.EVAL_EPISODE), recording.count(schema.EVAL_STEP)
    for one in reversed(evaluations_of(recording)):
        if (
            one.stop <= episodes
            and recording.episodes("eval", one.stop - 1, one.stop)[0]["last_step"] < steps
        ):
            return one.after
    return None


def payload(recording: Recording, episodes: list[Episode], drawing: svg.Drawing | None) -> dict[str, Any]:
    """Return the data of a replay as JSON values: lists of numbers, with each text once.

    Args:
        recording: the run.
        episodes: episodes of the run.
        drawing: the drawing of its scene; None without a scene.
    """
    mdp, agents = recording.mdp, recording.agents
    own = numbered_actions(mdp)
    joint = actions_in_words(mdp).tolist()
    return {
        "actions": deeds_in_words(mdp),
        "choices": [joint] if len(agents) == 1 else own,
        "learners": [spoken(agent) for agent in agents],
        "events": [event_in_words(name) for name in mdp.event_names],
        "episodes": [_packed(mdp, episode, drawing) for episode in episodes],
        "trail": svg.TRAIL,
    }


def _episode(
    recording: Recording, phase: str, number: int, title: str, part: range, table_step: int = -1
) -> Episode:
    steps = recording.episode_steps(phase, number)
    shown, last = steps[part.start : part.stop], steps[-1]
    if not len(shown):
        raise RecordingError(
            f"{recording.path}: {title} has {len(steps):,} steps, from 0; found no step {part.start:,}."
        )
    mdp = recording.mdp
    check_steps(shown, mdp, str(recording.path))
    return Episode(
        title=title,
        phase=phase,
        number=number,
        length=len(steps),
        total=float(steps["rewards"].sum()),
        ended=ending_of(recording, phase, number, last),
        states=np.append(shown["state"], shown["next_state"][-1]).astype(np.int64),
        actions=shown["action"].astype(np.int64),
        rewards=shown["rewards"].astype(np.float64),
        events=events_of(mdp, shown).astype(np.int64),
        explored=shown["explored"].astype(np.int64),
        values=_values(recording, shown, table_step),
        first=part.start,
        before=tuple(steps["rewards"][: part.start].sum(axis=0).tolist()) if part.start else (),
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


def _packed(mdp: Mdp, episode: Episode, drawing: svg.Drawing | None) -> dict[str, Any]:
    """Return the arrays of an episode; words and places of a state are stored once."""
    distinct, which = np.unique(episode.states, return_inverse=True)
    places = []
    if drawing is not None:
        places = drawing.places(mdp, distinct).reshape(len(distinct), -1).tolist()
    chosen = [agent_actions(mdp, action) for action in episode.actions.tolist()]
    return {
        "title": episode.heading,
        "description": episode.description,
        "states": [str(word) for word in states_in_words(mdp)[distinct]],
        "places": places,
        "state": which.tolist(),
        "action": episode.actions.tolist(),
        "reward": [[_short(reward) for reward in row] for row in episode.rewards.tolist()],
        "event": episode.events.tolist(),
        "explored": episode.explored.tolist(),
        "values": [
            _rows(
                values,
                [
                    own[i] if len(episode.values) > 1 else joint
                    for own, joint in zip(chosen, episode.actions.tolist(), strict=True)
                ],
            )
            for i, values in enumerate(episode.values)
        ],
    }


def _rows(values: NDArray[np.float64], taken: list[int]) -> dict[str, Any]:
    """Return the highest Q-values of each step, [action, value] pairs, and the action taken."""
    rows: dict[str, int] = {}
    which: list[int] = []
    packed: list[list[list[Any]]] = []
    for row, action in zip(values, taken, strict=True):
        best = np.argsort(-row, kind="stable")[:MAX_VALUES].tolist()
        shown = best if action in best else [*best[:-1], action]
        if len(row) <= MAX_VALUES:
            shown = sorted(shown)
        pairs = [[int(choice), _short(float(row[choice]))] for choice in shown]
        key = str(pairs)
        if key not in rows:
            rows[key] = len(packed)
            packed.append(pairs)
        which.append(rows[key])
    return {"rows": packed, "row": which, "taken": [int(action) for action in taken], "of": values.shape[1]}


def _short(value: float) -> float | int:
    """Round a value to five significant digits."""
    rounded = float(f"{value:.5g}")
    return int(rounded) if rounded == int(rounded) else rounded
