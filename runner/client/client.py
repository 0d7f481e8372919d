"""A client of the service: pushes runs, and pulls them, whatever the connection does meanwhile.

    from runner.client.client import Client

    with Client("http://localhost:8000") as client:
        client.push(runner.find_run("@latest", Path("recordings")))

What was sent before a connection broke is not sent again; the same run pushed twice is there once.
"""

from __future__ import annotations

from collections.abc import Iterator
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Final

from runner.client.backoff import ServerError, ServerUnavailable
from runner.client.connection import READ_BYTES, Connection, Report
from runner.client.jobs import JobEvent, RemoteJob, watch
from runner.client.pull import pull
from runner.client.upload_source import UploadSource, UploadStatus
from runner.errors import RunnerError
from runner.runs.run import Run
from runner.util.files import hash_of

if TYPE_CHECKING:
    import httpx2

    from runner.runs.importing import Imported

PIECE: Final = 32 << 20
"""The bytes of one request at most; a proxy in front of the server must accept them."""
_WAIT_SECONDS: Final = 20


class Client(Connection):
    """A connection to a server, with everything that can be asked of it."""

    # --- jobs -----------------------------------------------------------------------------------------

    def submit(self, text: str, source: str = "job.yaml") -> RemoteJob:
        """Submit the text of a configuration or a sweep; `source` is the file's name, for messages.

        Raises:
            ServerError: it was refused, each mistake with its line; or the server is away.
        """
        return RemoteJob.of(
            self.ask("POST", "/jobs", params={"source": source}, content=text.encode()).json()
        )

    def job(self, number: int) -> RemoteJob:
        """Return how a job stands; errors as of `ask`."""
        return RemoteJob.of(self.ask("GET", f"/jobs/{number}").json())

    def jobs(self, limit: int = 50, offset: int = 0) -> list[RemoteJob]:
        """Return jobs, the newest first; errors as of `ask`."""
        told = self.ask("GET", "/jobs", params={"limit": limit, "offset": offset}).json()
        return [RemoteJob.of(job) for job in told["jobs"]]

    def watch(self, number: int) -> Iterator[JobEvent]:
        """Yield what happens to a job until it is over, as `jobs.watch` does; it says what is raised."""
        return watch(self, number)

    def cancel(self, number: int) -> RemoteJob:
        """Have a job not be done, or stopped; what it has recorded is kept. Errors as of `ask`."""
        return RemoteJob.of(self.ask("POST", f"/jobs/{number}/cancel").json())

    def resume(self, number: int, accept_changes: bool = False) -> RemoteJob:
        """Have a job that failed or was cancelled go on; errors as of `ask`."""
        params = {"accept_changes": accept_changes}
        return RemoteJob.of(self.ask("POST", f"/jobs/{number}/resume", params=params).json())

    # --- pushing --------------------------------------------------------------------------------------

    def push(
        self, source: UploadSource | Run, report: Report = lambda *_: None, begun: UploadStatus | None = None
    ) -> UploadStatus:
        """Send a run, and return what became of it when the server has verified and stored it.

        Args:
            source: a run that is over, or a file with what is said of it.
            report: told the progress.
            begun: the upload that has its beginning already.

        Raises:
            ServerError: it was refused, with the reason.
            ServerUnavailable: the server did not answer in time; it keeps what it has received.
            RunnerError: the run cannot be sent.
        """
        if isinstance(source, Run):
            source = UploadSource.of(source)
        size, digest = _size_and_digest(source.path)
        sent = _Delivery(self, source, size, digest, report, begun).done()
        if sent.state == "refused" and begun is not None:  # the file has become another since it began
            sent = _Delivery(self, source, size, digest, report, None).done()
        if sent.state == "refused":
            raise ServerError(f"{self.url}: refused the run {source.run_id}: {sent.problem}")
        return sent

    def begin(self, **announced: Any) -> UploadStatus:
        """Begin an upload, or find the one of the same bytes.

        Raises:
            ServerError: the server refuses, or is away.
        """
        told = {key: value for key, value in announced.items() if value not in (None, "")}
        return _sent(self.ask("POST", "/uploads", json=told))

    def append(self, sent: UploadStatus, path: Path, end: int) -> UploadStatus:
        """Send what an upload lacks of a file up to some place, in one request; not more than a piece.

        Raises:
            ServerError: the server refuses, or is away.
        """
        size = min(end - sent.offset, PIECE)
        with path.open("rb") as stream:
            stream.seek(sent.offset)
            answer = self.ask(
                "PATCH",
                f"/uploads/{sent.id}",
                content=_pieces(stream, size, path),
                headers={"Upload-Offset": str(sent.offset), "Content-Length": str(size)},
            )
        return UploadStatus(sent.id, sent.state, int(answer.headers["Upload-Offset"]), sent.run_id)

    def standing(self, sent: UploadStatus, wait: float = 0) -> UploadStatus:
        """Return how an upload stands now, or when it is verified.

        Raises:
            ServerError: the server refuses, or is away.
        """
        return _sent(self.ask("GET", f"/uploads/{sent.id}", params={"wait": wait}))

    def complete(self, sent: UploadStatus, source: UploadSource, size: int, digest: str) -> UploadStatus:
        """Say that all is there.

        Raises:
            ServerError: the server refuses, or is away.
        """
        told = {"digest": digest, "size": size, "run": dict(source.run), "labels": dict(source.labels)}
        return _sent(self.ask("POST", f"/uploads/{sent.id}/complete", json=told))

    def give_up(self, sent: UploadStatus) -> None:
        """Have an upload forgotten.

        Raises:
            ServerError: the server refuses, or is away.
        """
        self.ask("DELETE", f"/uploads/{sent.id}")

    # --- pulling --------------------------------------------------------------------------------------

    def pull(self, name: str, recordings: Path, report: Report = lambda *_: None) -> Imported:
        """Bring a run into a folder of runs, as `pull.pull` does; it says what is raised."""
        return pull(self, name, recordings, report)


class _Delivery:
    """A file on its way, step by step; a step that fails is taken again after a while."""

    def __init__(
        self,
        client: Client,
        source: UploadSource,
        size: int,
        digest: str,
        report: Report,
        begun: UploadStatus | None,
    ) -> None:
        self._client, self._parcel, self._report = client, source, report
        self._size, self._digest = size, digest
        self._sent = begun
        self._is_stale = begun is not None

    def done(self) -> UploadStatus:
        """Return the upload when it is stored or refused.

        Raises:
            ServerError: the server refuses the request, or was away for longer than the patience.
        """
        furthest, patience = -1, self._client.patience()
        while True:
            try:
                sent = self._sent = self._step()
                self._is_stale = False
            except ServerError as error:
                if not _may_pass(error):
                    raise
                patience.wait(error)
                self._sent = None if error.status == HTTPStatus.NOT_FOUND else self._sent
                self._is_stale = True
                continue
            if sent.state in ("stored", "refused"):
                return sent
            if sent.offset > furthest:
                furthest = sent.offset
                patience.moved()
            self._report(sent.offset, self._size)

    def _step(self) -> UploadStatus:
        client, sent, source = self._client, self._sent, self._parcel
        if sent is None:
            return self._begun()
        if self._is_stale:
            return client.standing(sent)
        if sent.state == "verifying":
            return self._verified(client.standing(sent, _WAIT_SECONDS))
        if sent.offset > self._size:  # the file became shorter, as one does whose disk was full
            client.give_up(sent)
            return self._begun()
        if sent.offset < self._size:
            return client.append(sent, source.path, self._size)
        return client.complete(sent, source, self._size, self._digest)

    def _begun(self) -> UploadStatus:
        source = self._parcel
        known = {"name": source.name, "run_id": source.run_id, "content_digest": source.content_digest}
        return self._client.begin(digest=self._digest, size=self._size, **known)

    def _verified(self, sent: UploadStatus) -> UploadStatus:
        """Return an upload unless it could not be verified for now."""
        if sent.state == "receiving" and sent.problem:
            raise ServerUnavailable(f"{self._client.url}: {sent.problem}")
        return sent


def _may_pass(error: ServerError) -> bool:
    return isinstance(error, ServerUnavailable) or error.status in (HTTPStatus.NOT_FOUND, HTTPStatus.CONFLICT)


def _size_and_digest(path: Path) -> tuple[int, str]:
    try:
        return hash_of(path)
    except OSError as error:
        raise RunnerError(f"{path}: cannot be read ({error.strerror}).") from error


def _pieces(stream: BinaryIO, size: int, path: Path) -> Iterator[bytes]:
    """Yield so many bytes.

    Raises:
        RunnerError: there are fewer.
    """
    while size:
        piece = stream.read(min(READ_BYTES, size))
        if not piece:
            raise RunnerError(f"{path}: became shorter while it was sent; try again.")
        size -= len(piece)
        yield piece


def _sent(answer: httpx2.Response) -> UploadStatus:
    """Return what an answer says of an upload.

    Raises:
        ServerError: it says something else.
    """
    try:
        told = answer.json()
        return UploadStatus(*(told[key] for key in ("id", "state", "offset", "run_id", "already", "problem")))
    except (ValueError, KeyError, TypeError) as error:
        raise ServerError(
            f"{answer.url}: found another answer than a dualtaxi server gives; is the address right?"
        ) from error
