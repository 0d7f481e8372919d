"""Taking in a recording that came from elsewhere by itself, without a pack around it: proved right first."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from runner.config.model import NAME_EXPECTED, NAME_PATTERN
from runner.documents import write_whole
from runner.errors import RecordingError, StorageError
from runner.labels import LABELS_FILE, MAX_TAGS, Labels, as_json, change_labels
from runner.owning import owned
from runner.packing.packing import facts_bytes, run_facts
from runner.packing.unpacking import Occupied, known, workplace
from runner.recording.integrity import is_merely_cut_off
from runner.recording.reader import Recording, open_recording
from runner.recording.rewriting import content_of, continues
from runner.runs import MADE_BY, RECORDING_FILE, RUN_FILE, Run, find_run

UNFINISHED: Final = ("interrupted", "failed")
"""What the status of a run is that can be gone on with."""


@dataclass(frozen=True)
class Admitted:
    """What came of taking in a recording."""

    run: Run
    content_digest: str
    already: bool
    """Whether the same run with the same content was there before; then nothing was written."""


def admit(recording: Path, said: Mapping[str, Any], labels: Labels, recordings: Path) -> Admitted:
    """Take a recording into a folder of runs; on the same disk without copying it. The file stays.

    A run that is there already, but did not come to its end, is gone on with: a recording that continues
    its own takes that one's place, and what people say of either is kept. When this returns, the run is on
    disk, also should the power fail now.

    Args:
        recording: the file, which nobody writes to any more.
        said: what `run.json` said of the run where it comes from; what the recording does not confirm, or
            cannot know, is left out.
        labels: what people say of it.
        recordings: the folder of runs; made if it is missing.

    Raises:
        RecordingError: the recording is damaged or makes no sense; nothing was written.
        Occupied: another run of this id is there, which this does not go on with.
        RunnerError: another process is at work on the run that is there.
        StorageError: the recordings folder cannot be written.
    """
    with open_recording(recording) as opened:
        facts = _checked_facts(opened, said)
        finished = opened.finished
    if not finished and not is_merely_cut_off(recording):
        raise RecordingError(f"{recording}: is damaged, not merely cut off; `dualtaxi repair` mends it.")
    digest, run_id = content_of(recording), str(facts["run_id"])
    try:
        run = known(run_id, digest, recordings)
    except Occupied as occupied:
        return Admitted(_continued(occupied, recording, facts, labels), digest, already=False)
    if run is not None:
        return Admitted(_settled(run, facts), digest, already=True)
    with workplace(recordings) as folder:
        _link(recording, folder / RECORDING_FILE)
        (folder / RUN_FILE).write_bytes(facts_bytes(facts))
        if labels != Labels():
            write_whole(folder / LABELS_FILE, as_json(labels))
        for path in (*folder.iterdir(), folder):
            sync(path)
        folder.rename(recordings / run_id)
        sync(recordings)
    return Admitted(find_run(f"{recordings}{os.sep}{run_id}", recordings), digest, already=False)


def _continued(occupied: Occupied, recording: Path, facts: Mapping[str, Any], labels: Labels) -> Run:
    """Return a run that is there, its recording replaced by one that goes on where it ends.

    Should this be cut short, `_settled` does the rest when the same recording comes again.

    Raises:
        Occupied: the recording does not go on with it, or it is finished.
        RunnerError: another process is at it.
        StorageError: the folder cannot be written; nothing was lost.
    """
    if occupied.run.status not in UNFINISHED or occupied.run.stands_alone:
        raise occupied
    with owned(occupied.run) as run:
        if run.status not in UNFINISHED or not continues(recording, run.recording):
            raise occupied
        change_labels(run.folder, lambda said: _merged(said, labels))
        fresh = run.folder / f".{RECORDING_FILE}.fresh"
        try:
            fresh.unlink(missing_ok=True)
            _link(recording, fresh)
            sync(fresh)
            fresh.replace(run.recording)
            continued = _with_facts(run, facts)
            sync(run.folder)
        except OSError as error:
            raise StorageError(f"{run.folder}: cannot be written ({error.strerror}).") from error
        finally:
            fresh.unlink(missing_ok=True)
        return continued


def _settled(run: Run, facts: Mapping[str, Any]) -> Run:
    """Return a run that is there; if it has come to its end but does not say so, it does now."""
    if facts["status"] != "finished" or run.status not in UNFINISHED or run.stands_alone:
        return run
    with owned(run) as there:
        return _with_facts(there, facts) if there.status in UNFINISHED else there


def _with_facts(run: Run, facts: Mapping[str, Any]) -> Run:
    """Return a run that says of itself what came; what is its folder's own, it keeps."""
    kept = {key: value for key, value in run.facts.items() if key not in ("owner", "proof", "summary")}
    write_whole(run.folder / RUN_FILE, kept | dict(facts))
    return find_run(os.fspath(run.folder.absolute()), run.folder.parent)


def _merged(said: Labels, more: Labels) -> Labels:
    """Return what is said of a run here and elsewhere; here, where only one of the two can hold."""
    tags = tuple(sorted({*said.tags, *more.tags})[:MAX_TAGS])
    return Labels(said.name or more.name, tags, said.note or more.note)


def sync(path: Path) -> None:
    """Ask the system to put a file, or the names in a folder, on disk.

    Raises:
        OSError: it could not.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _checked_facts(recording: Recording, said: Mapping[str, Any]) -> dict[str, Any]:
    """Return what `run.json` shall say.

    Raises:
        RecordingError: the recording says what no run can be.
    """
    try:
        facts = run_facts(recording, said)
        datetime.fromisoformat(facts["created"])
        made_by = recording.provenance
    except (ValueError, TypeError, KeyError) as error:
        raise RecordingError(
            f"{recording.path}: what it says of its run makes no sense ({error})."
        ) from error
    named = all(re.fullmatch(NAME_PATTERN, facts[key]) for key in ("run_id", "name"))
    if not named or not 0 <= facts["seed"] < 1 << 64:
        raise RecordingError(
            f"{recording.path}: found the run {facts['run_id'][:100]!r} ({facts['name'][:100]!r}, seed "
            f"{facts['seed']}), expected {NAME_EXPECTED}; a seed of 64 bits."
        )
    return facts | {"provenance": {key: made_by[key] for key in MADE_BY if key in made_by}}


def _link(source: Path, target: Path) -> None:
    """Give a file a second name, or a copy of it on a disk that has no second names."""
    with contextlib.suppress(OSError):
        os.link(source, target)
        return
    try:
        shutil.copyfile(source, target)
    except OSError as error:
        raise StorageError(f"{target}: cannot be written ({error.strerror}).") from error
