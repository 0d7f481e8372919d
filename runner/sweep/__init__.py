"""Sweeps: many runs of one experiment with different values, from a grid, at random or by a search.

parameters  the values to try
strategies  how values are tried: a row each
model       the contents of a sweep file
loading     reading a sweep file, with located errors
search      the values to try next, by Optuna
objective   readings of a metric during a run, and what a run is worth
task        one run, as a worker does it
local       worker processes on this machine
cluster     the same on Ray, and the workers that a command uses, of either kind
state       a sweep on disk: its resolved file, and locks; progress follows from its runs
trials      trials, and what is recorded of them
running     the loop that gives batches of runs to workers
plan        disk and runs that a sweep will take
whole       a sweep from its start to its end, as a command and the service run it
results     ranking, importance, the best configuration
charts      charts of the trials, one sheet with all of them, and the sweep as a page

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
    """Return whether these names are that of one sweep, rather than names of runs."""
    return len(names) == 1 and names[0] in sweeps_in(recordings)
