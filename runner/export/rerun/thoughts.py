"""What the learners thought at each step: exact values, greedy actions, and pictures of both.

The tables are replayed from the recorded steps, so everything here is that of the very step.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from runner.analysis.tables import held_at
from runner.config import from_mapping
from runner.export.rerun.columns import Thoughts
from runner.export.rerun.filling import best_of_joint, pictures_of
from runner.export.rerun.scene import Placements, own_actions
from runner.learning import kernel
from runner.learning.learner import Learner
from runner.mdp import Mdp
from runner.recording.reader import Recording
from runner.recording.schema import STEP_NANOSECONDS, TRAIN_STEP

NEAR_STEPS = 200_000
"""A replay goes on over a gap of so many steps; over a longer one it may begin anew at a snapshot."""


class Thinker:
    """Follows the tables of a recorded run."""

    def __init__(self, recording: Recording, placements: Placements | None) -> None:
        self._recording = recording
        self._config = from_mapping(recording.config)
        self._seed = int(recording.run["seed"])
        self.mdp: Mdp = recording.mdp
        self._own_actions = own_actions(self.mdp)
        self._context = np.zeros(self.mdp.states, np.int64)
        self._states = np.empty((1, 0), np.int32)
        if placements is not None:
            self._context, self._states = placements.context, placements.states
        self._learner: Learner | None = None
        self._step = 0
        self._last = (0, -1)
        """Time and context of the step looked at last."""
        self._snapshots = [table.step for table in recording.snapshots()]

    @property
    def learners(self) -> int:
        """Number of tables."""
        return int(self._recording.run["learners"])

    def at(self, step: int) -> None:
        """Go to a training step, forwards or backwards."""
        begin_anew = self._learner is None or step < self._step
        begin_anew |= any(self._step + NEAR_STEPS < snapshot <= step for snapshot in self._snapshots)
        if begin_anew:
            self._learner = Learner(self._config, self.mdp, self._seed, held_at(self._recording, step))
            self._step = step
        elif step > self._step:
            for block in self._recording.blocks(TRAIN_STEP, self._step, step):
                kernel.replay(*self._state, block.view(np.recarray), np.empty((0, 0, 0)))
            self._step = step

    def training(self, block: NDArray[np.void]) -> Thoughts:
        """Return the thoughts at the training steps of a block, which follow each other, and update."""
        self.at(int(block["step"][0]))
        model = self._state[1]
        rows = np.full((len(block), len(model.width), max(model.width)), np.nan)
        renewed = self._renewals(block)
        value, greedy = self._empty_pictures(len(renewed))
        pictures = self._states[self._context[block["state"][renewed]]]
        _replay(*self._state, block.view(np.recarray), rows, renewed, pictures, value, greedy)
        self._step += len(block)
        return Thoughts(*self._by_agent(rows), renewed, value, greedy)

    def evaluating(self, block: NDArray[np.void]) -> Thoughts:
        """Return the thoughts at a block of evaluation steps, all of the tables as they are."""
        _, model, tables, _ = self._state
        learner = self._learner
        assert learner is not None
        state = block["state"].astype(np.int64)
        rows = np.full((len(block), len(model.width), max(model.width)), np.nan)
        for i, width in enumerate(model.width):
            rows[:, i, :width] = learner.table(i)[state]
        renewed = self._renewals(block)
        pictures = self._states[self._context[state[renewed]]]
        value, greedy = self._empty_pictures(len(renewed))
        for k, picture in enumerate(pictures):
            pictures_of(tables, picture, value[k], greedy[k])
        return Thoughts(*self._by_agent(rows), renewed, value, greedy)

    @property
    def _state(self) -> tuple[Any, ...]:
        assert self._learner is not None
        return self._learner.seed, self._learner.model, self._learner.tables, self._learner.rules

    def _renewals(self, block: NDArray[np.void]) -> NDArray[np.int64]:
        """Return the rows at which an episode begins or the context changes, looking back over blocks."""
        context = self._context[block["state"]]
        new = block["t"] == 0
        new[1:] |= context[1:] != context[:-1]
        before = (int(block["log_time"][0]) - STEP_NANOSECONDS, int(context[0]))
        new[0] |= before != self._last
        self._last = (int(block["log_time"][-1]), int(context[-1]))
        return np.flatnonzero(new)

    def _empty_pictures(self, count: int) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        shape = (count, self.learners, self._states.shape[1])
        return np.empty(shape, np.float32), np.empty(shape, np.int32)

    def _by_agent(self, rows: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return values and greedy actions of each agent, from what each learner saw."""
        counts = self.mdp.action_counts
        if rows.shape[1] == len(counts):
            own = [rows[:, i, :count] for i, count in enumerate(counts)]
            return np.concatenate(own, axis=1), np.stack([part.argmax(axis=1) for part in own], axis=1)
        best = np.empty((len(rows), sum(counts)))
        greedy = np.empty((len(rows), len(counts)), np.int64)
        first = np.cumsum((0, *counts[:-1]))
        best_of_joint(rows[:, 0], self._own_actions, first, best, greedy)
        return best, greedy


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator,unused-ignore]
def _replay(
    seed: Any,
    model: Any,
    tables: Any,
    rules: Any,
    steps: Any,
    rows: Any,
    renewed: Any,
    pictures: Any,
    value: Any,
    greedy: Any,
) -> None:
    """Replay steps, and before each of those in `renewed` take down the pictures of all learners."""
    at = 0
    for k in range(len(renewed)):
        kernel.replay(seed, model, tables, rules, steps[at : renewed[k]], rows[at : renewed[k]])
        at = renewed[k]
        pictures_of(tables, pictures[k], value[k], greedy[k])
    kernel.replay(seed, model, tables, rules, steps[at:], rows[at:])
