"""Any Q-table at any step: the nearest snapshot before it, and the recorded steps from there on replayed.

with runner.recording.open(path) as recording:
    tables = tables_at(recording, step=1_000_000)      # a float64 [states, actions] a learner
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runner.config import from_mapping
from runner.errors import RecordingError
from runner.learning import kernel
from runner.learning.learner import Held, Learner, held_of, kinds_of
from runner.mdp import Mdp
from runner.recording import schema
from runner.recording.messages import QTable
from runner.recording.reader import Recording

_NO_ROWS = np.empty((0, 0, 0))
_STEPS_AT_ONCE = 65_536


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
        self._learner = Learner(from_mapping(recording.config), recording.mdp, int(recording.run["seed"]))
        nearest = _snapshot_before(recording, step, self._learner.kinds)
        if nearest is None:
            raise RecordingError(f"{recording.path}: has no Q-table at or before step {step}.")
        self.step, held = nearest
        _check_shapes(recording, held, self.held)
        self._learner.set_held(held)
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
    def held(self) -> list[Held]:
        """All that the learners hold now, by name: views that `advance` changes; `q` is in `tables`."""
        return [self._learner.held(i) for i in range(len(self.agents))]

    @property
    def own_actions(self) -> NDArray[np.int32]:
        """Each learner's part of a joint action, [joint actions, learners]."""
        return self._learner.model.own_action

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

    def rewind(self, step: int, held: list[Held]) -> None:
        """Go back to a step at which the learners held this."""
        self._learner.set_held(held)
        self.step = step

    def rows(self, stop: int) -> NDArray[np.float64]:
        """Replay up to a step, and return what the learners saw on the way.

        Returns:
            float64 [steps, learners, widest]: the values of each step's state before its update; nan
            beyond a learner's own actions.
        """
        width, first = self._learner.model.width, self.step
        seen = np.full((max(stop - first, 0), len(width), max(width)), np.nan)
        for block in self._blocks(stop):
            at = self.step - first
            kernel.replay(*self._state, block.view(np.recarray), seen[at : at + len(block)])
        return seen

    @property
    def _state(self) -> tuple[Any, ...]:
        return self._learner.seed, self._learner.model, self._learner.tables, self._learner.rules

    def _blocks(self, stop: int) -> Iterator[NDArray[np.void]]:
        """Yield the recorded steps from here up to `stop`, all of them; each block moves `step` on."""
        if stop < self.step:
            raise RecordingError(f"a replay at step {self.step} cannot go back to {stop}; begin another.")
        if stop > max(self._recorded, self.step):
            raise self._missing(stop)
        for block in self._recording.blocks(schema.TRAIN_STEP, self.step, stop) if stop > self.step else ():
            if int(block["step"][0]) != self.step:
                raise self._lost(int(block["step"][0]))
            check_steps(block, self._recording.mdp, str(self._recording.path))
            yield block
            self.step += len(block)
        if self.step < stop:
            raise self._lost(stop)

    def _missing(self, stop: int) -> RecordingError:
        recording = self._recording
        kept = recording.config["recording"]["steps"] == "all"
        taken = self._recorded if kept else recording.result.get("train_steps", stop)
        if kept or taken < stop:
            return RecordingError(
                f"{recording.path}: found {taken} training steps, expected at least {stop}."
            )
        behind = next((snapshot.step for snapshot in recording.snapshots() if snapshot.step >= stop), None)
        return RecordingError(
            f"{recording.path}: was recorded without steps (recording.steps: none), and this takes the first "
            f"{stop:,}; `dualtaxi rerecord` records them. The nearest Q-tables are those after {self.step:,}"
            + (f" and {behind:,} steps." if behind is not None else " steps.")
        )

    def _lost(self, found: int) -> RecordingError:
        return RecordingError(
            f"{self._recording.path}: training steps {self.step} to {found - 1} were lost, so the tables "
            "behind them cannot be had; `dualtaxi resume` does the run anew."
        )


def check_steps(block: NDArray[np.void], mdp: Mdp, where: str) -> None:
    """Refuse steps that the environment cannot have: the kernel, which replays them, believes them.

    Raises:
        RecordingError: there is such a step; `where` is named.
    """
    bounds = {"state": mdp.states, "next_state": mdp.states, "action": mdp.joint_actions}
    for name, bound in bounds.items():
        if (found := int(block[name].max())) >= bound:
            raise RecordingError(
                f"{where}: found {name} {found} in training step {int(block['step'][0])} or the "
                f"{len(block)} after it, expected less than {bound}; `dualtaxi verify` names the step."
            )


def tables_at(recording: Recording, step: int) -> list[NDArray[np.float64]]:
    """Return the tables after `step` training steps, a float64 [states, actions] a learner.

    Raises:
        RecordingError: there is no such step, or the steps from the nearest snapshot are not recorded.
    """
    return TableReplay(recording, step).tables


def held_at(recording: Recording, step: int) -> list[Held]:
    """Return all that the learners held after `step` training steps, by name; `q` are the tables.

    Raises:
        RecordingError: as of `tables_at`.
    """
    return TableReplay(recording, step).held


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
    if episode == 0:
        return 0
    record = recording.episodes("train", episode - 1, episode)
    if not len(record):
        raise RecordingError(f"{recording.path}: training episode {episode - 1} was lost.")
    return int(record[0]["last_step"]) + 1


def last_step(recording: Recording) -> int:
    """Return the last training step at which the tables can be had."""
    snapshots = max((snapshot.step for snapshot in recording.snapshots()), default=0)
    return max(snapshots, recording.count(schema.TRAIN_STEP))


@dataclass(frozen=True, eq=False)
class StateHistory:
    """How often a state was visited, and when its values last changed; arrays [learners, widest].

    An entry beyond a learner's own actions has no meaning.
    """

    visits: NDArray[np.int64]
    """How often the learner took the action there."""
    changed_step: NDArray[np.int64]
    """The step that last changed the value; -1 for never. An update by nothing changes nothing."""
    changed_episode: NDArray[np.int64]
    """The episode of that step."""


def history_of(recording: Recording, state: int, step: int) -> StateHistory:
    """Return what happened to a state's values within the first `step` training steps, by replaying them.

    Raises:
        RecordingError: the steps are not recorded.
    """
    replay = TableReplay(recording)
    shape = (len(replay.tables), max(table.shape[1] for table in replay.tables))
    history = StateHistory(np.zeros(shape, np.int64), np.full(shape, -1), np.full(shape, -1))
    pending = np.empty(0, recording.dtypes[schema.TRAIN_STEP]), np.empty((0, *shape))
    while replay.step < step:
        first, stop = replay.step, min(replay.step + _STEPS_AT_ONCE, step)
        rows = replay.rows(stop)
        steps = np.concatenate(list(recording.blocks(schema.TRAIN_STEP, first, stop)))
        here = steps["state"] == state
        _count(history.visits, replay.own_actions[steps["action"][here]])
        pending = _note_changes(
            history, np.concatenate([pending[0], steps[here]]), np.concatenate([pending[1], rows[here]])
        )
    last = np.full((1, *shape), np.nan)
    for i, table in enumerate(replay.tables):
        last[0, i, : table.shape[1]] = table[state]
    _note_changes(history, np.repeat(pending[0], 2), np.concatenate([pending[1], last[: len(pending[1])]]))
    return history


def _count(visits: NDArray[np.int64], own: NDArray[np.int32]) -> None:
    """Count own actions, [visits, learners]."""
    for i in range(len(visits)):
        visits[i] += np.bincount(own[:, i], minlength=visits.shape[1])


def _note_changes(
    history: StateHistory, steps: NDArray[np.void], rows: NDArray[np.float64]
) -> tuple[NDArray[np.void], NDArray[np.float64]]:
    """Note which visit last changed each value; return the last visit, of which only the next one tells.

    Args:
        history: where to note it.
        steps: the visits to the state, in order.
        rows: the state's values before each of them, [visits, learners, widest].
    """
    if len(rows) > 1:
        bits = rows.view(np.int64)
        changed = bits[1:] != bits[:-1]
        last = len(changed) - 1 - changed[::-1].argmax(axis=0)
        ever = changed.any(axis=0)
        history.changed_step[ever] = steps["step"][last[ever]]
        history.changed_episode[ever] = steps["episode"][last[ever]]
    return steps[-1:], rows[-1:]


def initially_held(recording: Recording) -> list[Held] | None:
    """Return what the learners held before training, by the first snapshot; None if that is missing."""
    nearest = _snapshot_before(recording, 0, kinds_of(from_mapping(recording.config)))
    return nearest and nearest[1]


def _check_shapes(recording: Recording, found: list[Held], expected: list[Held]) -> None:
    shapes = [[table.shape for one in held for table in one.values()] for held in (found, expected)]
    if shapes[0] != shapes[1]:
        raise RecordingError(f"{recording.path}: found Q-tables of shape {shapes[0]}, expected {shapes[1]}.")


def _snapshot_before(
    recording: Recording, step: int, kinds: tuple[str, ...]
) -> tuple[int, list[Held]] | None:
    """Return the last complete snapshot at or before a step, and its step; None if there is none."""
    learners = int(recording.run["learners"])
    nearest: list[QTable] = []
    group: list[QTable] = []
    for snapshot in recording.snapshots(step, learners * len(kinds)):
        if snapshot.step > step:
            break
        group = [*group, snapshot] if group and group[0].step == snapshot.step else [snapshot]
        if len(group) == learners * len(kinds):
            nearest = group
    if not nearest:
        return None
    return nearest[0].step, held_of([table.values for table in nearest], kinds)
