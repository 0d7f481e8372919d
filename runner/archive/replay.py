"""Snapshots as the recorded steps make them: by this an archive leaves them out, and they are made again."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from runner.analysis.tables import check_steps
from runner.config import from_mapping
from runner.learning import kernel
from runner.learning.learner import Learner, held_of
from runner.mdp import Mdp

_NO_ROWS = np.empty((0, 0, 0))


class Tables:
    """The tables of a run, moved forward by its steps as they come.

    Args:
        config: the run's, as its recording holds it.
        mdp: its environment.
        seed: its job's.
        where: named in errors.
    """

    def __init__(self, config: Mapping[str, Any], mdp: Mdp, seed: int, where: str) -> None:
        self._mdp = mdp
        self._where = where
        self._learner = Learner(from_mapping(config), mdp, seed)
        self._given: set[int] = set()
        self._follow = True
        """Whether the tables are the run's own: no step is missing since it began or they were given."""
        self.step = 0
        """Training steps taken."""

    def take(self, steps: NDArray[np.void]) -> None:
        """Take the next training steps.

        Raises:
            RecordingError: the environment cannot have them.
        """
        if not len(steps):
            return
        self._follow &= int(steps["step"][0]) == self.step
        if self._follow:
            check_steps(steps, self._mdp, self._where)
            learner = self._learner
            rows = steps.view(np.recarray)
            kernel.replay(learner.seed, learner.model, learner.tables, learner.rules, rows, _NO_ROWS)
        self.step = int(steps["step"][-1]) + 1
        self._given.clear()

    def at(self, step: int, table: int) -> NDArray[np.float64] | None:
        """Return a table after so many training steps if the steps taken tell it: a view."""
        tables = self._learner.snapshot()
        known = self._follow and step == self.step and 0 <= table < len(tables)
        return tables[table] if known else None

    def give(self, step: int, table: int, values: NDArray[np.float64]) -> None:
        """Say what a table is; once all are said after as many steps, they are followed from there."""
        tables = self._learner.snapshot()
        if not 0 <= table < len(tables) or tables[table].shape != values.shape:
            return  # kept, but not to be followed from
        if step != self.step:
            self.step, self._follow = step, False
            self._given.clear()
        self._given.add(table)
        self._follow |= len(self._given) == len(tables)
        tables[table] = values
        self._learner.set_held(held_of(tables, self._learner.kinds))


class Snapshot(Protocol):
    """A table at a step."""

    @property
    def step(self) -> int:
        """Training steps taken."""


S = TypeVar("S", bound=Snapshot)


class Meetings(Generic[S]):
    """Meets the snapshots of a run on the way along its training steps.

    Args:
        tables: moved forward by the steps.
        snapshots: in order.
        meet: called with each when the steps before it were taken, as far as there are any.
    """

    def __init__(self, tables: Tables, snapshots: Iterator[S], meet: Callable[[S], None]) -> None:
        self._tables = tables
        self._snapshots = snapshots
        self._meet = meet
        self._next = next(snapshots, None)

    def take(self, steps: NDArray[np.void]) -> None:
        """Take the next training steps."""
        while self._next is not None and self._next.step <= int(steps["step"][-1]):
            before = int(np.searchsorted(steps["step"], self._next.step))
            self._tables.take(steps[:before])
            self._pass()
            steps = steps[before:]
        self._tables.take(steps)

    def finish(self) -> None:
        """Meet those that are left."""
        while self._next is not None:
            self._pass()

    def _pass(self) -> None:
        assert self._next is not None
        self._meet(self._next)
        self._next = next(self._snapshots, None)
