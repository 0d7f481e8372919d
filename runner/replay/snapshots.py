"""Snapshots that follow from the recorded steps: an archive omits them, and a restore derives them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

import numpy as np

from runner.learning.learner import name_tables
from runner.replay.step_replay import StepReplay
from runner.util.arrays import Floats, Records

S = TypeVar("S")


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
