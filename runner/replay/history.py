"""The history of a state's values: how often it was visited, and when its values changed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from runner.learning.watching import Watch
from runner.recording.reader import Recording
from runner.replay.tables import TableReplay
from runner.util.arrays import Ints


@dataclass(frozen=True, eq=False)
class StateHistory:
    """How often a state was visited, and when its values last changed; arrays [learners, most actions].

    An entry beyond a learner's own actions has no meaning.
    """

    visits: Ints
    """How often the learner took the action there."""
    changed_step: Ints
    """The step that last changed the value; -1 for never. An update by nothing changes nothing."""
    changed_episode: Ints
    """The episode of that step."""


def history_of(recording: Recording, state: int, step: int) -> StateHistory:
    """Return the history of a state's values in the first `step` training steps, by replaying them."""
    replay = TableReplay(recording)
    widths = np.array(replay.learner.model.width)
    is_action = np.arange(widths.max()) < widths[:, np.newaxis]
    visits: Ints = np.zeros(is_action.shape, np.int64)
    changed_step = np.full(widths.sum(), -1)
    changed_episode = np.full(widths.sum(), -1)
    watch = _watch_of(replay, state)
    before = replay.begin_watch(watch).q
    for steps in replay.blocks(step):
        changes = replay.watch(steps, watch)
        taken = replay.learner.model.own_action[steps["action"][steps["state"] == state]]
        for i, actions in enumerate(taken.T):
            visits[i] += np.bincount(actions, minlength=visits.shape[1])
        values = np.concatenate([before, changes.q])
        bits = values.view(np.int64)
        rows, cells = np.nonzero(bits[1:] != bits[:-1])
        changed_step[cells] = steps["step"][changes.row[rows]]  # of several the last
        changed_episode[cells] = steps["episode"][changes.row[rows]]
        before = values[-1:]
    history = StateHistory(visits, np.full(visits.shape, -1), np.full(visits.shape, -1))
    history.changed_step[is_action] = changed_step
    history.changed_episode[is_action] = changed_episode
    return history


def _watch_of(replay: TableReplay, state: int) -> Watch:
    """Return what to watch to see each change of a state's values, of one learner after the other."""
    model = replay.learner.model
    states = replay.learner.mdp.states
    offsets = zip(replay.learner.tables.offset, model.width, strict=True)
    cells = [offset + state * width + np.arange(width) for offset, width in offsets]
    return Watch(
        states=np.arange(states) == state,
        cells=np.concatenate(cells),
        greedy=np.empty((0, 2), np.int64),
        starts=np.empty(0, np.int64),
        success=np.uint32(0),
        path=np.empty((0, states), np.int32),
        length=np.empty(0, np.int64),
        on_path=np.empty((0, states), np.bool_),
        succeeds=np.empty(0, np.bool_),
    )
