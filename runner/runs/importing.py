"""Import a recording from elsewhere into a recordings folder, after checking it completely.

Uploads to the service, pulled runs and files of `dualtaxi export mcap` are all imported in this way.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import secrets
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from runner.errors import RecordingError, RunnerError, StorageError
from runner.recording.description import recorded_facts
from runner.recording.labels import LABELS_FILE, MAX_TAGS, Labels, change_labels, labels_from
from runner.recording.marks import MARKS_FILE, Marks, change_marks, marks_from, read_marks
from runner.recording.reader import Recording, open_recording
from runner.recording.rewriting import content_of, continues, rewrite
from runner.recording.run_file import parse_run_file
from runner.runs.checkpoints import Store, read_checkpoints
from runner.runs.resolve import run_with_id
from runner.runs.run import PREVIEW, RECORDING_FILE, RUN_FILE, Run, locked, made_by, new_run_id, run_at
from runner.util.files import require_room, storage_errors, sync, write_object
from runner.util.values import NAME_EXPECTED, NAME_PATTERN, RUN_NAME_PATTERN, Json, JsonView, is_number

EXPORT_RECORD: Final = "export"
"""The metadata record of an exported recording: what `run.json` and the labels say, as JSON."""
UNFINISHED: Final = ("interrupted", "failed")
"""The statuses of a run that a longer recording of it may replace."""
MAX_ERROR: Final = 10_000
"""Characters of an error text that are kept."""


class Occupied(RunnerError):
    """There is another run of this id: `run`."""

    def __init__(self, run: Run, recordings: Path) -> None:
        super().__init__(
            f"{recordings}: found another run {run.run_id} ({run.title}, {run.status}) "
            "with other content, and neither continues the other."
        )
        self.run = run


@dataclass(frozen=True)
class Imported:
    """The result of importing a recording."""

    run: Run
    content_digest: str
    already: bool
    """Whether the folder had the run before, with this content or more, so that nothing was written."""
    anonymous: bool = False
    """Whether the file was exported without the names of persons and places."""


def import_record(run: Run) -> Json:
    """Return what `import_recording` needs of a run besides its recording."""
    summary = {key: run.summary[key] for key in ("seconds", "error", "bytes") if key in run.summary}
    record: Json = {"status": run.status, "name": run.file.name, "summary": summary}
    marks = Marks() if run.stands_alone else read_marks(run.folder)
    record |= {"labels": run.labels.as_json()} | ({"marks": marks.as_json()} if marks != Marks() else {})
    return record | ({"proof": run.file.proof} if run.file.proof else {})


def import_recording(
    recording: Path, recordings: Path, details: JsonView | None = None, as_new: bool = False
) -> Imported:
    """Import a recording into a folder of runs; the file stays where it is.

    An interrupted run that is there already is replaced by a recording that continues it, and keeps its
    labels, as does the preview of an upload. When this returns the run is on disk, even if the power fails
    now.

    Args:
        recording: the file, to which nothing is written any more. If it is finished, nothing in it changes
            and it is on the same disk, it is linked instead of copied.
        details: the run where it comes from, as `import_record` returns it; the file's own record of it by
            default. Values that are invalid, or that the recording contradicts, are ignored.
        as_new: give the run a new id, so that it can stand next to another run of its id.

    Raises:
        RecordingError: the recording is damaged or inconsistent; nothing was written.
        Occupied: another run of this id is there.
        RunnerError: the existing run is locked by another process.
        StorageError: the folder cannot be written, or has too little space.
    """
    with open_recording(recording) as opened:
        exported = _export_record(opened)
        record = exported if details is None else details
        facts = checked_facts(opened, record)
        contents = [checkpoint.digest for checkpoint in read_checkpoints(opened, recordings)]
    own_labels = record.get("labels")
    marks = marks_from(record.get("marks"))
    labels = labels_from(own_labels) if isinstance(own_labels, dict) else Labels()
    digest = content_of(recording)
    anonymous = exported.get("anonymous") is True
    if as_new:
        facts["run_id"] = new_run_id(recordings)
    target = recordings / facts["run_id"]
    if contents:  # those that are in the store already stay there
        recordings.mkdir(parents=True, exist_ok=True)
        Store(recordings).refer(target.name, contents)
    existing = None if as_new else _existing_run(target)
    preview = existing if existing is not None and PREVIEW in existing.facts else None
    if preview is not None:
        existing = None
        labels = _merged(preview.labels, labels)
        marks = read_marks(preview.folder).merged(marks.marks, marks.removed)
    if existing is not None and _has_content(existing, digest):
        merge_marks(existing, marks)
        return Imported(_finish(existing, facts), digest, already=True, anonymous=anonymous)
    with _staging_folder(recordings, recording) as folder:
        _place(recording, folder / RECORDING_FILE, facts, rewritten=as_new or bool(exported))
        if existing is not None:
            occupied = Occupied(existing, recordings)
            run, already = _continue_or_keep(occupied, folder / RECORDING_FILE, facts, labels)
            merge_marks(run, marks)
            return Imported(run, digest, already, anonymous)
        write_object(folder / RUN_FILE, facts)
        if labels != Labels():
            write_object(folder / LABELS_FILE, labels.as_json())
        if marks != Marks():
            write_object(folder / MARKS_FILE, marks.as_json())
        for path in (*folder.iterdir(), folder):
            sync(path)
        if preview is not None:
            target.rename(folder.with_name("preview"))  # removed with the hidden folder
        folder.rename(target)
        sync(recordings)
    return Imported(run_at(target), digest, already=False, anonymous=anonymous)


def merge_marks(run: Run, marks: Marks) -> None:
    """Add marks that somebody else set or removed to a run, if it has a folder of its own."""
    if marks != Marks() and not run.stands_alone:
        change_marks(run.folder, lambda present: present.merged(marks.marks, marks.removed))


def run_facts(recording: Recording, details: JsonView) -> Json:
    """Return the contents of `run.json`: the recording's own, and what only its owner can know.

    Name, status, duration, error text and the digest of a recording without steps are taken from `details`
    where they are of the right type. Only the recording can say that the run finished.
    """
    facts = recorded_facts(recording)
    summary = dict(facts["summary"])
    given = details.get("summary")
    given = given if isinstance(given, dict) else {}
    seconds, error = given.get("seconds"), given.get("error")
    if is_number(seconds) and 0 <= seconds < 1e12:
        summary["seconds"] = seconds
    if isinstance(error, str) and len(error) <= MAX_ERROR:
        summary["error"] = error
    if "content_digest" in summary or "bytes" in given:
        summary["bytes"] = recording.file.size
    if isinstance(details.get("name"), str):
        facts["name"] = details["name"]
    reached = ("finished",) if facts["status"] == "finished" else ()
    if details.get("status") in (*UNFINISHED, *reached):
        facts["status"] = details["status"]
    proof = details.get("proof")
    if isinstance(proof, str) and len(proof) == 64 and proof.isalnum():
        facts["proof"] = proof
    return facts | {"summary": summary}


def _export_record(recording: Recording) -> dict[str, object]:
    """Return the description of the run in an exported recording; empty for any other recording."""
    if EXPORT_RECORD not in recording.file.metadata_names:
        return {}
    try:
        entries = json.loads(recording.file.metadata(EXPORT_RECORD)["json"])
    except (KeyError, ValueError, RecursionError) as error:
        raise RecordingError(f"{recording.path}: the metadata {EXPORT_RECORD!r} is not JSON.") from error
    return entries if isinstance(entries, dict) else {}


def checked_facts(recording: Recording, details: JsonView) -> Json:
    """Return the contents of `run.json`.

    Raises:
        RecordingError: the recording's description of the run is invalid.
    """
    try:
        facts = run_facts(recording, details)
        problems = parse_run_file(facts).problems
        provenance = made_by(recording.provenance)
    except (ValueError, TypeError, KeyError) as error:
        raise RecordingError(f"{recording.path}: its description of the run is invalid ({error}).") from error
    if problems:
        raise RecordingError(
            f"{recording.path}: its description of the run is invalid ({'; '.join(problems)})."
        )
    named = re.fullmatch(NAME_PATTERN, facts["run_id"]) and re.fullmatch(RUN_NAME_PATTERN, facts["name"])
    if not named or not 0 <= facts["seed"] < 1 << 64:
        raise RecordingError(
            f"{recording.path}: found the run {facts['run_id'][:100]!r} ({facts['name'][:100]!r}, seed "
            f"{facts['seed']}), expected an id of {NAME_EXPECTED}; a seed of 64 bits."
        )
    return facts | {"provenance": provenance}


def _existing_run(target: Path) -> Run | None:
    """Return the run whose id a folder is to have as its name; None if there is none.

    Raises:
        StorageError: something that is not a run has the folder's name.
    """
    run = run_with_id(target.name, target.parent)
    if run is None and os.path.lexists(target):
        raise StorageError(f"{target}: exists and is not a run; move it away.")
    return run


def _has_content(run: Run, content_digest: str) -> bool:
    try:
        return content_of(run.recording) == content_digest
    except RecordingError:
        return False


def _continue_or_keep(
    occupied: Occupied, recording: Path, facts: Mapping[str, object], labels: Labels
) -> tuple[Run, bool]:
    """Return the existing run of `occupied`, and whether it already has all of the recording.

    If it did not finish and the recording continues it, the recording replaces its own. If that is
    interrupted, `_finish` completes it when the same recording is imported again.

    Raises:
        Occupied: neither continues the other.
    """
    there = occupied.run
    if there.status in (*UNFINISHED, "finished") and not there.stands_alone:
        with contextlib.suppress(RecordingError):
            if continues(there.recording, recording):
                return there, True
    if there.status not in UNFINISHED or there.stands_alone:
        raise occupied
    with locked(there) as run:
        if run.status not in UNFINISHED or not continues(recording, run.recording):
            raise occupied
        change_labels(run.folder, lambda present: _merged(present, labels))
        with storage_errors(run.folder):
            sync(recording)
            recording.replace(run.recording)
            sync(run.folder)
            return _with_facts(run, facts), False


def _finish(run: Run, facts: Mapping[str, object]) -> Run:
    """Return the run; update its `run.json` if only its recording is finished."""
    if facts["status"] != "finished" or run.status not in UNFINISHED or run.stands_alone:
        return run
    with locked(run) as there:
        return _with_facts(there, facts) if there.status in UNFINISHED else there


def _with_facts(run: Run, facts: Mapping[str, object]) -> Run:
    """Replace the facts on the recording in `run.json`; keep those on its folder."""
    own_facts = {key: value for key, value in run.facts.items() if key not in ("owner", "proof", "summary")}
    write_object(run.folder / RUN_FILE, own_facts | dict(facts))
    return run_at(run.folder)


def _merged(present: Labels, more: Labels) -> Labels:
    """Return the labels of both sides; of name and note, the own ones come first."""
    tags = tuple(sorted({*present.tags, *more.tags})[:MAX_TAGS])
    return Labels(present.name or more.name, tags, present.note or more.note)


def _place(source: Path, target: Path, facts: Json, rewritten: bool) -> None:
    """Copy, link or rewrite a recording, and set its size in the facts.

    Args:
        target: the new file. A finished recording that is not rewritten becomes a link on the same disk;
            others are copied, as `resume` continues them in place, which must not change the source.
        rewritten: write it with the id of the facts and without its export record.

    Raises:
        OSError: the target cannot be written.
    """

    def change(name: str, entries: dict[str, str]) -> dict[str, str] | None:
        if name == EXPORT_RECORD:
            return None
        return entries | {"run_id": facts["run_id"]} if name == "run" else entries

    if rewritten:
        rewrite(source, target, change)
    elif facts["status"] != "finished" or not _linked(source, target):
        shutil.copyfile(source, target)
    if "bytes" in facts["summary"]:
        facts["summary"]["bytes"] = target.stat().st_size


def _linked(source: Path, target: Path) -> bool:
    """Link a file, and return whether that was possible: not to another disk, or one without links."""
    try:
        os.link(source, target)
    except OSError:
        return False
    return True


@contextlib.contextmanager
def _staging_folder(recordings: Path, recording: Path) -> Iterator[Path]:
    """Yield a folder inside a hidden one, on the disk of the recordings; both are removed afterwards."""
    created = not recordings.exists()
    hidden = recordings / f".importing-{secrets.token_hex(4)}"
    try:
        (hidden / "run").mkdir(parents=True)
        require_room(recordings, recording.stat().st_size)
        yield hidden / "run"
    except OSError as error:
        raise StorageError(
            f"{recordings}: cannot be written ({error.strerror}); nothing was imported."
        ) from error
    finally:
        shutil.rmtree(hidden, ignore_errors=True)
        if created:
            with contextlib.suppress(OSError):
                recordings.rmdir()
