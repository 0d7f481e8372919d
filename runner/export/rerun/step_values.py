"""Q-values at a step, read by replaying the tables.

The tables are replayed from the recorded steps, so everything shown is exact for its step. Where a repair
lost steps, the values after them are unknown up to the next snapshot, and are left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from runner.environments.mdp import Mdp
from runner.export.rerun.scene import Placements
from runner.recording.reader import Recording
from runner.recording.schema import STEP_NANOSECONDS
from runner.replay.step_replay import StateProbe
from runner.replay.tables import TableReplay, known_steps


@dataclass(frozen=True, eq=False)
class StepValues:
    """The learners' Q-values at n steps, and maps of them at some of these steps."""

    values: NDArray[np.float64]
    """[n, sum of the agents' action counts]: the value of each agent's own actions; with a joint table the
    best over the actions of the others."""
    greedy: NDArray[np.int64]
    """[n, agents]: each agent's greedy action."""
    map_rows: NDArray[np.int64]
    """[k]: the steps that have maps."""
    value_maps: NDArray[np.float32]
    """[k, learners, pixels]: the greatest value in the state of each pixel; nan for no state."""
    greedy_maps: NDArray[np.int32]
    """[k, learners, pixels]: the learner's greedy action there; -1 for no state."""

    @classmethod
    def concatenated(cls, parts: Sequence[StepValues]) -> StepValues:
        """Return the values of successive steps as one."""
        starts = np.cumsum([0, *(len(part.values) for part in parts[:-1])])
        return cls(
            np.concatenate([part.values for part in parts]),
            np.concatenate([part.greedy for part in parts]),
            np.concatenate([part.map_rows + start for part, start in zip(parts, starts, strict=True)]),
            np.concatenate([part.value_maps for part in parts]),
            np.concatenate([part.greedy_maps for part in parts]),
        )


class StepValueReader:
    """Reads the Q-values at the steps of a recorded run, with maps of placements if there are any."""

    def __init__(self, recording: Recording, placements: Placements | None) -> None:
        self._recording = recording
        self._mdp: Mdp = recording.mdp
        self._learners = len(recording.agents)
        self._context = np.zeros(self._mdp.states, np.int64)
        self._states = np.empty((1, 0), np.int32)
        if placements is not None:
            self._context, self._states = placements.context, placements.states
        self._known_ranges = known_steps(recording)
        self._replay: TableReplay | None = None
        self._last = (0, -1)
        """Time and context of the step before."""

    def split(self, block: NDArray[np.void]) -> Iterator[NDArray[np.void]]:
        """Yield a block of training steps in parts whose values are either all known or all unknown."""
        first = int(block["step"][0])
        edges = [edge for start, last in self._known_ranges for edge in (start, last + 1)]
        yield from np.split(block, [edge - first for edge in edges if 0 < edge - first < len(block)])

    def training(self, block: NDArray[np.void]) -> StepValues | None:
        """Return the values before the update of each step of a part; None if they are unknown."""
        replay = self._replay_at(int(block["step"][0]))
        if replay is None:
            return None
        rows, probe = replay.empty_rows(len(block)), self._probe(block)
        replay.apply(block, rows, probe)
        return self._step_values(rows, probe)

    def evaluation(self, block: NDArray[np.void], train_step: int) -> StepValues | None:
        """Return the values at a block of evaluation steps, made after `train_step` training steps."""
        replay = self._replay_at(train_step)
        if replay is None:
            return None
        probe = self._probe(block)
        replay.read(probe)
        return self._step_values(replay.values_in(block["state"]), probe)

    def _replay_at(self, step: int) -> TableReplay | None:
        """Return the replay at a training step; None if the tables there are unknown."""
        if not any(first <= step <= last for first, last in self._known_ranges):
            return None
        if self._replay is None:
            self._replay = TableReplay(self._recording, step)
        elif self._replay.step != step:
            self._replay.seek(step)
        return self._replay

    def _probe(self, block: NDArray[np.void]) -> StateProbe:
        """Return a probe of the map before each step at which an episode begins or the context changes."""
        context = self._context[block["state"]]
        changes = block["t"] == 0
        changes[1:] |= context[1:] != context[:-1]
        before = (int(block["log_time"][0]) - STEP_NANOSECONDS, int(context[0]))
        changes[0] |= before != self._last
        self._last = (int(block["log_time"][-1]), int(context[-1]))
        rows = np.flatnonzero(changes)
        shape = len(rows), self._learners, self._states.shape[1]
        states = self._states[context[rows]]
        return StateProbe(rows, states, np.empty(shape, np.float32), np.empty(shape, np.int32))

    def _step_values(self, rows: NDArray[np.float64], probe: StateProbe) -> StepValues:
        """Return the values by agent of rows by learner."""
        counts = self._mdp.action_counts
        if rows.shape[1] == len(counts):
            own = [rows[:, i, :count] for i, count in enumerate(counts)]
            values, greedy = np.concatenate(own, axis=1), np.stack([q.argmax(axis=1) for q in own], axis=1)
        else:
            values = np.empty((len(rows), sum(counts)))
            greedy = np.empty((len(rows), len(counts)), np.int64)
            first = np.cumsum((0, *counts[:-1]))
            _split_joint(rows[:, 0], self._mdp.own_actions, first, values, greedy)
        return StepValues(values, greedy, probe.before, probe.value, probe.greedy)


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator,unused-ignore]
def _split_joint(
    rows: NDArray[np.float64],
    own: NDArray[np.int64],
    first: NDArray[np.int64],
    best: NDArray[np.float64],
    greedy: NDArray[np.int64],
) -> None:
    """Split the values of joint actions by agent: its best over the actions of the others, its greedy action.

    Args:
        rows: [n, J], values of the joint actions.
        own: [J, agents], each agent's part of a joint action.
        first: [agents], where the values of each agent begin in `best`.
        best: [n, sum of the action counts], filled.
        greedy: [n, agents], filled; ties go to the lowest joint action.
    """
    for k in range(len(rows)):
        for i in range(best.shape[1]):
            best[k, i] = -np.inf
        highest = 0
        for joint in range(rows.shape[1]):
            value = rows[k, joint]
            if value > rows[k, highest]:
                highest = joint
            for agent in range(own.shape[1]):
                i = first[agent] + own[joint, agent]
                best[k, i] = max(best[k, i], value)
        for agent in range(own.shape[1]):
            greedy[k, agent] = own[highest, agent]
