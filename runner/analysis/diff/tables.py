"""Differences of two runs' Q-tables at the steps of which both have a snapshot."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from runner.environments.mdp import Mdp
from runner.environments.naming import action_names, actions_in_words, states_in_words
from runner.errors import RecordingError
from runner.recording.messages import QTable
from runner.recording.reader import Recording
from runner.util.arrays import Floats, Ints

_MAX_CELLS: Final = 5
"""Cells with the largest differences that are listed."""


@dataclass(frozen=True)
class CellDiff:
    """One cell of a table, by the names of state and action, and its value in both runs."""

    state: str
    action: str
    a: float
    b: float


@dataclass(frozen=True)
class TableDiff:
    """Two runs' tables of one agent after the same number of training episodes."""

    episode: int
    agent: str
    largest: float
    mean: float
    """Mean of the absolute difference over all cells."""
    greedy_share: float
    """Share of the states in which the greedy action differs."""
    greedy_share_visited: float
    """The same, each state weighted by its visits in both runs' training; nan without steps."""
    cells: list[CellDiff]
    """Where the difference is largest."""


def table_diffs(a: Recording, b: Recording, visits: Ints | None) -> Iterator[TableDiff]:
    """Yield the differences of the tables, of the same shapes, that both runs have snapshots of.

    `visits` is how often each state was acted in, [S], both runs together.
    """
    weights = visits if visits is not None and visits.sum() else None
    for left, right in common_snapshots(a, b):
        apart = np.abs(left.values - right.values)
        other = left.values.argmax(axis=1) != right.values.argmax(axis=1)
        yield TableDiff(
            episode=left.episode,
            agent=left.agent,
            largest=float(apart.max()),
            mean=float(apart.mean()),
            greedy_share=float(other.mean()),
            greedy_share_visited=math.nan if weights is None else float(other @ weights / weights.sum()),
            cells=_largest_cells(a.mdp, left, right, apart),
        )


def common_snapshots(a: Recording, b: Recording) -> Iterator[tuple[QTable, QTable]]:
    """Yield the tables, of one shape, that both runs have after as many episodes."""
    theirs = b.snapshots()
    right = next(theirs, None)
    for left in a.snapshots():
        while right is not None and _moment(right) < _moment(left):
            right = next(theirs, None)
        if right is not None and _moment(right) == _moment(left) and right.values.shape == left.values.shape:
            states, actions = left.values.shape
            widths = {a.mdp.joint_actions, *a.mdp.action_counts}
            if states != a.mdp.states or actions not in widths:
                raise RecordingError(
                    f"{a.path}: found a Q-table of shape {left.values.shape}, expected {a.mdp.states} states "
                    f"and one of {sorted(widths)} actions."
                )
            yield left, right


def _moment(table: QTable) -> tuple[int, int]:
    return table.episode, table.table


def _largest_cells(mdp: Mdp, a: QTable, b: QTable, apart: Floats) -> list[CellDiff]:
    flat = apart.reshape(-1)
    # Faster than sorting all cells, for each snapshot.
    least = np.partition(flat, -_MAX_CELLS)[-_MAX_CELLS] if flat.size > _MAX_CELLS else 0.0
    candidates = np.flatnonzero(flat >= least)
    order = candidates[np.argsort(-flat[candidates], kind="stable")][:_MAX_CELLS]
    states = states_in_words(mdp)
    actions = own_actions_in_words(mdp, a.table, apart.shape[1])
    cells = []
    for cell in order.tolist():
        s, j = divmod(cell, apart.shape[1])
        if apart[s, j] > 0:
            cells.append(CellDiff(str(states[s]), actions[j], float(a.values[s, j]), float(b.values[s, j])))
    return cells


def own_actions_in_words(mdp: Mdp, table: int, width: int) -> list[str]:
    """Return the words of the columns of table number `table`: joint actions, or one agent's own."""
    if width == mdp.joint_actions:
        return [str(words) for words in actions_in_words(mdp)]
    names = action_names(mdp)
    return names[table] if names else [f"action {j}" for j in range(width)]
