"""The history of a state's values: how often it was visited, and when its values changed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from runner.recording.reader import Recording
from runner.replay.tables import TableReplay

_STEPS_AT_ONCE: Final = 65_536


@dataclass(frozen=True, eq=False)
class StateHistory:
    """How often a state was visited, and when its values last changed; arrays [learners, most actions].

    An entry beyond a learner's own actions has no meaning.
    """

    visits: NDArray[np.int64]
    """How often the learner took the action there."""
    changed_step: NDArray[np.int64]
    """The step that last changed the value; -1 for never. An update by nothing changes nothing."""
    changed_episode: NDArray[np.int64]
    """The episode of that step."""


def history_of(recording: Recording, state: int, step: int) -> StateHistory:
    """Return the history of a state's values in the first `step` training steps, by replaying them."""
    replay = TableReplay(recording)
    shape = (len(replay.tables), max(table.shape[1] for table in replay.tables))
    history = StateHistory(np.zeros(shape, np.int64), np.full(shape, -1), np.full(shape, -1))
    pending = np.empty(0, recording.train.steps.row_dtype), np.empty((0, *shape))
    while replay.step < step:
        first, stop = replay.step, min(replay.step + _STEPS_AT_ONCE, step)
        rows = replay.rows(stop)
        steps = recording.train.steps.array(first, stop)
        here = steps["state"] == state
        _count(history.visits, replay.own_actions[steps["action"][here]])
        pending = _note_changes(
            history, np.concatenate([pending[0], steps[here]]), np.concatenate([pending[1], rows[here]])
        )
    last = replay.values_in(np.array([state]))
    _note_changes(history, np.repeat(pending[0], 2), np.concatenate([pending[1], last[: len(pending[1])]]))
    return history


def _count(visits: NDArray[np.int64], own: NDArray[np.int32]) -> None:
    """Count each learner's own actions, [visits, learners]."""
    for i in range(len(visits)):
        visits[i] += np.bincount(own[:, i], minlength=visits.shape[1])


def _note_changes(
    history: StateHistory, steps: NDArray[np.void], rows: NDArray[np.float64]
) -> tuple[NDArray[np.void], NDArray[np.float64]]:
    """Note which visit last changed each value; return the last visit, whose effect only the next shows.

    Args:
        rows: the state's values before each of them, [visits, learners, most actions].
    """
    if len(rows) > 1:
        bits = rows.view(np.int64)
        changed = bits[1:] != bits[:-1]
        last = len(changed) - 1 - changed[::-1].argmax(axis=0)
        ever = changed.any(axis=0)
        history.changed_step[ever] = steps["step"][last[ever]]
        history.changed_episode[ever] = steps["episode"][last[ever]]
    return steps[-1:], rows[-1:]
