"""Pushing runs to a server, and pulling them: resumed where interrupted, verified before they are stored."""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass, replace
from http import HTTPStatus
from pathlib import Path
from typing import Final, Literal
from urllib.parse import quote

from blake3 import blake3
from filelock import FileLock, Timeout

from runner.client.connection import Connection, Report, ServerError, ServerUnavailable
from runner.errors import RecordingError, RunnerError
from runner.runs.checkpoints import Store
from runner.runs.importing import Imported, import_record, import_recording
from runner.runs.run import Run
from runner.util.files import hash_of, require_room, storage_errors
from runner.util.values import Json

PIECE: Final = 16 << 20
"""Maximum number of bytes of a request; a proxy in front of the server must accept them."""
POLL_SECONDS: Final = 1.0
"""The longest pause before a server is asked again whether it has verified an upload."""
UploadState = Literal["receiving", "verifying", "stored", "refused"]


@dataclass(frozen=True)
class UploadStatus:
    """An upload and its state, as clients see them."""

    id: str
    state: UploadState = "receiving"
    offset: int = 0
    """Number of bytes received: the next ones begin here."""
    size: int | None = None
    """Number of bytes when it is complete, if that is known."""
    name: str = ""
    run_id: str = ""
    """The announced run; when it is stored, the run that it is."""
    already: bool = False
    """Whether that run was there before."""
    problem: str = ""
    """Why it was refused; of one that is being received again, why it could not be stored."""
    created: str = ""
    """In UTC, as ISO 8601."""
    stop_requested: bool = False
    """Whether the loop that records the run is requested to stop."""

    @property
    def is_over(self) -> bool:
        """Whether its result is final."""
        return self.state in ("stored", "refused")


def push(server: Connection, run: Run, report: Report = lambda *_: None, begun: str = "") -> UploadStatus:
    """Upload a run that is over, with the contents of its checkpoints; return the result when it is stored.

    `report` is called with the progress; `begun` is the id of an upload that has the first bytes already.

    Raises:
        ServerError: it was refused, with the reason.
        ServerUnavailable: the server did not respond in time; it keeps what it has received.
        RunnerError: the run is running, or in an archive only, or cannot be read.
    """
    if run.status not in ("finished", "interrupted", "failed"):
        raise RunnerError(f"run {run.run_id} is {run.status}; only one that is over and here can be pushed.")
    try:
        size, digest = hash_of(run.recording)
    except OSError as error:
        raise RunnerError(f"{run.recording}: cannot be read ({error.strerror}).") from error
    source: Json = {"digest": digest, "size": size, "name": run.name, "run_id": run.run_id}
    source["content_digest"] = run.summary.content_digest
    source["run"] = {} if run.stands_alone else import_record(run)
    upload = _send(server, begun or digest, source, run.recording, f"the run {run.run_id}", report)
    by_digest = {checkpoint.digest: checkpoint for checkpoint in run.checkpoints() if checkpoint.is_here}
    for checkpoint in by_digest.values():
        source = {"digest": checkpoint.digest, "size": checkpoint.size, "checkpoint_of": upload.run_id}
        _send(server, checkpoint.digest, source, checkpoint.path, checkpoint.reference, report)
    return upload


def _send(
    server: Connection, upload_id: str, source: Json, path: Path, what: str, report: Report
) -> UploadStatus:
    """Upload a file until it is stored; what fails for now is repeated."""
    furthest = -1
    pause = POLL_SECONDS / 16
    backoff = server.backoff()
    is_new = True
    while True:
        try:
            upload = put_upload(server, upload_id, **source)
            if upload.state == "stored":
                return replace(upload, already=upload.already or is_new)
            if upload.state == "refused":
                if upload_id == source["digest"] and not is_new:
                    raise ServerError(f"{server.url}: refused {what}: {upload.problem}")
                # By an earlier push, or because its file has changed since it began.
                server.request("DELETE", f"/uploads/{upload_id}")
                upload_id = source["digest"]
                is_new = True
                continue
            is_new = False
            while upload.state == "receiving":
                if upload.offset > furthest:
                    furthest = upload.offset
                    backoff.reset()
                upload = append_upload(server, upload, path, source["size"])
                report(upload.offset, source["size"])
            time.sleep(pause)
            pause = min(2 * pause, POLL_SECONDS)
        except ServerError as error:
            is_behind = error.status in (HTTPStatus.NOT_FOUND, HTTPStatus.CONFLICT)
            if not (is_behind or isinstance(error, ServerUnavailable)):
                raise
            backoff.wait(error)


def put_upload(server: Connection, upload_id: str, **source: object) -> UploadStatus:
    """Begin or continue an upload, with the fields of `UploadSource` that are known; return its state.

    The id has 64 hexadecimal digits: the BLAKE3 of the file, or random ones while it is growing.
    """
    return server.request_record(UploadStatus, "PUT", f"/uploads/{upload_id}", json=source)


def append_upload(server: Connection, upload: UploadStatus, path: Path, end: int) -> UploadStatus:
    """Send the next piece of a file, not beyond an offset.

    Raises:
        RunnerError: the file has become shorter, or as `Connection.request`.
    """
    with path.open("rb") as stream:
        stream.seek(upload.offset)
        piece = stream.read(min(end - upload.offset, PIECE))
    if not piece:
        raise RunnerError(f"{path}: became shorter while it was sent; try again.")
    options = {"content": piece, "headers": {"Upload-Offset": str(upload.offset)}}
    return server.request_record(UploadStatus, "PATCH", f"/uploads/{upload.id}", **options)


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
