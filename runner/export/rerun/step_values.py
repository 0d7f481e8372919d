"""The learners' Q-values at each exported step: exact values, greedy actions, and maps of both.

The tables are replayed from the recorded steps, so all of it is exact for the step it is shown at. Where
a repair lost steps, the values after them are unknown up to the next snapshot, and are left out.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from runner.environments.mdp import Mdp
from runner.export.rerun.columns import StepValues
from runner.export.rerun.filling import best_of_joint
from runner.export.rerun.scene import Placements, own_actions
from runner.recording.reader import Recording
from runner.recording.schema import STEP_NANOSECONDS
from runner.replay.tables import StateProbe, TableReplay, known_steps


class StepValueReader:
    """Reads the Q-values at the steps of a recorded run.

    Args:
        recording: the run.
        placements: the states of each map; None for no maps.
    """

    def __init__(self, recording: Recording, placements: Placements | None) -> None:
        self._recording = recording
        self._mdp: Mdp = recording.mdp
        self._own_actions = own_actions(self._mdp)
        self._context = np.zeros(self._mdp.states, np.int64)
        self._states = np.empty((1, 0), np.int32)
        if placements is not None:
            self._context, self._states = placements.context, placements.states
        self._known = known_steps(recording)
        self._replay: TableReplay | None = None
        self._last = (0, -1)
        """Time and context of the step before."""

    def split(self, block: NDArray[np.void]) -> Iterator[NDArray[np.void]]:
        """Yield a block of training steps in parts whose values are either all known or all unknown."""
        first = int(block["step"][0])
        edges = [edge for start, last in self._known for edge in (start, last + 1)]
        cuts = [edge - first for edge in edges if 0 < edge - first < len(block)]
        yield from np.split(block, cuts)

    def training(self, block: NDArray[np.void]) -> StepValues | None:
        """Return the values before the update of each step of a part; None if they are unknown.

        Raises:
            RecordingError: the environment cannot have such steps.
        """
        replay = self._at(int(block["step"][0]))
        if replay is None:
            return None
        rows = replay.empty_rows(len(block))
        probe = self._probe(block)
        replay.apply(block, rows, probe)
        return StepValues(*self._by_agent(rows), probe.before, probe.value, probe.greedy)

    def evaluating(self, block: NDArray[np.void], train_step: int) -> StepValues | None:
        """Return the values at a block of evaluation steps, made after `train_step` training steps."""
        replay = self._at(train_step)
        if replay is None:
            return None
        probe = self._probe(block)
        replay.read(probe)
        rows = replay.values_in(block["state"])
        return StepValues(*self._by_agent(rows), probe.before, probe.value, probe.greedy)

    def _at(self, step: int) -> TableReplay | None:
        """Return the replay at a training step; None if the tables there are unknown."""
        if not any(first <= step <= last for first, last in self._known):
            return None
        if self._replay is None:
            self._replay = TableReplay(self._recording, step)
        elif self._replay.step != step:
            self._replay.seek(step)
        return self._replay

    def _probe(self, block: NDArray[np.void]) -> StateProbe:
        """Return what reads a map before each step at which an episode begins or the context changes."""
        context = self._context[block["state"]]
        new = block["t"] == 0
        new[1:] |= context[1:] != context[:-1]
        before = (int(block["log_time"][0]) - STEP_NANOSECONDS, int(context[0]))
        new[0] |= before != self._last
        self._last = (int(block["log_time"][-1]), int(context[-1]))
        rows = np.flatnonzero(new)
        shape = len(rows), len(self._recording.agents), self._states.shape[1]
        states = self._states[context[rows]]
        return StateProbe(rows, states, np.empty(shape, np.float32), np.empty(shape, np.int32))

    def _by_agent(self, rows: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return values and greedy actions of each agent, from the values of each learner."""
        counts = self._mdp.action_counts
        if rows.shape[1] == len(counts):
            own = [rows[:, i, :count] for i, count in enumerate(counts)]
            return np.concatenate(own, axis=1), np.stack([part.argmax(axis=1) for part in own], axis=1)
        best = np.empty((len(rows), sum(counts)))
        greedy = np.empty((len(rows), len(counts)), np.int64)
        first = np.cumsum((0, *counts[:-1]))
        best_of_joint(rows[:, 0], self._own_actions, first, best, greedy)
        return best, greedy
