"""A run that is there already when one of its id comes: the same, further on, or to be gone on with."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from runner.errors import RecordingError, RunnerError, StorageError
from runner.recording.rewriting import content_of, continues
from runner.runs.catalogue.lookup import with_id
from runner.runs.labels import MAX_TAGS, Labels, change_labels
from runner.runs.locking import locked
from runner.runs.run import RECORDING_FILE, RUN_FILE, Run, run_at, runs_in
from runner.util.files import sync, write_whole

UNFINISHED: Final = ("interrupted", "failed")
"""What the status of a run is that can be gone on with."""


class Occupied(RunnerError):
    """Another run of this id is there already: `run`."""

    def __init__(self, run: Run, recordings: Path) -> None:
        super().__init__(
            f"{recordings}: found another run {run.run_id} ({run.title}, {run.status}), "
            "whose content is not that of the one to come"
        )
        self.run = run


def known(run_id: str, content_digest: str, recordings: Path) -> Run | None:
    """Return the run of this id that is there already with this content; None if its place is free.

    Raises:
        Occupied: one of this id and other content is there.
        StorageError: something that is no run has its place.
    """
    taken = with_id(run_id, recordings)
    found = taken and next(runs_in(Path(taken.root, taken.entry)), None)
    if found is None:
        if os.path.lexists(recordings / run_id):
            raise StorageError(f"{recordings / run_id}: is there already and is no run; move it away.")
        return None
    with contextlib.suppress(RecordingError):
        if content_of(found.recording) == content_digest:
            return found
    raise Occupied(found, recordings)


def met(occupied: Occupied, recording: Path, facts: Mapping[str, Any], labels: Labels) -> tuple[Run, bool]:
    """Return the run that is there, and whether it was left as it is, as all that comes is in it already.

    If it did not come to its end, and what comes continues it, that takes its recording's place.

    Raises:
        Occupied: neither of the two holds the other.
        RunnerError: another process is at it.
        StorageError: the folder cannot be written; nothing was lost.
    """
    there = occupied.run
    if there.status in (*UNFINISHED, "finished") and not there.stands_alone:
        with contextlib.suppress(RecordingError):
            if continues(there.recording, recording):
                return there, True
    return _continued(occupied, recording, facts, labels), False


def _continued(occupied: Occupied, recording: Path, facts: Mapping[str, Any], labels: Labels) -> Run:
    """Return a run that is there, its recording replaced by one that goes on where it ends.

    Should this be cut short, `settled` does the rest when the same recording comes again.

    Raises:
        Occupied: the recording does not go on with it, or it is finished.
        RunnerError: another process is at it.
        StorageError: the folder cannot be written; nothing was lost.
    """
    if occupied.run.status not in UNFINISHED or occupied.run.stands_alone:
        raise occupied
    with locked(occupied.run) as run:
        if run.status not in UNFINISHED or not continues(recording, run.recording):
            raise occupied
        change_labels(run.folder, lambda said: _merged(said, labels))
        fresh = run.folder / f".{RECORDING_FILE}.fresh"
        try:
            fresh.unlink(missing_ok=True)
            link(recording, fresh)
            sync(fresh)
            fresh.replace(run.recording)
            continued = _with_facts(run, facts)
            sync(run.folder)
        except OSError as error:
            raise StorageError(f"{run.folder}: cannot be written ({error.strerror}).") from error
        finally:
            fresh.unlink(missing_ok=True)
        return continued


def settled(run: Run, facts: Mapping[str, Any]) -> Run:
    """Return a run that is there; if it has come to its end but does not say so, it does now."""
    if facts["status"] != "finished" or run.status not in UNFINISHED or run.stands_alone:
        return run
    with locked(run) as there:
        return _with_facts(there, facts) if there.status in UNFINISHED else there


def _with_facts(run: Run, facts: Mapping[str, Any]) -> Run:
    """Return a run that says of itself what came; what is its folder's own, it keeps."""
    kept = {key: value for key, value in run.facts.items() if key not in ("owner", "proof", "summary")}
    write_whole(run.folder / RUN_FILE, kept | dict(facts))
    return run_at(run.folder)


def _merged(said: Labels, more: Labels) -> Labels:
    """Return what is said of a run here and elsewhere; here, where only one of the two can hold."""
    tags = tuple(sorted({*said.tags, *more.tags})[:MAX_TAGS])
    return Labels(said.name or more.name, tags, said.note or more.note)


def link(source: Path, target: Path) -> None:
    """Give a file a second name, or a copy of it on a disk that has no second names."""
    with contextlib.suppress(OSError):
        os.link(source, target)
        return
    try:
        shutil.copyfile(source, target)
    except OSError as error:
        raise StorageError(f"{target}: cannot be written ({error.strerror}).") from error
