"""One process at a time works in a folder: on a run that is there already, a sweep, a queue."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final

from runner.errors import RunnerError
from runner.runs.run import Run, run_at
from runner.util.files import storage_errors

if TYPE_CHECKING:
    from filelock import FileLock

RUN_LOCK: Final = "owner.lock"


@contextlib.contextmanager
def locked(run: Run, archived: bool = False) -> Iterator[Run]:
    """Give a run as it is now, its folder kept from every other process that would write to it.

    Args:
        run: whose folder.
        archived: whether it may be one whose recording is in an archive alone.

    Raises:
        RunnerError: it is running or archived, or another process has it in this way.
        StorageError: the folder cannot be written.
    """
    busy = RunnerError(f"run {run.run_id} is being worked on by another process; let it.")
    lock = acquired(run.folder / RUN_LOCK, busy)
    try:
        if not run.stands_alone:
            run = run_at(run.folder)
        if run.status == "running":
            owner = run.file.owner
            raise RunnerError(
                f"run {run.run_id} is running (process {owner.get('pid')} on {owner.get('host')}); let it."
            )
        if run.status == "archived" and not archived:
            raise RunnerError(
                f"run {run.run_id} is archived; `dualtaxi restore {run.run_id}` brings it back."
            )
        yield run
    finally:
        lock.release()


def acquired(path: Path, busy: RunnerError) -> FileLock:
    """Return the lock of a file, acquired without waiting; who asked for it releases it.

    Args:
        path: the file; its folder is made if it is missing.
        busy: what is raised if another process has it.

    Raises:
        RunnerError: `busy`.
        StorageError: the folder cannot be written.
    """
    from filelock import FileLock, Timeout

    lock = FileLock(path, thread_local=False)
    with storage_errors(path.parent):
        try:
            lock.acquire(blocking=False)
        except Timeout as error:
            raise busy from error
    return lock
