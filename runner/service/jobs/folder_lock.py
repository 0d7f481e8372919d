"""A folder of runs is served by one process at a time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from runner.errors import RunnerError
from runner.runs.locking import acquired

if TYPE_CHECKING:
    from filelock import FileLock


def hold(recordings: Path, lock_file: str) -> FileLock:
    """Keep every other process from a part of a folder of runs, until it is released or this one ends.

    Args:
        recordings: the folder of runs; made if it is missing.
        lock_file: of the part, below it.

    Raises:
        RunnerError: another process has it.
        StorageError: the folder cannot be written.
    """
    busy = RunnerError(
        f"{recordings} is served by another process already; stop that one, or choose another --recordings."
    )
    return acquired(recordings / lock_file, busy)
