"""Q-tables at any step: the nearest snapshot before it, moved forward by the recorded steps.

    with runner.open_recording(path) as recording:
        tables = tables_at(recording, step=1_000_000)      # one float64 [states, actions] per learner

Every replay of recorded steps goes through `StepReplay`. It checks the steps first, because the compiled
kernel indexes its arrays by what they say, without any check of its own.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, Final, Generic, NamedTuple, TypeVar

import numpy as np

from runner.config import from_mapping
from runner.environments.mdp import Mdp
from runner.errors import NotInRecording, RecordingError
from runner.learning import kernel
from runner.learning.kernel import StateProbe
from runner.learning.learner import Learner, NamedTables, kinds_of, name_tables
from runner.learning.ledger import UNKNOWN_OUTCOME, UPDATE
from runner.learning.watching import Watch, WatchedValues, begin, empty_changes, joined, replay_watched
from runner.recording import schema
from runner.recording.messages import QTable
from runner.recording.reader import Recording
from runner.util.arrays import Array, Flags, Floats, Ints, Records
from runner.util.values import JsonView

S = TypeVar("S")

# --- steps, replayed ------------------------------------------------------------------------------------

NO_ROWS: Final = np.empty((0, 0, 0))
NO_PROBE: Final = StateProbe(
    np.empty(0, np.int64),
    np.empty((0, 0), np.int32),
    np.empty((0, 0, 0), np.float32),
    np.empty((0, 0, 0), np.int32),
)


class Trace(NamedTuple):
    """What decides the weights of one learner's updates, see `learning.ledger`."""

    updates: Records
    """[steps] of `UPDATE`: filled."""
    learner: int


NO_TRACE: Final = Trace(np.empty(0, UPDATE), 0)


class StepReplay:
    """The tables of a run's learners, moved forward by its training steps in order.

    Args:
        config: the run's resolved configuration, as its recording holds it.
    """

    def __init__(self, config: JsonView, mdp: Mdp, seed: int, where: str) -> None:
        self._mdp = mdp
        self._where = where
        self.learner = Learner(from_mapping(config), mdp, seed)
        """The learner with the tables at `step`."""
        self.step = 0
        """Training steps that the tables have learned from."""
        self._remembered = 0
        """The step up to which the learners remember the episode."""

    @property
    def agents(self) -> tuple[str, ...]:
        """The names of the learners."""
        return self.learner.agents

    @property
    def tables(self) -> list[Floats]:
        """The Q-tables at `step`, [states, actions] per learner: views that `apply` changes."""
        return [self.learner.table(i) for i in range(len(self.agents))]

    @property
    def greedy(self) -> Array:
        """The greedy actions at `step`, int32 [learners, states]: the lowest of the best ones."""
        return self.learner.tables.greedy

    @property
    def named_tables(self) -> list[NamedTables]:
        """All tables of each learner at `step`, by name: views that `apply` changes; `q` is its Q-table."""
        return [self.learner.named_tables(i) for i in range(len(self.agents))]

    def rewind(self, step: int, tables: list[NamedTables]) -> None:
        """Set all tables to the tables of a step."""
        self.learner.set_tables(tables)
        self.step = step

    def empty_rows(self, count: int) -> Floats:
        """Return an array for the values seen in `count` steps: nan, [count, learners, most actions]."""
        widths = self.learner.model.width
        return np.full((count, len(widths), max(widths)), np.nan)

    def apply(
        self,
        steps: Records,
        rows: Floats = NO_ROWS,
        probe: StateProbe = NO_PROBE,
        trace: Trace = NO_TRACE,
    ) -> None:
        """Apply the updates of the training steps that follow.

        Args:
            steps: a block of records; the first is step number `self.step`.
            rows: filled with each learner's values of a step's state before its update, [steps, learners,
                most actions]; empty if they are not needed.
            probe: states to look at on the way.
            trace: filled with what decides the weights of the updates.
        """
        _check_probe(probe, self._mdp)
        for segment, part in self._segments(steps):
            probed = probe.between(part.start, part.stop)
            kernel.replay(*segment, rows[part], trace.updates[part], trace.learner, probed)

    def begin_watch(self, watch: Watch) -> WatchedValues:
        """Follow the greedy paths of `watch`, and return the watched values as they are now, as one row."""
        changes = empty_changes(watch, 1)
        begin(self.learner.model, self.learner.tables, watch, changes)
        return changes

    def watch(self, steps: Records, watch: Watch) -> WatchedValues:
        """Apply updates as `apply` does, and return the watched values after each that could change them.

        Args:
            watch: `begin_watch` was called with it at `step`, or this method for the steps before.
        """
        parts = [(empty_changes(watch, 0), 0)]
        for segment, part in self._segments(steps):
            changes = empty_changes(watch, part.stop - part.start)
            filled = replay_watched(*segment, watch, changes)
            changes.row[:filled] += part.start
            parts.append((changes, filled))
        return joined(parts)

    def _segments(self, steps: Records) -> Iterator[tuple[tuple[Any, ...], slice]]:
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
        self._mdp.check_steps(steps, self._where)
        if self.learner.algorithm.remember and self._remembered != self.step and (t := int(steps["t"][0])):
            self._recall(t)
        records = steps.view(np.recarray)
        records.flags.writeable = False  # as a file's are: the kernel is compiled once
        at = 0
        while at < len(steps):
            segment = self.learner.segment_at(self.step)
            stop = min(len(steps), at + segment.stop - self.step)
            learner = self.learner
            part = slice(at, stop)
            yield (learner.seed, learner.model, learner.tables, segment.rules, records[part]), part
            self.step += stop - at
            self._remembered = self.step
            at = stop

    def recall(self, blocks: Iterable[Records], first: int) -> None:
        """Remember the training steps of the current episode before `step`, of which `first` is the first.

        The tables stay as they are.
        """
        stop = self.step
        self.step = self._remembered = first
        for block in blocks:
            for segment, _ in self._segments(block):
                kernel.recall(*segment)
        if self.step < stop:
            raise self._lost(stop)

    def _recall(self, t: int) -> None:
        """Remember the `t` steps of the current episode before `step`; here they are not known any more."""
        raise RecordingError(
            f"{self._where}: training steps {self.step - t} to {self.step - 1} were lost, from which their "
            "episode went on learning; the Q-tables are known again from the next snapshot after it."
        )

    def values_in(self, states: Array) -> Floats:
        """Return each learner's values in these states now, [states, learners, most actions]."""
        rows = self.empty_rows(len(states))
        for i, table in enumerate(self.tables):
            rows[:, i, : table.shape[1]] = table[states]
        return rows

    def read(self, probe: StateProbe) -> None:
        """Fill a probe with the values and greedy actions as they are now, for all of its rows."""
        _check_probe(probe, self._mdp)
        for k in range(len(probe.states)):
            kernel.read_states(self.learner.tables, probe.states[k], probe.value[k], probe.greedy[k])

    def _lost(self, next_step: int) -> RecordingError:
        return RecordingError(
            f"{self._where}: training steps {self.step} to {next_step - 1} were lost, so the Q-tables after "
            "them are unknown until the next snapshot; `dualtaxi resume` retrains the run."
        )


def _check_probe(probe: StateProbe, mdp: Mdp) -> None:
    """Refuse states that the tables do not have: compiled code would read outside of them."""
    if probe.states.size and not -1 <= probe.states.min() <= probe.states.max() < mdp.states:
        raise IndexError(f"found states up to {probe.states.max()}, expected less than {mdp.states}.")


# --- snapshots that follow from the steps -------------------------------------------------------------


class DerivedTables(Generic[S]):
    """The tables of a run as far as its steps determine them, updated by the steps as they come.

    Snapshots that follow from the steps are left out of an archive, and a restore derives them.

    Args:
        replay: at the run's first step.
        snapshots: each with the number of training steps before it.
        visit: called with these tables and each snapshot, after the steps before it were applied.
    """

    def __init__(
        self,
        replay: StepReplay,
        snapshots: Iterator[tuple[int, S]],
        visit: Callable[[DerivedTables[S], S], None],
    ) -> None:
        self._replay = replay
        self._snapshots = snapshots
        self._visit = visit
        self._next = next(snapshots, None)
        self._given: set[int] = set()
        self._known = True
        """Whether the tables are the run's own: no step is missing since it began or they were given."""

    def take(self, steps: Records) -> None:
        """Take the next training steps."""
        while self._next is not None and self._next[0] <= int(steps["step"][-1]):
            before = int(np.searchsorted(steps["step"], self._next[0]))
            self._apply(steps[:before])
            self._visit_next()
            steps = steps[before:]
        self._apply(steps)

    def finish(self) -> None:
        """Visit the snapshots that are left."""
        while self._next is not None:
            self._visit_next()

    def at(self, step: int, table: int) -> Floats | None:
        """Return a table after `step` training steps, a view; None if the steps do not determine it."""
        tables = self._replay.learner.snapshot()
        is_here = self._known and step == self._replay.step and 0 <= table < len(tables)
        return tables[table] if is_here else None

    def give(self, step: int, table: int, values: Floats) -> None:
        """Set a table to its recorded values; once all tables of a step are set, they are known again."""
        replay = self._replay
        tables = replay.learner.snapshot()
        if not 0 <= table < len(tables) or tables[table].shape != values.shape:
            return  # it is archived as it is, but nothing can be derived from it
        if step != replay.step:
            replay.step = step
            self._known = False
            self._given.clear()
        self._given.add(table)
        self._known |= len(self._given) == len(tables)
        tables[table] = values
        replay.rewind(step, name_tables(tables, replay.learner.kinds))

    def _apply(self, steps: Records) -> None:
        if not len(steps):
            return
        first, last = int(steps["step"][0]), int(steps["step"][-1])
        self._known &= first == self._replay.step and last == first + len(steps) - 1
        if self._known:
            self._replay.apply(steps)
        self._replay.step = last + 1
        self._given.clear()

    def _visit_next(self) -> None:
        assert self._next is not None
        self._visit(self, self._next[1])
        self._next = next(self._snapshots, None)


# --- the replay ---------------------------------------------------------------------------------------

NEAR_STEPS: Final = 200_000
"""`TableReplay.seek` replays this many steps rather than load a snapshot on the way."""


class TableReplay(StepReplay):
    """The tables of a recorded run, moved forward by its recording."""

    def __init__(self, recording: Recording, step: int = 0) -> None:
        super().__init__(recording.config, recording.mdp, recording.seed or 0, str(recording.path))
        self._recording = recording
        self._recorded = recording.train.steps.count()
        self.rewind(*self._nearest(step))
        self.advance(step)

    def rows(self, stop: int) -> Floats:
        """Replay up to a step, and return the values that the learners saw on the way.

        Returns:
            float64 [steps, learners, most actions]: the values of each step's state before its update; nan
            beyond a learner's own actions.
        """
        seen = self.empty_rows(max(stop - self.step, 0))
        self.advance(stop, rows=seen)
        return seen

    def updates(self, stop: int, learner: int) -> Records:
        """Replay up to a step, and return what decides the weights of a learner's updates on the way.

        Returns:
            [steps] of `UPDATE`.

        Raises:
            RecordingError: the step is earlier, or not recorded; or the environment cannot have such steps.
        """
        trace = Trace(np.empty(max(stop - self.step, 0), UPDATE), learner)
        first = self.step
        self.advance(stop, trace=trace)
        unknown = np.flatnonzero(trace.updates["outcome"] == UNKNOWN_OUTCOME)
        if len(unknown):
            raise RecordingError(
                f"{self._recording.path}: training step {first + int(unknown[0])} leads where the "
                "environment does not, or has another reward; `dualtaxi verify` checks the whole recording."
            )
        return trace.updates

    def seek(self, step: int) -> None:
        """Go to any step, from here or from the nearest snapshot before it, whichever is shorter."""
        lost = self._recording.lost.get(schema.TRAIN_STEP.name, [])
        gap = any(start < step and stop > self.step for start, stop in lost)
        if gap or not self.step <= step <= self.step + NEAR_STEPS:
            nearest, tables = self._nearest(step)
            if not self.step <= step or nearest > self.step:
                self.rewind(nearest, tables)
        self.advance(step)

    def _nearest(self, step: int) -> tuple[int, list[NamedTables]]:
        """Return the last snapshot at or before a step, and its step."""
        nearest = _snapshot_before(self._recording, step, self.learner.kinds)
        if nearest is None:
            raise RecordingError(f"{self._recording.path}: has no Q-table at or before step {step}.")
        shapes, expected = (
            [table.shape for named in tables for table in named.values()]
            for tables in (nearest[1], self.named_tables)
        )
        if shapes != expected:
            raise RecordingError(f"{self._where}: found Q-tables of shape {shapes}, expected {expected}.")
        return nearest

    def advance(self, stop: int, rows: Floats = NO_ROWS, trace: Trace = NO_TRACE) -> None:
        """Replay up to a later step; `rows` and `trace` are filled as `apply` fills them.

        Raises:
            RecordingError: the step is earlier, or not recorded.
        """
        first = self.step
        for part in self.blocks(stop):
            filled = slice(self.step - first, self.step - first + len(part))
            self.apply(part, rows[filled], trace=Trace(trace.updates[filled], trace.learner))

    def blocks(self, stop: int) -> Iterator[Records]:
        """Yield the recorded steps from here to a later one; each block must be applied before the next.

        Raises:
            RecordingError: the step is earlier, or not recorded.
        """
        first = self.step
        if stop < first:
            raise RecordingError(f"a replay at step {first} cannot go back to {stop}; start another.")
        if stop > max(self._recorded, first):
            raise self._missing(stop)
        if stop > first:
            yield from self._recording.train.steps.blocks(first, stop)
        if self.step < stop:
            raise self._lost(stop)

    def _recall(self, t: int) -> None:
        first = max(self.step - t, 0)
        self.recall(self._recording.train.steps.blocks(first, self.step), first)

    def _missing(self, stop: int) -> RecordingError:
        recording = self._recording
        taken = recording.result.get("train_steps", stop) if recording.leaves_out_steps else self._recorded
        if not recording.leaves_out_steps or taken < stop:
            return NotInRecording(
                f"{recording.path}: found {taken:,} training steps, expected at least {stop:,}."
            )
        later = next((snapshot.step for snapshot in recording.snapshots() if snapshot.step >= stop), None)
        return RecordingError(
            f"{recording.path}: was recorded without steps (recording.steps: none), and this needs the first "
            f"{stop:,}; `dualtaxi rerecord` records them. The nearest Q-tables are those after {self.step:,}"
            + (f" and {later:,} steps." if later is not None else " steps.")
        )


def tables_at(recording: Recording, step: int) -> list[Floats]:
    """Return the tables after `step` training steps, one float64 [states, actions] per learner."""
    return TableReplay(recording, step).tables


def named_tables_at(recording: Recording, step: int) -> list[NamedTables]:
    """Return all tables of the learners after `step` training steps, by name; `q` are the Q-tables."""
    return TableReplay(recording, step).named_tables


def known_steps(recording: Recording) -> list[tuple[int, int]]:
    """Return the steps at which the tables are known, as ascending ranges (first, last) without overlap.

    They are known from each snapshot up to the first step that was lost in a repair, or not recorded.
    """
    lost = sorted((start, stop) for start, stop in recording.lost.get(schema.TRAIN_STEP.name, []))
    recorded = recording.train.steps.count()
    spans: list[tuple[int, int]] = []
    tables = len(recording.agents) * len(kinds_of(from_mapping(recording.config)))
    counts = Counter(snapshot.step for snapshot in recording.snapshots(0, tables))
    for first in sorted(step for step, count in counts.items() if count == tables):
        reach = next((start for start, stop in lost if stop > first), recorded)
        last = max(first, min(reach, recorded))
        if spans and first <= spans[-1][1] + 1:
            spans[-1] = spans[-1][0], max(spans[-1][1], last)
        else:
            spans.append((first, last))
    return spans


def are_within(spans: Sequence[tuple[int, int]], steps: Ints) -> Flags:
    """Return which steps are within ranges, as `known_steps` returns them."""
    edges = [edge for first, last in spans for edge in (first, last + 1)]
    is_inside: Flags = np.searchsorted(edges, steps, side="right") % 2 == 1
    return is_inside


def tables_before_training(recording: Recording) -> list[NamedTables] | None:
    """Return the learners' tables before training, from the first snapshot; None if that is missing."""
    nearest = _snapshot_before(recording, 0, kinds_of(from_mapping(recording.config)))
    return nearest and nearest[1]


def _snapshot_before(
    recording: Recording, step: int, kinds: tuple[str, ...]
) -> tuple[int, list[NamedTables]] | None:
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
    return nearest[0].step, name_tables([table.values for table in nearest], kinds)
