"""Sweeps: many runs of one experiment with different values, from a grid, at random or by a search.

model    a sweep file: parameters, strategies, objective, limits; reading it, with located errors
task     one run, as a worker does it; its readings of a metric, what it is worth, and pruning
workers  processes of this machine or actors of Ray, which run tasks
state    a sweep on disk: its resolved file and its lock; progress follows from its runs
trials   the values to try next, by Optuna, and what is recorded of the trials
running  a sweep from its start to its end: what it will take, and the loop over batches of runs
results  ranking, importance, the best configuration
charts   charts of the trials, one sheet with all of them, and the sweep as a page

This module loads nothing heavy, so that commands can look for sweeps first.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

FOLDER: Final = ".sweeps"
FILE: Final = "sweep.yaml"


def tag_of(name: str) -> str:
    """Return the tag of a sweep's runs."""
    return f"sweep={name}"


def folder_of(name: str, recordings: Path) -> Path:
    """Return the folder of a sweep; it need not exist."""
    return recordings / FOLDER / name


def sweeps_in(recordings: Path) -> list[str]:
    """Return the names of the sweeps in a recordings folder."""
    return sorted(file.parent.name for file in (recordings / FOLDER).glob(f"*/{FILE}"))


def is_sweep(names: Sequence[str], recordings: Path) -> bool:
    """Return whether the only name is the name of a sweep, rather than of a run."""
    return len(names) == 1 and names[0] in sweeps_in(recordings)
