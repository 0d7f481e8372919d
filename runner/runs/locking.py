"""Locks on folders, so that one process at a time changes a run, a sweep or a queue."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final

from runner.errors import RunnerError
from runner.runs.listing import run_at
from runner.runs.run import Run
from runner.util.files import storage_errors

if TYPE_CHECKING:
    from filelock import FileLock

RUN_LOCK: Final = "owner.lock"


@contextlib.contextmanager
def locked(run: Run, archived: bool = False) -> Iterator[Run]:
    """Lock the folder of a run, and yield the run as it is now.

    Raises:
        RunnerError: it is running or archived, or locked by another process.
        StorageError: the folder cannot be written.
    """
    busy = RunnerError(f"run {run.run_id} is locked by another process; try again when it has finished.")
    lock = acquired(run.folder / RUN_LOCK, busy)
    try:
        if not run.stands_alone:
            run = run_at(run.folder)
        if run.status == "running":
            owner = run.file.owner
            raise RunnerError(
                f"run {run.run_id} is running (process {owner.get('pid')} on {owner.get('host')}); "
                "try again when it has finished."
            )
        if run.status == "archived" and not archived:
            raise RunnerError(f"run {run.run_id} is archived; `dualtaxi restore {run.run_id}` restores it.")
        yield run
    finally:
        lock.release()


def acquired(path: Path, busy: RunnerError) -> FileLock:
    """Acquire the lock of a file without waiting; the caller releases it.

    Args:
        path: the lock file; its folder is created if it is missing.
        busy: raised if another process has the lock.
    """
    from filelock import FileLock, Timeout

    lock = FileLock(path, thread_local=False)
    with storage_errors(path.parent):
        try:
            lock.acquire(blocking=False)
        except Timeout as error:
            raise busy from error
    return lock
