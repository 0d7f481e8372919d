"""Which sweeps a recordings folder has; loads nothing heavy, so that commands can ask before they begin."""

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
    """Return the names of the sweeps of a recordings folder."""
    return sorted(file.parent.name for file in (recordings / FOLDER).glob(f"*/{FILE}"))


def is_sweep(names: Sequence[str], recordings: Path) -> bool:
    """Return whether names are the one of a sweep, rather than of runs."""
    return len(names) == 1 and names[0] in sweeps_in(recordings)
