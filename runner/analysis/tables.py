"""Any Q-table at any step: the nearest snapshot before it, and the recorded steps from there on replayed.

with runner.recording.open(path) as recording:
    tables = tables_at(recording, step=1_000_000)      # a float64 [states, actions] a learner
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runner.config import from_mapping
from runner.errors import RecordingError
from runner.learning import kernel
from runner.learning.learner import Learner
from runner.recording import schema
from runner.recording.messages import QTable
from runner.recording.reader import Recording

_NO_ROWS = np.empty((0, 0, 0))


class TableReplay:
    """The tables of a recorded run, moved forward step by step; `tables` are always those at `step`.

    Args:
        recording: the run.
        step: training steps that were taken when the replay begins.

    Raises:
        RecordingError: there is no such step, or the steps from the nearest snapshot are not recorded.
    """

    def __init__(self, recording: Recording, step: int = 0) -> None:
        self._recording = recording
        self._recorded = recording.count(schema.TRAIN_STEP)
        config = from_mapping(recording.config)
        nearest = _snapshot_before(recording, step)
        self._learner = Learner(config, recording.mdp, 0, [table.values for table in nearest])
        self.step = nearest[0].step
        """Training steps taken."""
        self.advance(step)

    @property
    def agents(self) -> tuple[str, ...]:
        """Whose tables they are."""
        return self._learner.agents

    @property
    def tables(self) -> list[NDArray[np.float64]]:
        """The tables as they are now, [states, actions] each: views that `advance` changes."""
        return [self._learner.table(i) for i in range(len(self.agents))]

    @property
    def greedy(self) -> NDArray[np.int32]:
        """The greedy action of each learner in each state now, [learners, states]; ties to the lowest."""
        return self._learner.tables.greedy

    def advance(self, step: int) -> None:
        """Replay up to a step.

        Raises:
            RecordingError: it is behind, or not recorded.
        """
        for block in self._blocks(step):
            kernel.replay(*self._state, block.view(np.recarray), _NO_ROWS)
        self.step = step

    def rewind(self, step: int, tables: list[NDArray[np.float64]]) -> None:
        """Go back to a step at which the tables were these."""
        self._learner.set_tables(tables)
        self.step = step

    def rows(self, stop: int) -> NDArray[np.float64]:
        """Replay up to a step, and return what the learners saw on the way.

        Returns:
            float64 [steps, learners, widest]: the values of each step's state before its update; nan
            beyond a learner's own actions.
        """
        model = self._learner.model
        seen = np.full((stop - self.step, len(model.width), max(model.width)), np.nan)
        at = 0
        for block in self._blocks(stop):
            kernel.replay(*self._state, block.view(np.recarray), seen[at : at + len(block)])
            at += len(block)
        self.step = stop
        return seen

    @property
    def _state(self) -> tuple[Any, ...]:
        return self._learner.model, self._learner.tables, self._learner.rules

    def _blocks(self, stop: int) -> Any:
        """Return the recorded steps from here up to `stop`."""
        if stop == self.step:
            return iter(())
        if stop < self.step:
            raise RecordingError(f"a replay at step {self.step} cannot go back to {stop}; begin another.")
        if stop > self._recorded:
            raise RecordingError(
                f"{self._recording.path}: found {self._recorded} training steps, expected at least {stop}"
                + ("." if self._recorded else "; `dualtaxi rerecord` records them.")
            )
        return self._recording.blocks(schema.TRAIN_STEP, self.step, stop)


def tables_at(recording: Recording, step: int) -> list[NDArray[np.float64]]:
    """Return the tables after `step` training steps, a float64 [states, actions] a learner.

    Raises:
        RecordingError: there is no such step, or the steps from the nearest snapshot are not recorded.
    """
    return TableReplay(recording, step).tables


def step_of_episode(recording: Recording, episode: int) -> int:
    """Return how many training steps were taken when `episode` episodes had ended.

    Raises:
        RecordingError: there are not so many.
    """
    ended = recording.count(schema.TRAIN_EPISODE)
    if not 0 <= episode <= ended:
        raise RecordingError(
            f"{recording.path}: found {ended} training episodes, expected at least {episode}."
        )
    return int(recording.episodes("train", episode - 1, episode)[0]["last_step"]) + 1 if episode else 0


@dataclass(frozen=True, eq=False)
class Changes:
    """When the values of one state were last changed, up to some step."""

    visits: NDArray[np.int64]
    """[J]: how often each joint action was taken there."""
    last_step: NDArray[np.int64]
    """[J]: the step that last took it; -1 for never."""


def changes_of(recording: Recording, state: int, step: int) -> Changes:
    """Return how often, and when last, each joint action was taken in a state within `step` steps."""
    joint = recording.mdp.joint_actions
    visits, last = np.zeros(joint, np.int64), np.full(joint, -1, np.int64)
    for block in recording.blocks(schema.TRAIN_STEP, 0, step):
        here = block[block["state"] == state]
        visits += np.bincount(here["action"], minlength=joint)
        last[here["action"]] = here["step"]  # later steps overwrite earlier ones
    return Changes(visits, last)


def _snapshot_before(recording: Recording, step: int) -> list[QTable]:
    """Return the tables of the last complete snapshot at or before a step."""
    learners = int(recording.run["learners"])
    nearest: list[QTable] = []
    group: list[QTable] = []
    for snapshot in recording.snapshots():
        if snapshot.step > step:
            break
        group = [*group, snapshot] if group and group[0].step == snapshot.step else [snapshot]
        if len(group) == learners:
            nearest = group
    if not nearest:
        raise RecordingError(f"{recording.path}: has no Q-table at or before step {step}.")
    return nearest
