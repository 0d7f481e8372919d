"""Archive runs of a recordings folder, and restore them.

An archived run keeps its folder with labels and `run.json`, whose `archive` has the place of the archive.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from runner.archive.layout import CONTENTS, Manifest
from runner.archive.places import archive_store, restore_to
from runner.archive.reading import restore
from runner.archive.store import ArchiveStore, no_archive, split_place, temporary_folder
from runner.archive.writing import write_archive
from runner.errors import RecordingError, RunnerError, StorageError
from runner.recording.description import recorded_facts
from runner.recording.integrity import may_be_cut, survey
from runner.recording.marks import read_marks
from runner.recording.reader import Recording, open_recording
from runner.recording.rewriting import content_of
from runner.recording.schema import STEP_TOPICS
from runner.runs.checkpoints import Store
from runner.runs.importing import merge_marks
from runner.runs.resolve import run_of_id
from runner.runs.run import RECORDING_FILE, RUN_FILE, Run, locked
from runner.util.processes import Report
from runner.util.values import Json


@dataclass(frozen=True)
class Archived:
    """The result of archiving a run."""

    run: Run
    place: str
    """Path or URL of the archive."""
    manifest: Manifest
    new: bool
    """Whether it was made now, or existed before."""
    removed: bool
    """Whether the recording was removed from the run's folder."""
    recording_bytes: int
    """Bytes of the recording when it was archived."""

    @property
    def steps(self) -> int:
        """Number of the steps in the archive."""
        topics = self.manifest.topics
        return sum(topics[name].size for name in STEP_TOPICS if name in topics)

    def as_json(self) -> Json:
        """Return it as JSON, without its place."""
        return {
            "run_id": self.run.run_id,
            "name": self.run.name,
            "content_digest": self.manifest.digest,
            "steps": self.steps,
            "bytes": self.manifest.size,
            "recording_bytes": self.recording_bytes,
            "new": self.new,
            "removed": self.removed,
        }


def archive_run(
    run: Run, to: str, remove: bool = False, report: Report = lambda _: None, dry_run: bool = False
) -> Archived:
    """Archive a run.

    Args:
        remove: remove the recording after the archive was restored in memory and compared with it.
        dry_run: write the archive to a temporary folder, and change nothing.

    Raises:
        RunnerError: the run stands alone, or is running; the target has another archive of its id.
        RecordingError: the recording is damaged.
        StorageError: the target cannot be written; there is no archive then.
    """
    if not (run.folder / RUN_FILE).is_file() or run.stands_alone:
        raise RunnerError(
            f"{run.recording}: found a recording that stands alone, expected a run in a folder."
        )
    store = ArchiveStore(to)
    with locked(run, archived=True) as current:
        if current.status == "archived":
            raise RunnerError(f"run {run.run_id} is archived already, in {current.archive.target}.")
        return _archive(current, store, remove, report, dry_run)


def _archive(run: Run, store: ArchiveStore, remove: bool, report: Report, dry_run: bool) -> Archived:
    place, existing = store.place(run.run_id), store.manifest(run.run_id)
    is_new = existing is None
    with _undamaged(run) as recording:
        size = recording.file.size
        done = recording.done()
        if dry_run or existing is None:
            with temporary_folder() if dry_run else store.writing(run.run_id) as folder:
                manifest = write_archive(recording, folder, report)
        elif _has_content_of(existing, recording):
            manifest = existing
        else:
            raise RunnerError(
                f"{place}: found an archive of this run with other content, made at "
                f"another time ({existing.digest[:16]}…); remove it, or choose another --to."
            )
    if dry_run:
        return Archived(run, place, manifest, is_new, False, size)
    if remove or not is_new:
        with store.reading(run.run_id) as folder:
            if is_new:
                restore(folder, report=report)
            else:
                restore_to(folder, None, manifest.digest, report)
    reference = {
        "target": place,
        "digest": manifest.digest,
        "bytes": manifest.size,
        "recording_bytes": size,
        "done": done,
        "version": manifest.version,
    }
    run = run.update(archive=reference)
    if remove:
        run.recording.unlink()
        contents = Store(run.folder.parent)
        name = run.folder.name
        if {f"{CONTENTS}{digest}" for digest in contents.of_run(name)} <= manifest.files.keys():
            contents.drop(name)
    return Archived(run, place, manifest, is_new, remove, size)


def _has_content_of(manifest: Manifest, recording: Recording) -> bool:
    """Return whether an archive has a recording's content; of a killed run, that of its complete chunks."""
    stated = recording.result.content_digest
    if manifest.run.get("content_digest") != stated:
        return False
    return stated is not None or manifest.digest == content_of(recording.path)


@contextlib.contextmanager
def _undamaged(run: Run) -> Iterator[Recording]:
    """Open the recording of a run; the error for damage suggests a repair."""
    try:
        with open_recording(run.recording) as recording:
            if not recording.file.finished:
                contents = survey(run.recording)
                if not may_be_cut(run.recording, contents):
                    raise RecordingError(f"{run.recording}: {contents.reason}: it is damaged.")
            yield recording
    except RecordingError as error:
        if not run.recording.exists() or "`dualtaxi repair" in str(error):
            raise
        raise RecordingError(f"{error} `dualtaxi repair {run.run_id}` repairs it.") from error


def restore_run(run: Run, report: Report = lambda _: None) -> Run:
    """Restore the recording of an archived run into its folder; return the run. The archive stays.

    Raises:
        RunnerError: it is not archived.
        RecordingError: the archive is damaged, missing, or of another run; nothing changes.
        StorageError: the recording cannot be written.
    """
    with locked(run, archived=True) as current:
        if current.status != "archived":
            raise RunnerError(f"run {run.run_id} is not archived: its recording is {current.recording}.")
        fresh = current.recording.with_suffix(".restoring")
        with archive_store(current).reading(run.run_id) as folder:
            restore_to(folder, fresh, current.archive.digest, report)
            _restore_contents(folder, current.folder)
            merge_marks(current, read_marks(folder))
        fresh.replace(current.recording)
        facts = {key: value for key, value in current.facts.items() if key != "archive"}
        return Run(current.folder, facts).update()


def _restore_contents(archive: Path, folder: Path) -> None:
    """Put the contents of checkpoints in an archive, which was checked, into the store next to a run."""
    store = Store(folder.parent)
    for path in sorted((archive / CONTENTS).glob("*")):
        store.put(folder.name, path, expected=path.name)


def restore_place(place: str, recordings: Path, report: Report = lambda _: None) -> Run:
    """Restore a run from its archive alone, with the same id, into a recordings folder.

    Raises:
        RunnerError: there is a run of that id.
        RecordingError: there is no archive, or it is damaged.
        StorageError: the run cannot be written.
    """
    location, run_id = split_place(place)
    store = ArchiveStore(location)
    manifest = store.manifest(run_id)
    if manifest is None:
        raise no_archive(place)
    if manifest.run_id != run_id:
        raise RecordingError(f"{place}: found an archive of run {manifest.run_id}, expected {run_id}.")
    run = run_of_id(run_id, recordings)
    if run is not None and run.status == "archived":
        return restore_run(run, report)
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
            _restore_contents(archive, folder)
            marks = read_marks(archive)
        with open_recording(folder / RECORDING_FILE) as recording:
            facts = recorded_facts(recording) | {"name": manifest.run["name"]}  # it may have been renamed
            facts["summary"] |= {"bytes": recording.file.size}
        run = Run(folder, facts).update()
        merge_marks(run, marks)
        return run
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
