"""Q-tables at any step: the nearest snapshot before it, moved forward by the recorded steps.

with runner.open_recording(path) as recording:
    tables = tables_at(recording, step=1_000_000)      # one float64 [states, actions] per learner

Every replay of recorded steps goes through `StepReplay.apply`. It checks the steps first, because the
compiled kernel indexes its arrays by what they say, without any check of its own.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from runner.config import from_mapping
from runner.environments.mdp import Mdp
from runner.errors import RecordingError
from runner.learning import kernel
from runner.learning.learner import Held, Learner, held_of, kinds_of
from runner.learning.ledger import UNKNOWN_OUTCOME, UPDATE
from runner.learning.watching import Changes, Watch, begin, empty_changes, joined, replay_watched
from runner.recording import schema
from runner.recording.messages import QTable
from runner.recording.reader import Recording
from runner.replay.checkpoints import CHECKPOINT_STEPS, Checkpoints
from runner.replay.steps import check_steps
from runner.util.arrays import Array

NEAR_STEPS: Final = 200_000
"""`TableReplay.seek` replays this many steps rather than load a snapshot on the way."""
_NO_ROWS = np.empty((0, 0, 0))


class StateProbe(NamedTuple):
    """Values and greedy actions of some states, read before some of the steps of a block."""

    before: NDArray[np.int64]
    """[k]: rows of the block, ascending."""
    states: NDArray[np.int32]
    """[k, n]: the states that are read before each of these rows; -1 for none."""
    value: NDArray[np.float32]
    """[k, learners, n]: filled with the highest value of each state; nan for none."""
    greedy: NDArray[np.int32]
    """[k, learners, n]: filled with the greedy action in each state; -1 for none."""

    def between(self, start: int, stop: int) -> StateProbe:
        """Return the part of the probe for rows `start` to `stop` of the block, as a block of their own."""
        part = slice(*np.searchsorted(self.before, (start, stop)))
        return StateProbe(self.before[part] - start, self.states[part], self.value[part], self.greedy[part])


class Trace(NamedTuple):
    """What decides the weights of one learner's updates, see `learning.ledger`."""

    updates: NDArray[np.void]
    """[steps] of `UPDATE`: filled."""
    learner: int


class StepReplay:
    """The tables of a run's learners, moved forward by its training steps in order.

    Args:
        config: the run's resolved configuration, as its recording holds it.
        mdp: its environment.
        seed: the seed of its job.
        where: the recording or archive that the steps are from, for errors.
    """

    def __init__(self, config: Mapping[str, object], mdp: Mdp, seed: int, where: str) -> None:
        self._mdp = mdp
        self._where = where
        self._learner = Learner(from_mapping(config), mdp, seed)
        self.step = 0
        """Training steps that the tables have learned from."""

    @property
    def learner(self) -> Learner:
        """The learner with the tables at `step`."""
        return self._learner

    @property
    def agents(self) -> tuple[str, ...]:
        """The names of the learners."""
        return self._learner.agents

    @property
    def kinds(self) -> tuple[str, ...]:
        """The names of what each learner holds, in the order of a snapshot."""
        return self._learner.kinds

    @property
    def tables(self) -> list[NDArray[np.float64]]:
        """The Q-tables at `step`, [states, actions] per learner: views that `apply` changes."""
        return [self._learner.table(i) for i in range(len(self.agents))]

    @property
    def held(self) -> list[Held]:
        """All tables of each learner at `step`, by name: views that `apply` changes; `q` is its Q-table."""
        return [self._learner.held(i) for i in range(len(self.agents))]

    @property
    def own_actions(self) -> NDArray[np.int32]:
        """Each learner's part of a joint action, [joint actions, learners]."""
        return self._learner.model.own_action

    @property
    def greedy(self) -> NDArray[np.int32]:
        """The greedy actions at `step`, [learners, states]: the lowest of the best ones."""
        return self._learner.tables.greedy

    def snapshot(self) -> list[NDArray[np.float64]]:
        """Return all tables in the order of a snapshot, those of one kind together: views."""
        return self._learner.snapshot()

    def rewind(self, step: int, held: list[Held]) -> None:
        """Set all tables to those of a step."""
        self._learner.set_held(held)
        self.step = step

    def empty_rows(self, count: int) -> NDArray[np.float64]:
        """Return an array for the values seen in `count` steps: nan, [count, learners, most actions]."""
        widths = self._learner.model.width
        return np.full((count, len(widths), max(widths)), np.nan)

    def apply(
        self,
        steps: NDArray[np.void],
        rows: NDArray[np.float64] = _NO_ROWS,
        probe: StateProbe | None = None,
        trace: Trace | None = None,
    ) -> None:
        """Apply the updates of the training steps that follow.

        Args:
            steps: a block of records; the first is step number `self.step`.
            rows: filled with each learner's values of a step's state before its update, [steps, learners,
                most actions]; empty if they are not needed.
            probe: states to look at on the way.
            trace: filled with what decides the weights of the updates; not together with `probe`.

        Raises:
            RecordingError: steps are missing, or the environment cannot have such steps.
        """
        if probe is not None:
            _check_probe(probe, self._mdp)
        for state, part in self._segments(steps):
            records = steps[part].view(np.recarray)
            if trace is not None:
                kernel.replay(*state, records, rows[part], trace.updates[part], trace.learner)
            elif probe is None:
                kernel.replay(*state, records, rows[part])
            else:
                kernel.replay_probed(*state, records, rows[part], *probe.between(part.start, part.stop))

    def begin_watch(self, watch: Watch) -> Changes:
        """Follow the greedy paths of `watch`, and return the watched values as they are now, as one row."""
        changes = empty_changes(watch, 1)
        begin(self._learner.model, self._learner.tables, watch, changes)
        return changes

    def watch(self, steps: NDArray[np.void], watch: Watch) -> Changes:
        """Apply updates as `apply` does, and return the watched values after each that could change them.

        Args:
            steps: as for `apply`.
            watch: `begin_watch` was called with it at `step`, or this method for the steps before.
        """
        found = [(empty_changes(watch, 0), 0)]
        for state, part in self._segments(steps):
            changes = empty_changes(watch, part.stop - part.start)
            filled = replay_watched(*state, steps[part].view(np.recarray), _NO_ROWS, watch, changes)
            changes.row[:filled] += part.start
            found.append((changes, filled))
        return joined(found)

    def _segments(self, steps: NDArray[np.void]) -> Iterator[tuple[tuple[Any, ...], slice]]:
        """Yield the kernel's arguments for the parts of a block in order, and move forward after each."""
        if not len(steps):
            return
        first, last = int(steps["step"][0]), int(steps["step"][-1])
        if first > self.step:
            raise self._lost(first)
        if first < self.step or last != first + len(steps) - 1:
            raise RecordingError(
                f"{self._where}: found training steps {first} to {last} in a block of {len(steps)}, expected "
                f"those from {self.step} on; `dualtaxi verify` checks the whole recording."
            )
        check_steps(steps, self._mdp, self._where)
        at = 0
        while at < len(steps):
            segment = self._learner.segment_at(self.step)
            stop = min(len(steps), at + segment.stop - self.step)
            state = (self._learner.seed, self._learner.model, self._learner.tables, segment.rules)
            yield state, slice(at, stop)
            self.step += stop - at
            at = stop

    def values_in(self, states: Array) -> NDArray[np.float64]:
        """Return each learner's values in these states now, [states, learners, most actions]."""
        rows = self.empty_rows(len(states))
        for i, table in enumerate(self.tables):
            rows[:, i, : table.shape[1]] = table[states]
        return rows

    def read(self, probe: StateProbe) -> None:
        """Fill a probe with the values and greedy actions as they are now, for all of its rows."""
        _check_probe(probe, self._mdp)
        for k in range(len(probe.states)):
            kernel.read_states(self._learner.tables, probe.states[k], probe.value[k], probe.greedy[k])

    def _lost(self, found: int) -> RecordingError:
        return RecordingError(
            f"{self._where}: training steps {self.step} to {found - 1} were lost, so the Q-tables after them "
            "are unknown until the next snapshot; `dualtaxi resume` trains the run again."
        )


class TableReplay(StepReplay):
    """The tables of a recorded run, moved forward by its recording.

    Args:
        recording: the run.
        step: the training step to begin at.

    Raises:
        RecordingError: there is no such step, or the steps from the nearest snapshot are not recorded.
    """

    def __init__(self, recording: Recording, step: int = 0) -> None:
        super().__init__(recording.config, recording.mdp, recording.seed or 0, str(recording.path))
        self._recording = recording
        self._recorded = recording.count(schema.TRAIN_STEP)
        self._checkpoints = Checkpoints(recording)
        self._origin: int | None = None
        """The step from which the recording alone moved the tables; None if they were set by hand."""
        self._load(*self._nearest(step))
        self.advance(step)

    def advance(self, step: int) -> None:
        """Replay up to a later step.

        Raises:
            RecordingError: the step is earlier, or not recorded.
        """
        self._advance(step)

    def rows(self, stop: int) -> NDArray[np.float64]:
        """Replay up to a step, and return the values that the learners saw on the way.

        Returns:
            float64 [steps, learners, most actions]: the values of each step's state before its update; nan
            beyond a learner's own actions.

        Raises:
            RecordingError: the step is earlier, or not recorded.
        """
        seen = self.empty_rows(max(stop - self.step, 0))
        self._advance(stop, rows=seen)
        return seen

    def updates(self, stop: int, learner: int) -> NDArray[np.void]:
        """Replay up to a step, and return what decides the weights of a learner's updates on the way.

        Returns:
            [steps] of `UPDATE`.

        Raises:
            RecordingError: the step is earlier, or not recorded; or the environment cannot have such steps.
        """
        trace = Trace(np.empty(max(stop - self.step, 0), UPDATE), learner)
        first = self.step
        self._advance(stop, trace=trace)
        unknown = np.flatnonzero(trace.updates["outcome"] == UNKNOWN_OUTCOME)
        if len(unknown):
            raise RecordingError(
                f"{self._recording.path}: training step {first + int(unknown[0])} leads where the "
                "environment does not, or has another reward; `dualtaxi verify` checks the whole recording."
            )
        return trace.updates

    def seek(self, step: int) -> None:
        """Go to any step, from here or from the nearest snapshot before it, whichever is shorter.

        Raises:
            RecordingError: there is no such step, or the steps from the nearest snapshot are not recorded.
        """
        lost = self._recording.lost.get(schema.TRAIN_STEP.name, [])
        gap = any(start < step and stop > self.step for start, stop in lost)
        if gap or not self.step <= step <= self.step + NEAR_STEPS:
            nearest, held = self._nearest(step)
            if not self.step <= step or nearest > self.step:
                self._load(nearest, held)
        self.advance(step)

    def rewind(self, step: int, held: list[Held]) -> None:
        """Set all tables to those of a step; from there on no checkpoints are saved."""
        super().rewind(step, held)
        self._origin = None

    def _load(self, step: int, held: list[Held]) -> None:
        super().rewind(step, held)
        self._origin = step

    def _nearest(self, step: int) -> tuple[int, list[Held]]:
        """Return the last snapshot at or before a step, or a checkpoint between them; and its step."""
        nearest = _snapshot_before(self._recording, step, self.kinds)
        if nearest is None:
            raise RecordingError(f"{self._recording.path}: has no Q-table at or before step {step}.")
        _check_shapes(self._recording, nearest[1], self.held)
        if step - nearest[0] <= CHECKPOINT_STEPS:
            return nearest
        at, tables = self._checkpoints.nearest(step, [table.shape for table in self.snapshot()])
        return (at, held_of(tables, self.kinds)) if at > nearest[0] else nearest

    def _advance(self, stop: int, rows: NDArray[np.float64] = _NO_ROWS, trace: Trace | None = None) -> None:
        first = self.step
        if stop < first:
            raise RecordingError(f"a replay at step {first} cannot go back to {stop}; start another.")
        if stop > max(self._recorded, first):
            raise self._missing(stop)
        for block in self._recording.blocks(schema.TRAIN_STEP, first, stop) if stop > first else ():
            for part in np.split(block, [-self.step % CHECKPOINT_STEPS] if len(block) else []):
                at = slice(self.step - first, self.step - first + len(part))
                own = None if trace is None else Trace(trace.updates[at], trace.learner)
                self.apply(part, rows[at], trace=own)
                self._keep_checkpoint()
        self._checkpoints.prune()
        if self.step < stop:
            raise self._lost(stop)

    def _keep_checkpoint(self) -> None:
        """Keep the tables for later replays where no snapshot is near before them."""
        if self._origin is None or self.step % CHECKPOINT_STEPS or self.step == self._origin:
            return
        if self.step - self._origin >= CHECKPOINT_STEPS:
            self._checkpoints.save(self.step, self.snapshot())

    def _missing(self, stop: int) -> RecordingError:
        recording = self._recording
        taken = recording.result.get("train_steps", stop) if recording.leaves_out_steps else self._recorded
        if not recording.leaves_out_steps or taken < stop:
            return RecordingError(
                f"{recording.path}: found {taken} training steps, expected at least {stop}."
            )
        later = next((snapshot.step for snapshot in recording.snapshots() if snapshot.step >= stop), None)
        return RecordingError(
            f"{recording.path}: was recorded without steps (recording.steps: none), and this needs the first "
            f"{stop:,}; `dualtaxi rerecord` records them. The nearest Q-tables are those after {self.step:,}"
            + (f" and {later:,} steps." if later is not None else " steps.")
        )


def _check_probe(probe: StateProbe, mdp: Mdp) -> None:
    """Refuse states that the tables do not have: compiled code would read outside of them."""
    if probe.states.size and not -1 <= probe.states.min() <= probe.states.max() < mdp.states:
        raise IndexError(f"found states up to {probe.states.max()}, expected less than {mdp.states}.")


def tables_at(recording: Recording, step: int) -> list[NDArray[np.float64]]:
    """Return the tables after `step` training steps, one float64 [states, actions] per learner.

    Raises:
        RecordingError: there is no such step, or the steps from the nearest snapshot are not recorded.
    """
    return TableReplay(recording, step).tables


def held_at(recording: Recording, step: int) -> list[Held]:
    """Return all tables of the learners after `step` training steps, by name; `q` are the Q-tables.

    Raises:
        RecordingError: as for `tables_at`.
    """
    return TableReplay(recording, step).held


def known_steps(recording: Recording) -> list[tuple[int, int]]:
    """Return the steps at which the tables are known, as ascending ranges (first, last) without overlap.

    They are known from each snapshot up to the first step that was lost in a repair, or not recorded.
    """
    lost = sorted((start, stop) for start, stop in recording.lost.get(schema.TRAIN_STEP.name, []))
    recorded = recording.count(schema.TRAIN_STEP)
    found: list[tuple[int, int]] = []
    for first in _snapshot_steps(recording):
        reach = next((start for start, stop in lost if stop > first), recorded)
        last = max(first, min(reach, recorded))
        if found and first <= found[-1][1] + 1:
            found[-1] = found[-1][0], max(found[-1][1], last)
        else:
            found.append((first, last))
    return found


def initially_held(recording: Recording) -> list[Held] | None:
    """Return the learners' tables before training, from the first snapshot; None if that is missing."""
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
    tables = len(recording.agents) * len(kinds)
    nearest: list[QTable] = []
    group: list[QTable] = []
    for snapshot in recording.snapshots(step, tables):
        if snapshot.step > step:
            break
        group = [*group, snapshot] if group and group[0].step == snapshot.step else [snapshot]
        if len(group) == tables:
            nearest = group
    if not nearest:
        return None
    return nearest[0].step, held_of([table.values for table in nearest], kinds)


def _snapshot_steps(recording: Recording) -> list[int]:
    """Return the steps of the complete snapshots, ascending."""
    tables = len(recording.agents) * len(kinds_of(from_mapping(recording.config)))
    counts: dict[int, int] = {}
    for snapshot in recording.snapshots(0, tables):
        counts[snapshot.step] = counts.get(snapshot.step, 0) + 1
    return sorted(step for step, count in counts.items() if count == tables)
