"""The runs of a recordings folder, as they are found on disk, and the locks on them."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final

from runner.errors import RecordingError, RunnerError, RunNotFound, StorageError
from runner.recording.run_file import RUN_ID
from runner.runs.run import RECORDING_FILE, RUN_FILE, Run, made_by, recordings_folder
from runner.util.files import read_object, storage_errors

if TYPE_CHECKING:
    from filelock import FileLock

MAX_RUN_FILE_BYTES: Final = 8 << 20


def list_runs(recordings: str | os.PathLike[str] | None = None) -> list[Run]:
    """Return the runs of a recordings folder, the newest first.

    Args:
        recordings: the folder: $DUALTAXI_RECORDINGS, or ./recordings, by default.

    Raises:
        StorageError: the folder is there and cannot be read.
    """
    folder = recordings_folder(recordings)
    runs = [run for entry in run_entries(folder) if (run := run_in(folder / entry))]
    return sorted(runs, key=lambda run: (run.created, run.run_id), reverse=True)


def run_entries(recordings: Path) -> list[str]:
    """Return the names of the folders that may have a run: all but the hidden ones.

    Raises:
        StorageError: the recordings folder is there and cannot be read.
    """
    try:
        with os.scandir(recordings) as entries:
            return [entry.name for entry in entries if entry.name[0] != "." and entry.is_dir()]
    except FileNotFoundError:
        return []
    except OSError as error:
        raise StorageError(f"{recordings}: cannot be read as a folder of runs ({error.strerror}).") from error


def run_at(path: Path) -> Run:
    """Return the run in a folder, or of a recording outside a run's folder.

    Raises:
        RunNotFound: there is none.
    """
    if path.is_dir():
        if run := run_in(path):
            return run
        raise RunNotFound(f"{path}: found a folder without {RUN_FILE} or {RECORDING_FILE}, expected a run.")
    if not path.is_file():
        raise RunNotFound(f"{path}: no such file or folder.")
    if path.name == RECORDING_FILE and (path.parent / RUN_FILE).is_file():
        return run_at(path.parent)
    return _from_recording(path)


def run_in(folder: Path) -> Run | None:
    """Return the run in a folder, from its recording when `run.json` is gone; None if there is none."""
    with contextlib.suppress(OSError, ValueError):
        facts = read_object(folder / RUN_FILE, MAX_RUN_FILE_BYTES)
        if _is_run(facts):
            return Run(folder, facts)
    if (folder / RECORDING_FILE).is_file():
        with contextlib.suppress(RecordingError):
            return _from_recording(folder / RECORDING_FILE)
    return None


def listed_run(folder: Path, run_id: str) -> Run:
    """Return the run in a folder, which had this id when the folder was listed.

    Raises:
        RunNotFound: it was removed in the meantime.
    """
    run = run_in(folder)
    if run is None:
        raise RunNotFound(f"run {run_id} was removed just now.")
    return run


def _is_run(facts: dict[str, object]) -> bool:
    """Return whether facts have the id of a run; the others may be damaged."""
    run_id = facts.get("run_id")
    return isinstance(run_id, str) and RUN_ID.fullmatch(run_id) is not None and run_id.strip(".") != ""


def _from_recording(path: Path) -> Run:
    from runner.recording.description import recorded_facts
    from runner.recording.reader import open_recording

    with open_recording(path) as recording:
        facts = {**recorded_facts(recording), "recording": path.name}
        with contextlib.suppress(RecordingError):
            facts["provenance"] = made_by(recording.provenance)
    if not _is_run(facts):
        raise RecordingError(f"{path}: is damaged: its description of the run is invalid.")
    return Run(path.parent, facts)


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
