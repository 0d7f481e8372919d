"""A client of the service: submits jobs, pushes and pulls runs, and continues when a connection breaks.

    from runner.client.client import Client

    with Client("http://localhost:8000") as client:
        client.push(runner.find_run("@latest", Path("recordings")))

Bytes that were sent before a connection broke are not sent again; the same run pushed twice is stored once.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from runner.client.connection import READ_BYTES, Connection, Report, ServerError, ServerUnavailable
from runner.client.jobs import JobEvent, RemoteJob, watch
from runner.client.pull import pull
from runner.errors import RunnerError
from runner.recording.labels import as_json
from runner.runs.run import Run
from runner.util.files import hash_of
from runner.util.values import Json

if TYPE_CHECKING:
    from runner.runs.importing import Imported

PIECE: Final = 32 << 20
"""Maximum number of bytes of a request; a proxy in front of the server must accept them."""
_WAIT_SECONDS: Final = 20
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


class Client(Connection):
    """A connection to a server, with everything that can be requested of it."""

    # --- jobs -----------------------------------------------------------------------------------------

    def submit(self, text: str, source: str = "job.yaml") -> RemoteJob:
        """Submit the text of a configuration or a sweep; `source` is the file's name, for messages.

        Raises:
            ServerError: it was refused, each mistake with its line; or the server is unavailable.
        """
        options = {"params": {"source": source}, "content": text.encode()}
        return RemoteJob.from_json(self.request_object("POST", "/jobs", **options))

    def job(self, number: int) -> RemoteJob:
        """Return a job; errors as for `request`."""
        return RemoteJob.from_json(self.request_object("GET", f"/jobs/{number}"))

    def jobs(self, limit: int = 50, offset: int = 0) -> list[RemoteJob]:
        """Return jobs, the newest first; errors as for `request`."""
        page = self.request_object("GET", "/jobs", params={"limit": limit, "offset": offset})
        return [RemoteJob.from_json(job) for job in page["jobs"]]

    def watch(self, number: int) -> Iterator[JobEvent]:
        """Yield the events of a job until it is over; see `runner.client.jobs.watch`."""
        return watch(self, number)

    def cancel(self, number: int) -> RemoteJob:
        """Cancel a job; what it has recorded stays. Errors as for `request`."""
        return RemoteJob.from_json(self.request_object("POST", f"/jobs/{number}/cancel"))

    def resume(self, number: int, accept_changes: bool = False) -> RemoteJob:
        """Resume a failed or cancelled job; errors as for `request`."""
        options = {"params": {"accept_changes": accept_changes}}
        return RemoteJob.from_json(self.request_object("POST", f"/jobs/{number}/resume", **options))

    # --- runs -----------------------------------------------------------------------------------------

    def pull(self, name: str, recordings: Path, report: Report = lambda *_: None) -> Imported:
        """Download a run into a recordings folder; see `runner.client.pull.pull`."""
        return pull(self, name, recordings, report)

    def push(
        self, run: Run, report: Report = lambda *_: None, begun: UploadStatus | None = None
    ) -> UploadStatus:
        """Upload a run, and return the result when the server has verified and stored it.

        Args:
            run: a run that is over.
            report: called with the progress.
            begun: an upload that has its first bytes already.

        Raises:
            ServerError: it was refused, with the reason.
            ServerUnavailable: the server did not respond in time; it keeps what it has received.
            RunnerError: the run is running, or in an archive only, or cannot be read.
        """
        if run.status not in ("finished", "interrupted", "failed"):
            raise RunnerError(
                f"run {run.run_id} is {run.status}; only one that is over and here can be pushed."
            )
        try:
            size, digest = hash_of(run.recording)
        except OSError as error:
            raise RunnerError(f"{run.recording}: cannot be read ({error.strerror}).") from error
        announced = {"digest": digest, "size": size, "name": run.name, "run_id": run.run_id}
        announced["content_digest"] = run.summary.content_digest
        upload = self._deliver(run.recording, announced, _about(run), report, begun)
        if upload.state == "refused" and begun is not None:  # the file has changed since it began
            upload = self._deliver(run.recording, announced, _about(run), report, None)
        if upload.state == "refused":
            raise ServerError(f"{self.url}: refused the run {run.run_id}: {upload.problem}")
        for checkpoint in {each.digest: each for each in run.checkpoints() if each.is_here}.values():
            announced = {"digest": checkpoint.digest, "size": checkpoint.size, "checkpoint_of": upload.run_id}
            sent = self._deliver(checkpoint.path, announced, {}, report, None)
            if sent.state == "refused":
                raise ServerError(f"{self.url}: refused {checkpoint.reference}: {sent.problem}")
        return upload

    def _deliver(
        self, path: Path, announced: Json, about: Json, report: Report, begun: UploadStatus | None
    ) -> UploadStatus:
        """Take the next step of an upload until it is stored or refused, and return it.

        After a step that failed for now, the upload is taken up again as the server has it.
        """
        size = announced["size"]
        upload, furthest, backoff = None, -1, self.backoff()
        while upload is None or upload.state not in ("stored", "refused"):
            try:
                if upload is None:
                    upload = begun = self.upload_status(begun) if begun else self.begin_upload(**announced)
                elif upload.state == "verifying":
                    upload = self.upload_status(upload, _WAIT_SECONDS)
                    if upload.state == "receiving" and upload.problem:
                        raise ServerUnavailable(f"{self.url}: {upload.problem}")
                elif upload.offset < size:
                    upload = self.append_upload(upload, path, size)
                elif upload.offset == size:
                    upload = self.complete_upload(upload, size, announced["digest"], about)
                else:  # the file became shorter, as one does whose disk was full
                    self.delete_upload(upload)
                    upload = begun = None
                    continue
            except ServerError as error:
                is_lost = error.status == HTTPStatus.NOT_FOUND
                is_behind = error.status == HTTPStatus.CONFLICT
                if not (is_lost or is_behind or isinstance(error, ServerUnavailable)):
                    raise
                backoff.wait(error)
                upload, begun = None, None if is_lost else begun
                continue
            if upload.offset > furthest:
                furthest = upload.offset
                backoff.reset()
            report(upload.offset, size)
        return upload

    # --- the steps of an upload -------------------------------------------------------------------------

    def begin_upload(self, **announced: object) -> UploadStatus:
        """Begin an upload, or find the one of the same bytes; errors as for `request`."""
        known = {key: value for key, value in announced.items() if value not in (None, "")}
        return self._upload("POST", "/uploads", json=known)

    def append_upload(self, upload: UploadStatus, path: Path, end: int) -> UploadStatus:
        """Send the next piece of a file, not beyond an offset; errors as for `request`."""
        size = min(end - upload.offset, PIECE)
        headers = {"Upload-Offset": str(upload.offset), "Content-Length": str(size)}
        content = _read_pieces(path, upload.offset, size)
        return self._upload("PATCH", f"/uploads/{upload.id}", content=content, headers=headers)

    def upload_status(self, upload: UploadStatus, wait: float = 0) -> UploadStatus:
        """Return the state of an upload; wait up to some seconds for its verification."""
        return self._upload("GET", f"/uploads/{upload.id}", params={"wait": wait})

    def complete_upload(
        self, upload: UploadStatus, size: int, digest: str, about: dict[str, object] | None = None
    ) -> UploadStatus:
        """Complete an upload, so that it is verified; errors as for `request`.

        `digest` is the BLAKE3 of all bytes; `about` is what the run's folder has and its recording does not.
        """
        completion = {"digest": digest, "size": size} | (about or {})
        return self._upload("POST", f"/uploads/{upload.id}/complete", json=completion)

    def delete_upload(self, upload: UploadStatus) -> None:
        """Delete an upload; errors as for `request`."""
        self.request("DELETE", f"/uploads/{upload.id}")

    def _upload(self, method: str, path: str, **options: object) -> UploadStatus:
        response = self.request_object(method, path, **options)
        try:
            return UploadStatus(**{field.name: response[field.name] for field in fields(UploadStatus)})
        except KeyError as error:
            raise self.unexpected_response() from error


def _about(run: Run) -> dict[str, object]:
    """Return what a run's folder has and its recording does not."""
    if run.stands_alone:  # an exported recording carries its own record of the run
        return {}
    summary = {"seconds": run.summary.seconds, "error": run.summary.error}
    facts = {"name": run.file.name, "status": run.status, "proof": run.file.proof, "summary": summary}
    return {"run": facts, "labels": as_json(run.labels)}


def _read_pieces(path: Path, offset: int, size: int) -> Iterator[bytes]:
    """Yield `size` bytes of a file.

    Raises:
        RunnerError: there are fewer.
    """
    with path.open("rb") as stream:
        stream.seek(offset)
        while size:
            piece = stream.read(min(READ_BYTES, size))
            if not piece:
                raise RunnerError(f"{path}: became shorter while it was sent; try again.")
            size -= len(piece)
            yield piece
