"""The archives of runs: found where they are, and restored into the user's cache to be read.

A restore runs in a child process with a memory limit, as an archive may be made to exhaust the
memory. For a run that is not archived nothing heavy is imported.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

from runner.errors import RecordingError, StorageError
from runner.runs.run import RUN_FILE, Run
from runner.runs.trust_marks import copy_mark
from runner.util.files import CACHE_VARIABLE, CACHED_RECORDINGS, cache_folder, remove_oldest, storage_errors
from runner.util.humanize import size
from runner.util.processes import ChildProcess, OutOfMemory, ProcessDied, Report, Tell, report_progress

if TYPE_CHECKING:
    from runner.archive.store import ArchiveStore
    from runner.recording.reader import Recording

ARCHIVE_VARIABLE: Final = "DUALTAXI_ARCHIVE"
MAX_CACHED: Final = 8
"""Restored recordings in the cache; those unused for longest are removed."""
LOCK_SECONDS: Final = 600.0
MEMORY_BYTES: Final = 4 * 10**9
"""Memory for restoring an archive, beyond what the process takes at its start."""
_RESTORE_SECONDS: Final = 7 * 86400.0


def default_target(recordings: Path) -> str:
    """Return the default place of archives: by the variable, else `archive` next to the recordings."""
    return os.environ.get(ARCHIVE_VARIABLE) or str(recordings.absolute().parent / "archive")


def at_hand(run: Run, log: Tell = lambda _: None, report: Report = lambda _: None) -> Run:
    """Return the run with a recording that can be read: an archived one is restored into the user's cache.

    Args:
        log: called with a line if it must be restored, which takes seconds.

    Raises:
        RecordingError: the archive is damaged, missing, or of another run.
        StorageError: the cache cannot be written, or another process has been restoring it for too long.
    """
    if run.status != "archived" or run.restored:
        return run
    from filelock import FileLock, Timeout

    digest = run.archive.digest
    if len(digest) != 64 or not digest.isalnum():
        raise RecordingError(f"{run.folder / RUN_FILE}: found archive digest {digest!r}, expected a BLAKE3.")
    cached = cache_folder() / CACHED_RECORDINGS / f"{run.run_id}-{digest[:16]}.mcap"
    with storage_errors(cached, f"set {CACHE_VARIABLE} to another folder"):
        cached.parent.mkdir(parents=True, exist_ok=True)
        try:
            with FileLock(cached.with_suffix(".lock"), timeout=LOCK_SECONDS):
                if not cached.is_file():
                    log(f"Run {run.run_id} is archived; restoring it from {run.archive.target}.")
                    remove_oldest(cached.parent, "*.mcap", keep=MAX_CACHED - 1)
                    fresh = cached.with_suffix(".restoring")
                    with archive_store(run).reading(run.run_id) as folder:
                        restore_to(folder, fresh, digest, report)
                    fresh.replace(cached)
                # It was used now, but has not changed: its ETag and what is computed from it stay valid.
                os.utime(cached, ns=(time.time_ns(), cached.stat().st_mtime_ns))
                copy_mark(run.folder, cached)
        except Timeout as error:
            raise StorageError(
                f"{cached}: another process has been restoring it for {LOCK_SECONDS:.0f} s."
            ) from error
    return replace(run, restored=cached)


@contextlib.contextmanager
def opened(run: Run | Recording) -> Iterator[Recording]:
    """Yield the recording of a run, as `at_hand` finds it; one that is open already stays open."""
    if not isinstance(run, Run):
        yield run
        return
    from runner.recording.reader import open_recording

    with open_recording(at_hand(run).recording) as recording:
        yield recording


def archive_store(run: Run) -> ArchiveStore:
    """Return the store with the archive of a run.

    Raises:
        RecordingError: it is at none of its places.
    """
    from runner.archive.store import ArchiveStore, split_place

    place = archive_place(run)
    if place is None:
        raise RecordingError(
            f"run {run.run_id}: found no archive at {' or '.join(_places(run))}; its recording was put into "
            f"it. Mount or copy it there, or set {ARCHIVE_VARIABLE} to the folder that has it."
        )
    return ArchiveStore(split_place(place)[0])


def archive_place(run: Run) -> str | None:
    """Return the place of a run's archive; None if it is at none of its places."""
    from runner.archive.store import ArchiveStore, split_place

    for place in _places(run):
        location, run_id = split_place(place)
        if run_id == run.run_id and ArchiveStore(location).manifest(run_id) is not None:
            return place
    return None


def _places(run: Run) -> list[str]:
    """Return where the archive of a run may be: where it was put, or next to recordings that moved."""
    default = f"{default_target(run.folder.absolute().parent)}/{run.run_id}"
    return list(dict.fromkeys((run.archive.target, default)))


def restore_to(folder: Path, path: Path | None, digest: str, report: Report) -> None:
    """Restore an archive with a digest into a file, or in memory alone; it is checked completely.

    Raises:
        RecordingError: the archive is damaged, or has another digest; there is no file then.
    """
    if path is not None:
        path.unlink(missing_ok=True)
    try:
        if multiprocessing.current_process().daemon:  # it has limits of its own, and must not start another
            restored_digest = _restore(folder, path, report)
        else:
            with ChildProcess(MEMORY_BYTES, on_progress=report) as child:
                restored_digest = child.call(_restore, _RESTORE_SECONDS, folder, path)
        if restored_digest != digest:
            raise RecordingError(
                f"{folder}: found an archive of digest {restored_digest}, expected {digest}."
            )
    except BaseException as error:
        if path is not None:
            path.unlink(missing_ok=True)
        if isinstance(error, OutOfMemory | ProcessDied):
            raise RecordingError(
                f"{folder}: restoring it needs more than {size(MEMORY_BYTES)} of memory: the "
                "archive is damaged, or was made to exhaust it."
            ) from error
        raise


def _restore(folder: Path, path: Path | None, report: Report = report_progress) -> str:
    """Restore an archive; return its digest."""
    from runner.archive.reading import restore

    return restore(folder, path, report).digest
