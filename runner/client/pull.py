"""Pulling a run from a server: resumed where it was interrupted, and verified before it is stored."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Final
from urllib.parse import quote

from blake3 import blake3
from filelock import FileLock, Timeout

from runner.client.connection import Connection, Report, ServerUnavailable
from runner.errors import RecordingError, RunnerError
from runner.runs.importing import Imported, import_recording
from runner.runs.run import Run
from runner.runs.store import Store
from runner.util.files import require_room, storage_errors

FOLDER: Final = ".pulling"


def pull(client: Connection, name: str, recordings: Path, report: Report = lambda *_: None) -> Imported:
    """Download a run with its labels and marks into a recordings folder.

    Args:
        client: a connection to the server.
        name: a run as the server knows it: its id, the beginning of one, its name, @latest.
        recordings: the recordings folder; created if it is missing.
        report: called with the progress.

    Raises:
        ServerError: the server has no such run, or was unavailable for too long; what was received stays.
        RecordingError: the file is not a sound recording.
        RunnerError: the run is running, or another run of its id is here.
        StorageError: the folder cannot be written, or has no room.
    """
    facts = client.request_object("GET", f"/runs/{quote(name, safe='')}")
    try:
        run_id, status = str(facts["run_id"]), str(facts["status"])
        if status == "running":
            raise RunnerError(f"run {run_id} is running at {client.url}; wait for its end.")
        path = f"/runs/{quote(run_id, safe='')}/recording"
        head = client.request("HEAD", path)
        tag, size = head.headers["etag"], int(head.headers["content-length"])
    except (ValueError, KeyError) as error:
        raise client.unexpected_response() from error
    folder = recordings / FOLDER
    part = folder / f"{blake3(f'{client.url}{path} {tag}'.encode()).hexdigest()[:32]}.part"
    busy = RunnerError(f"run {run_id} is being pulled by another process; try again when it has finished.")
    lock = part.with_suffix(".lock")
    with storage_errors(recordings):
        folder.mkdir(parents=True, exist_ok=True)
        try:
            with FileLock(lock, timeout=0):
                _download(client, path, tag, size, part, report)
                summary = {key: facts.get(key) for key in ("seconds", "error", "bytes")}
                labels = {key: facts.get(key) for key in ("name", "tags", "note")}
                marks = {"marks": facts.get("marks"), "removed": facts.get("removed_marks")}
                # The name of the run itself is that in its recording.
                details = {"status": status, "summary": summary, "labels": labels, "marks": marks}
                imported = import_recording(part, recordings, details)
                part.unlink()
                _pull_contents(client, imported.run, report)
        except Timeout:
            raise busy from None
        except RecordingError as error:
            part.unlink(missing_ok=True)
            message = str(error).replace(str(part), f"run {run_id} of {client.url}")
            raise RecordingError(message) from error
        lock.unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # another pull is in progress, or was interrupted
        folder.rmdir()
    return imported


def _pull_contents(client: Connection, run: Run, report: Report) -> None:
    """Download the contents of a run's checkpoints that are at the server and not here."""
    store = Store(run.folder.parent)
    wanted = {checkpoint.digest: checkpoint for checkpoint in run.checkpoints() if not checkpoint.is_here}
    if not wanted:
        return
    listed = client.request_object("GET", f"/runs/{quote(run.run_id, safe='')}/checkpoints")
    there = {checkpoint["digest"] for checkpoint in listed["checkpoints"] if checkpoint["here"]}
    for digest, checkpoint in wanted.items():
        if digest in there:
            part = run.folder.parent / FOLDER / f"{run.folder.name}-{digest}.part"
            path = f"/runs/{quote(run.run_id, safe='')}/checkpoints/{digest}"
            _download(client, path, f'"{digest}"', checkpoint.size, part, report)
            try:
                store.put(run.folder.name, part, expected=digest)
            finally:
                part.unlink()


def _download(client: Connection, path: str, tag: str, size: int, part: Path, report: Report) -> None:
    """Download a file, from where it was interrupted the last time.

    Raises:
        StorageError: there is no room.
    """
    backoff = client.backoff()
    with part.open("ab") as stream:
        require_room(part.parent.parent, size - stream.tell())
        while stream.tell() < size:
            try:
                for piece in client.download(path, tag, stream.tell(), size):
                    stream.write(piece)
                    backoff.reset()
                    report(stream.tell(), size)
            except ServerUnavailable as error:
                backoff.wait(error)
