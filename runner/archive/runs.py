"""A run of the recordings folder in an archive: put there, and brought back.

What stays of an archived run is its folder with `run.json`, whose `archive` says where the recording is,
and what people say of it.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from runner.archive.manifest import Manifest
from runner.archive.places import archive_of, restore_to
from runner.archive.restoring import check
from runner.archive.store import Store, no_archive, split_place, temporary_folder
from runner.archive.writing import write_archive
from runner.errors import RecordingError, RunnerError, StorageError
from runner.recording.integrity import may_be_cut, survey
from runner.recording.reader import Recording, open_recording
from runner.recording.rewriting import content_of
from runner.runs.locking import locked
from runner.runs.run import RECORDING_FILE, RUN_FILE, Run, run_of_id

Report = Callable[[int], None]


@dataclass(frozen=True)
class Archived:
    """What came of archiving a run."""

    run: Run
    place: str
    """Path or URL of the archive."""
    manifest: Manifest
    new: bool
    """Whether it was made now; it may have been there."""
    removed: bool
    """Whether the recording was removed from the run's folder."""
    recording_bytes: int
    """Of the recording, when it was archived."""


def archive_run(
    run: Run, to: str, remove: bool = False, report: Report = lambda _: None, dry_run: bool = False
) -> Archived:
    """Put a run into an archive; return what came of it.

    Args:
        run: one of a recordings folder, not running.
        to: a folder, or `s3://bucket/prefix`.
        remove: remove the recording when what the archive gives back was compared with it.
        report: called with the steps done so far.
        dry_run: pack, but neither keep nor change anything.

    Raises:
        RunnerError: the run stands alone, or is running; the target has another archive of its id.
        RecordingError: the recording is damaged.
        StorageError: the target cannot be written; then there is no archive.
    """
    if not (run.folder / RUN_FILE).is_file() or run.stands_alone:
        raise RunnerError(
            f"{run.recording}: found a recording that stands alone, expected a run in a folder."
        )
    store = Store(to)
    with locked(run, archived=True) as current:
        if current.status == "archived":
            raise RunnerError(f"run {run.run_id} is archived already, in {current.archive.target}.")
        return _Archiving(current, store, report).do(remove, dry_run)


class _Archiving:
    """One run on its way into an archive."""

    def __init__(self, run: Run, store: Store, report: Report) -> None:
        self._run = run
        self._store = store
        self._report = report

    def do(self, remove: bool, dry_run: bool) -> Archived:
        """Write the archive, unless it is there; note it in the run; perhaps remove the recording."""
        run, store = self._run, self._store
        existing = store.manifest(run.run_id)
        with _sound(run) as recording:
            size, came = recording.size, recording.done()
            if dry_run or existing is None:
                manifest = self._write(recording, dry_run)
            elif _holds(existing, recording):
                manifest = existing
            else:
                raise RunnerError(
                    f"{store.place(run.run_id)}: found an archive of another content, made of this run at "
                    f"another time ({existing.digest[:16]}…); remove it, or choose another --to."
                )
        if dry_run:
            return Archived(run, store.place(run.run_id), manifest, existing is None, False, size)
        if remove or existing is not None:
            with store.reading(run.run_id) as folder:
                check(folder, self._report)
        run = run.update(archive=_stub(store.place(run.run_id), manifest, size, came))
        if remove:
            run.recording.unlink()
        return Archived(run, store.place(run.run_id), manifest, existing is None, remove, size)

    def _write(self, recording: Recording, dry_run: bool) -> Manifest:
        if dry_run:
            with temporary_folder() as folder:
                return write_archive(recording, folder, self._report)
        with self._store.writing(self._run.run_id) as folder:
            return write_archive(recording, folder, self._report)


def _holds(manifest: Manifest, recording: Recording) -> bool:
    """Return whether an archive has a recording's content; of a killed run, that of its whole chunks."""
    stated = recording.result.content_digest
    if manifest.run.get("content_digest") != stated:
        return False
    return stated is not None or manifest.digest == content_of(recording.path)


def _stub(place: str, manifest: Manifest, recording_bytes: int, done: dict[str, int]) -> dict[str, Any]:
    """Return what a run's file says of its archive."""
    return {
        "target": place,
        "digest": manifest.digest,
        "bytes": manifest.size,
        "recording_bytes": recording_bytes,
        "done": done,
        "version": manifest.version,
    }


@contextlib.contextmanager
def _sound(run: Run) -> Iterator[Recording]:
    """Give the recording of a run; damage found in it is told with what mends it."""
    mend = f"`dualtaxi repair {run.run_id}` mends it."
    try:
        with open_recording(run.recording) as recording:
            if not recording.finished:
                contents = survey(run.recording)
                if not may_be_cut(run.recording, contents):
                    raise RecordingError(f"{run.recording}: {contents.reason}: it is damaged.")
            yield recording
    except RecordingError as error:
        if not run.recording.exists() or "`dualtaxi repair" in str(error):
            raise
        raise RecordingError(f"{error} {mend}") from error


def restore_run(run: Run, report: Report = lambda _: None) -> Run:
    """Bring the recording of an archived run back into its folder; return the run. The archive stays.

    Raises:
        RunnerError: it is not archived.
        RecordingError: the archive is damaged, missing, or another's; nothing changes.
        StorageError: the recording cannot be written.
    """
    with locked(run, archived=True) as current:
        if current.status != "archived":
            raise RunnerError(f"run {run.run_id} is not archived: its recording is {current.recording}.")
        fresh = current.recording.with_suffix(".restoring")
        with archive_of(current) as folder:
            restore_to(folder, fresh, current.archive.digest, report)
        fresh.replace(current.recording)
        facts = {key: value for key, value in current.facts.items() if key != "archive"}
        return Run(current.folder, facts).update()


def restore_place(place: str, recordings: Path, report: Report = lambda _: None) -> Run:
    """Bring a run back from an archive alone, as a run of the same id in a recordings folder.

    Args:
        place: path or URL of the archive.
        recordings: the folder of runs.
        report: called with the steps done so far.

    Raises:
        RunnerError: there is a run of that id.
        RecordingError: there is no archive, or it is damaged.
        StorageError: the run cannot be written.
    """
    location, run_id = split_place(place)
    store = Store(location)
    manifest = store.manifest(run_id)
    if manifest is None:
        raise no_archive(place)
    if manifest.run_id != run_id:
        raise RecordingError(f"{place}: found an archive of run {manifest.run_id}, expected {run_id}.")
    known = run_of_id(run_id, recordings)
    if known is not None and known.status == "archived":
        return restore_run(known, report)
    folder = recordings / run_id
    try:
        recordings.mkdir(parents=True, exist_ok=True)
        folder.mkdir()
    except FileExistsError as error:
        raise RunnerError(f"{folder}: found a run of that id, expected none; it is left as it is.") from error
    except OSError as error:
        raise StorageError(f"{folder}: cannot be written ({error.strerror}).") from error
    try:
        with store.reading(run_id) as archive:
            restore_to(archive, folder / RECORDING_FILE, manifest.digest, report)
        with open_recording(folder / RECORDING_FILE) as recording:
            facts = recording.run_facts() | {"name": manifest.run["name"]}  # it may have been renamed
            facts["summary"] |= {"bytes": recording.size}
        return Run(folder, facts).update()
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
