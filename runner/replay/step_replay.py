"""The tables of a run's learners, moved forward by its training steps.

Every replay of recorded steps goes through `StepReplay`. It checks the steps first, because the compiled
kernel indexes its arrays by what they say, without any check of its own. Snapshots that follow from the steps
are left out of an archive, and a restore derives them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any, Final, Generic, NamedTuple, TypeVar

import numpy as np

from runner.config import from_mapping
from runner.environments.mdp import Mdp
from runner.errors import RecordingError
from runner.learning import kernel
from runner.learning.kernel import StateProbe
from runner.learning.learner import Learner, NamedTables, name_tables
from runner.learning.ledger import UPDATE
from runner.learning.watching import Watch, WatchedValues, begin, empty_changes, joined, replay_watched
from runner.util.arrays import Array, Floats, Records
from runner.util.values import JsonView

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


S = TypeVar("S")


# --- snapshots that follow from the steps -------------------------------------------------------------


class DerivedTables(Generic[S]):
    """The tables of a run as far as its steps determine them, updated by the steps as they come.

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
