"""One process at a time works on a run that is there already."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Final

from filelock import FileLock, Timeout

from runner.errors import RunnerError, StorageError
from runner.runs import RECORDING_FILE, Run, run_at

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
    lock = FileLock(run.folder / RUN_LOCK)
    try:
        lock.acquire(blocking=False)
    except Timeout as error:
        raise RunnerError(f"run {run.run_id} is being worked on by another process; let it.") from error
    except OSError as error:
        raise StorageError(f"{run.folder}: cannot be written ({error.strerror}).") from error
    try:
        if run.facts.get("recording", RECORDING_FILE) == RECORDING_FILE:
            run = run_at(run.folder)
        if run.status == "running":
            owner = run.facts.get("owner", {})
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
