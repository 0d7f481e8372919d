"""The recordings of archived runs: found where they were put, and restored into the user's cache to be read.

A run that is not archived costs nothing here, so what is heavy is imported when it is needed.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from runner.errors import RecordingError, StorageError
from runner.runs.run import RUN_FILE, Run
from runner.util.files import CACHE_VARIABLE, RESTORED, cache_folder

ARCHIVE_VARIABLE: Final = "DUALTAXI_ARCHIVE"
KEPT: Final = 8
"""Restored recordings in the cache; the ones that were not looked at for longest are removed."""
LOCK_SECONDS: Final = 600.0

Report = Callable[[int], None]
Tell = Callable[[str], None]


def default_target(recordings: Path) -> str:
    """Return where archives are kept: as the variable says, else in `archive` beside the recordings."""
    return os.environ.get(ARCHIVE_VARIABLE) or str(recordings.absolute().parent / "archive")


def at_hand(run: Run, tell: Tell = lambda _: None, report: Report = lambda _: None) -> Run:
    """Return the run with its recording to be read: if it is archived, restored into the user's cache.

    Args:
        run: any run.
        tell: called with a line when it must be restored, which takes seconds.
        report: called with the steps restored so far.

    Raises:
        RecordingError: the archive is damaged, missing, or another's.
        StorageError: the cache cannot be written, or another process has been restoring it for too long.
    """
    if run.status != "archived" or run.restored:
        return run
    from filelock import FileLock, Timeout

    digest = run.archive.digest
    if len(digest) != 64 or not digest.isalnum():
        raise RecordingError(f"{run.folder / RUN_FILE}: found archive digest {digest!r}, expected a BLAKE3.")
    kept = cache_folder() / RESTORED / f"{run.run_id}-{digest[:16]}.mcap"
    try:
        kept.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(kept.with_suffix(".lock"), timeout=LOCK_SECONDS):
            if not kept.is_file():
                tell(f"Run {run.run_id} is archived; restoring it from {run.archive.target}.")
                _restore_kept(run, kept, digest, report)
            kept.touch()
    except Timeout as error:
        raise StorageError(
            f"{kept}: another process has been restoring it for {LOCK_SECONDS:.0f} s."
        ) from error
    except OSError as error:
        raise StorageError(
            f"{kept}: cannot be written ({error.strerror}); set {CACHE_VARIABLE} to another folder."
        ) from error
    return replace(run, restored=kept)


def _restore_kept(run: Run, kept: Path, digest: str, report: Report) -> None:
    """Restore a run into the cache, and make room there."""
    others = sorted(kept.parent.glob("*.mcap"), key=lambda path: path.stat().st_mtime, reverse=True)
    for old in others[KEPT - 1 :]:
        old.unlink(missing_ok=True)
    fresh = kept.with_suffix(".restoring")
    with archive_of(run) as folder:
        restore_to(folder, fresh, digest, report)
    fresh.replace(kept)


@contextlib.contextmanager
def archive_of(run: Run) -> Iterator[Path]:
    """Give the archive of a run.

    Raises:
        RecordingError: there is none where it should be.
        StorageError: its place cannot be read.
    """
    from runner.archive.store import Store, split_place

    place = archive_place(run)
    if place is None:
        raise RecordingError(
            f"run {run.run_id}: found no archive at {' or '.join(_places(run))}; its recording was put into "
            f"it. Mount or copy it there, or set {ARCHIVE_VARIABLE} to the folder that has it."
        )
    with Store(split_place(place)[0]).reading(run.run_id) as folder:
        yield folder


def archive_place(run: Run) -> str | None:
    """Return where the archive of a run is; None if it is nowhere that is known.

    Raises:
        RecordingError: what is there is no archive.
        StorageError: its place cannot be read.
    """
    from runner.archive.store import Store, split_place

    for place in _places(run):
        location, run_id = split_place(place)
        if run_id == run.run_id and Store(location).manifest(run_id) is not None:
            return place
    return None


def _places(run: Run) -> list[str]:
    """Return where the archive of a run may be: where it was put, or beside recordings that moved with it."""
    beside = f"{default_target(run.folder.absolute().parent)}/{run.run_id}"
    return list(dict.fromkeys((run.archive.target, beside)))


def restore_to(folder: Path, path: Path, digest: Any, report: Report) -> None:
    """Restore an archive that must have a digest; errors as for `restoring.restore`."""
    from runner.archive.restoring import restore

    path.unlink(missing_ok=True)
    manifest = restore(folder, path, report)
    if manifest.digest != digest:
        path.unlink(missing_ok=True)
        raise RecordingError(f"{folder}: found an archive of digest {manifest.digest}, expected {digest}.")
