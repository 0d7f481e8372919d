"""The values of a job's quantities after each training step; `runner.debugging.expressions` names them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

import numpy as np

from runner.config import from_mapping
from runner.debugging.expressions import JOINT, TABLE_NAMES, Array, Columns, Quantity
from runner.errors import RecordingError, RunnerError
from runner.learning.learner import rules_of
from runner.learning.watching import Watch, WatchedValues, explorations
from runner.recording.reader import Recording
from runner.replay.tables import TableReplay
from runner.util.arrays import Flags, Ints, Records

MAX_CELLS: Final = 4_096
"""The most Q-values of an expression."""
MAX_PATH_STATES: Final = 1 << 24
"""The most states of all greedy paths of an expression."""
_VALUES_AT_ONCE: Final = 1 << 20


class JobColumns:
    """The values of quantities after training steps, in blocks of which only the changes are taken.

    `start` is the first training step; the tables are those before it.
    """

    def __init__(self, recording: Recording, quantities: list[Quantity], start: int) -> None:
        self._quantities = quantities
        self._mdp = recording.mdp
        config = from_mapping(recording.config)
        starts = sorted({0, *(branch.step for branch in config.branches)})
        self._segments = [(start, rules_of(config.from_step(start))) for start in starts]
        """The rules of the training, each from a step on."""
        several = len(recording.agents) > 1
        self._widths = list(self._mdp.action_counts) if several else [self._mdp.joint_actions]
        self._cells: dict[Quantity, slice] = {}
        self._greedy: dict[Quantity, list[int]] = {}
        self._paths = [quantity for quantity in quantities if quantity.name == "greedy_success"]
        names = {quantity.name for quantity in quantities}
        by_step = "epsilon" in names and (
            len(starts) > 1 or any(rules.epsilon[1] == 1.0 for _, rules in self._segments)
        )
        self._every_step = by_step or bool(names & {"step", "reward"})
        self._by_episode = bool(names & {"episode", "epsilon"})
        self._watch = self._new_watch()
        self._visits = {quantity: 0 for quantity in quantities if quantity.name == "visits"}
        if self._visits:
            self._count_visits(recording, start)
        self._replay = TableReplay(recording, start) if names & set(TABLE_NAMES) else None
        self._last = self._first()

    def _new_watch(self) -> Watch:
        offsets = [self._mdp.states * sum(self._widths[:i]) for i in range(len(self._widths))]
        cells: list[int] = []
        greedy: list[tuple[int, int]] = []
        states = np.zeros(self._mdp.states, np.bool_)
        for quantity in self._quantities:
            if quantity.name == "q":
                width = self._widths[quantity.learner]
                row = offsets[quantity.learner] + quantity.state * width
                own = range(row, row + width) if quantity.action < 0 else [row + quantity.action]
                self._cells[quantity] = slice(len(cells), len(cells) + len(own))
                cells += own
            elif quantity.name == "greedy":
                learners = range(len(self._widths)) if quantity.learner == JOINT else [quantity.learner]
                self._greedy[quantity] = [len(greedy) + k for k in range(len(learners))]
                greedy += [(i, quantity.state) for i in learners]
            if quantity.name in ("q", "greedy"):
                states[quantity.state] = True
        if len(cells) > MAX_CELLS or len(self._paths) * self._mdp.states > MAX_PATH_STATES:
            raise RunnerError(
                f"expression: needs {len(cells):,} Q-values and {len(self._paths)} greedy paths through "
                f"{self._mdp.states:,} states, expected at most {MAX_CELLS:,} values and {MAX_PATH_STATES:,} "
                "states on paths; ask for parts of it."
            )
        paths = len(self._paths), self._mdp.states
        return Watch(
            states=states,
            cells=np.array(cells, np.int64),
            greedy=np.array(greedy, np.int64).reshape(-1, 2),
            starts=np.array([quantity.state for quantity in self._paths], np.int64),
            success=np.uint32(self._mdp.success_mask),
            path=np.zeros(paths, np.int32),
            length=np.zeros(len(self._paths), np.int64),
            on_path=np.zeros(paths, np.bool_),
            succeeds=np.zeros(len(self._paths), np.bool_),
        )

    @property
    def last(self) -> Columns:
        """The values now, one row each; NaN for those of a step before the first step."""
        return self._last

    def take(self, block: Records, needed: int) -> Iterator[tuple[Ints, Columns]]:
        """Yield the steps after which quantities may have changed, as places in a block, and their values.

        The block has the training steps that follow. The values have a row more, before the others: those
        before the first of the steps. The place `needed` is included in any case; -1 for none.
        """
        width = max(len(self._watch.cells), 1)
        size = max(_VALUES_AT_ONCE // width, 1)
        for first in range(0, len(block), size):
            part = block[first : first + size]
            places, columns = self._part(part, needed - first)
            if len(places):
                whole = {key: np.concatenate([self._last[key], column]) for key, column in columns.items()}
                self._last = {key: column[-1:] for key, column in whole.items()}
                yield places + first, whole

    def _part(self, block: Records, needed: int) -> tuple[Ints, Columns]:
        changes = None if self._replay is None else self._replay.watch(block, self._watch)
        visits = {quantity: self._visited(quantity, block) for quantity in self._visits}
        may_change = np.full(len(block), self._every_step)
        for mask in visits.values():
            may_change |= mask
        if changes is not None:
            may_change[changes.row] = True
        if self._by_episode:
            may_change |= block["t"] == 0
        if 0 <= needed < len(block):
            may_change[needed] = True
        places = np.flatnonzero(may_change)
        columns: dict[Quantity, Array] = {}
        if len(places):
            columns = self._of_steps(block[places])
            if changes is not None:
                columns |= self._of_tables(changes, places)
        for quantity, mask in visits.items():
            if len(places):
                columns[quantity] = (self._visits[quantity] + np.cumsum(mask)[places]).astype(np.float64)
            self._visits[quantity] += int(np.count_nonzero(mask))
        return places, columns

    def _of_steps(self, steps: Records) -> dict[Quantity, Array]:
        columns: dict[Quantity, Array] = {}
        for quantity in self._quantities:
            if quantity.name in ("step", "episode"):
                columns[quantity] = steps[quantity.name].astype(np.float64)
            elif quantity.name == "reward":
                columns[quantity] = steps["rewards"][:, quantity.learner].astype(np.float64)
            elif quantity.name == "epsilon":
                columns[quantity] = np.empty(len(steps))
                for start, rules in self._segments:
                    own = steps[steps["step"] >= start]
                    numbers = (np.ascontiguousarray(own[name], np.int64) for name in ("episode", "step"))
                    columns[quantity][len(steps) - len(own) :] = explorations(rules, *numbers)
        return columns

    def _of_tables(self, changes: WatchedValues, places: Ints) -> dict[Quantity, Array]:
        """Return the values at places in a block, each that of the last change before or at it."""
        at = np.searchsorted(changes.row, places, side="right")
        values = self._table_values(changes)
        return {key: np.concatenate([self._last[key], value])[at] for key, value in values.items()}

    def _table_values(self, changes: WatchedValues) -> dict[Quantity, Array]:
        columns: dict[Quantity, Array] = {}
        for quantity, cells in self._cells.items():
            columns[quantity] = changes.q[:, cells] if quantity.action < 0 else changes.q[:, cells.start]
        for quantity, own in self._greedy.items():
            strides = [math.prod(self._widths[i + 1 :]) for i in range(len(own))] if len(own) > 1 else [1]
            columns[quantity] = (changes.greedy[:, own] * np.array(strides)).sum(axis=1).astype(np.float64)
        for p, quantity in enumerate(self._paths):
            columns[quantity] = changes.succeeds[:, p]
        return columns

    def _first(self) -> Columns:
        columns: dict[Quantity, Array] = {quantity: np.full(1, np.nan) for quantity in self._quantities}
        for quantity, visits in self._visits.items():
            columns[quantity] = np.full(1, float(visits))
        if self._replay is not None:
            columns |= self._table_values(self._replay.begin_watch(self._watch))
        return columns

    def _count_visits(self, recording: Recording, stop: int) -> None:
        expected = 0
        if stop:
            for block in recording.train.steps.blocks(0, stop):
                first = int(block["step"][0])
                check_lost(recording, expected, first)
                expected = first + len(block)
                for quantity in self._visits:
                    self._visits[quantity] += int(np.count_nonzero(self._visited(quantity, block)))
        check_lost(recording, expected, stop)

    def _visited(self, quantity: Quantity, steps: Records) -> Flags:
        mask = steps["state"] == quantity.state
        if quantity.action < 0:
            return np.asarray(mask)
        actions = steps["action"]
        if quantity.learner != JOINT and len(self._widths) > 1:
            own = self._mdp.own_actions[:, quantity.learner]
            actions = own[np.minimum(actions, len(own) - 1)]
        return np.asarray(mask & (actions == quantity.action))


def check_lost(recording: Recording, expected: int, found: int) -> None:
    """Refuse training steps of which some were lost before the step that was found.

    Raises:
        RecordingError: another step was expected.
    """
    if found != expected:
        raise RecordingError(
            f"{recording.path}: training steps {expected:,} to {found - 1:,} were lost, so what holds after "
            "them is unknown; search up to the step before, or from one after the next Q-table, without "
            "visits."
        )
