"""A client of the service: submits jobs, pushes and pulls runs, and continues when a connection breaks.

    from runner.client.client import Client

    with Client("http://localhost:8000") as client:
        client.push(runner.find_run("@latest", Path("recordings")))

Bytes that were sent before a connection broke are not sent again; the same run pushed twice is stored once.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, Self, TypeVar
from urllib.parse import quote, urlsplit

from blake3 import blake3
from filelock import FileLock, Timeout
from pydantic import TypeAdapter

from runner.client.jobs import JobEvent, JobsPage, JobStatus, parse_events
from runner.errors import RecordingError, RunnerError
from runner.runs.checkpoints import Store
from runner.runs.importing import Imported, import_record, import_recording
from runner.runs.run import Run
from runner.util.extras import require
from runner.util.files import hash_of, require_room, storage_errors
from runner.util.values import Json

if TYPE_CHECKING:
    import httpx2

API: Final = "/api/v1"
READ_BYTES: Final = 1 << 20
TOKEN_VARIABLE: Final = "DUALTAXI_TOKEN"
TOKEN_FILE_VARIABLE: Final = "DUALTAXI_TOKEN_FILE"
_HOW_TO_GIVE_A_TOKEN: Final = (
    f"give a token by --token, --token-file, ${TOKEN_VARIABLE} or a file named by ${TOKEN_FILE_VARIABLE}."
)
_MAX_TOKEN_FILE: Final = 4096
FIRST_PAUSE: Final = 0.2
LONGEST_PAUSE: Final = 5.0
LOGGED_PAUSE: Final = 1.0
"""The reason for a pause of this length is logged."""
_TEMPORARY: Final = (408, 429, 500, 502, 503, 504, 507)
"""Status codes after which the same request may succeed later."""
_NOT_THE_REQUEST: Final = (408, 425, 429)
"""Status codes of refusals that say nothing against the request: too slow, too early, too many."""
PIECE: Final = 16 << 20
"""Maximum number of bytes of a request; a proxy in front of the server must accept them."""
POLL_SECONDS: Final = 1.0
"""The longest pause before a server is asked again whether it has verified an upload."""
_PULLING_FOLDER: Final = ".pulling"

Record = TypeVar("Record")
Report = Callable[[int, int], object]
"""Called with the bytes transferred so far, and the bytes in total."""


class ServerError(RunnerError):
    """A server refuses a request; the message contains its own.

    The status is 0 if there was no response; `retry_seconds` is the time after which the server asks to try
    again, 0 if it does not.
    """

    exit_code = 1

    def __init__(self, message: str, status: int = 0, retry_seconds: float = 0.0) -> None:
        super().__init__(message)
        if 400 <= status < 500 and status not in _NOT_THE_REQUEST:
            self.exit_code = RunnerError.exit_code  # the request was wrong, not the server
        self.status = status
        self.retry_seconds = retry_seconds


class ServerUnavailable(ServerError):
    """A server does not respond, or cannot do what was requested at present."""


class Backoff:
    """Waits ever longer while a server is unavailable, at least as long as the server asks, up to a limit.

    The timeout is how long the server may be unavailable, in seconds; `log` is called with the reason for a
    longer pause.
    """

    def __init__(self, timeout: float, log: Callable[[str], object] = lambda _: None) -> None:
        self._timeout = timeout
        self._log = log
        self.reset()

    def reset(self) -> None:
        """Start again: the server is available."""
        self._end: float | None = None
        self._pause = FIRST_PAUSE
        self._logged = ""

    def wait(self, error: ServerError) -> None:
        """Pause after an error; raise it when the time is up."""
        now = time.monotonic()
        self._end = now + self._timeout if self._end is None else self._end
        pause = max(self._pause, error.retry_seconds)
        if now + pause > self._end:
            raise error
        if pause >= LOGGED_PAUSE and str(error) != self._logged:
            self._logged = str(error)
            self._log(f"{error} Trying again, for {self._end - now:.0f} s at most.")
        time.sleep(pause)
        self._pause = min(2 * self._pause, LONGEST_PAUSE)


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


class Client:
    """A connection to a server, with everything that can be requested of it; a context manager.

    Args:
        url: its address, such as `http://localhost:8000`.
        token: the access token; `find_token()` looks where one is usually kept.
        retry_timeout: how many seconds to keep retrying while the server is unavailable.
        log: called with a message while it waits.

    Raises:
        RunnerError: the address is not one of a server.
        MissingExtra: HTTPX is not installed.
    """

    def __init__(
        self,
        url: str,
        token: str | None = None,
        retry_timeout: float = 60.0,
        log: Callable[[str], object] = lambda _: None,
    ) -> None:
        self.url = checked_url(url)
        self._retry_timeout = retry_timeout
        self._log = log
        self._has_token = bool(token)
        require("httpx2", extra="service", purpose="speaking to a server")
        import httpx2

        parts = urlsplit(self.url)
        origin = f"{parts.scheme}://{parts.netloc}"
        self._errors = httpx2.TransportError
        self._http = httpx2.Client(
            base_url=self.url + API,
            headers={"Authorization": f"Bearer {token}"} if token else {"Origin": origin},
            timeout=httpx2.Timeout(30.0, read=60.0),
        )

    def close(self) -> None:
        """Close the connection."""
        self._http.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def backoff(self) -> Backoff:
        """Return a new backoff with the limits of this connection."""
        return Backoff(self._retry_timeout, self._log)

    def request(self, method: str, path: str, **options: Any) -> httpx2.Response:
        """Return the response to a request; `options` are those of HTTPX.

        Raises:
            ServerError: the server refuses it.
            ServerUnavailable: the server does not respond.
        """
        with self._transport_errors():
            response = self._http.request(method, path, **options)
            self._check(response)
            return response

    def request_record(self, kind: type[Record], method: str, path: str, **options: object) -> Record:
        """Return the dataclass whose fields a server responds with; errors as for `request`."""
        response = self.request(method, path, **options)
        try:
            return TypeAdapter(kind).validate_json(response.content)
        except ValueError as error:
            raise self.unexpected_response() from error

    @contextlib.contextmanager
    def stream(self, path: str, headers: Mapping[str, str]) -> Iterator[httpx2.Response]:
        """Yield a response that is read as it arrives; errors as for `request`, also while it is read."""
        with self._transport_errors(), self._http.stream("GET", path, headers=dict(headers)) as response:
            if not response.is_success:
                response.read()
            self._check(response)
            yield response

    def download(self, path: str, tag: str, offset: int, size: int) -> Iterator[bytes]:
        """Yield the bytes of a file of `size` bytes, whose ETag is `tag`, from an offset on.

        Raises:
            ServerError: it has changed, or the server is unavailable.
        """
        headers = {"Range": f"bytes={offset}-", "If-Range": tag, "Accept-Encoding": "identity"}
        with self.stream(path, headers) as response:
            if response.headers.get("content-range") != f"bytes {offset}-{size - 1}/{size}":
                raise ServerError(f"{self.url}: the recording has changed meanwhile; pull it again.")
            yield from response.iter_raw(READ_BYTES)

    def unexpected_response(self) -> ServerError:
        """Return the error that a response is not that of this service."""
        return ServerError(f"{self.url}: found an unexpected response; is it a dualtaxi server?")

    @contextlib.contextmanager
    def _transport_errors(self) -> Iterator[None]:
        try:
            yield
        except self._errors as error:
            raise ServerUnavailable(
                f"{self.url}: does not answer ({error or type(error).__name__})."
            ) from error

    def _check(self, response: httpx2.Response) -> None:
        if response.is_success:
            return
        message = f"answers {response.status_code} {response.reason_phrase}; is it a dualtaxi server?"
        with contextlib.suppress(ValueError, KeyError, TypeError):
            message = str(response.json()["error"]["message"])
        if response.status_code == HTTPStatus.UNAUTHORIZED and not self._has_token:
            message = f"needs a token, found none; {_HOW_TO_GIVE_A_TOKEN}"
        kind = ServerUnavailable if response.status_code in _TEMPORARY else ServerError
        retry = response.headers.get("retry-after", "")
        seconds = float(retry) if retry.isdecimal() else 0.0
        raise kind(f"{self.url}: {message}", response.status_code, seconds)

    # --- jobs -----------------------------------------------------------------------------------------

    def submit(self, text: str, source: str = "job.yaml", workers: int | None = None) -> JobStatus:
        """Submit the text of a configuration or a sweep; `source` is the file's name, for messages.

        A sweep holds that many `workers` of the server while it is running, all of them by default.

        Raises:
            ServerError: it was refused, each mistake with its line; or the server is unavailable.
        """
        params = {"source": source} | ({} if workers is None else {"workers": workers})
        options = {"params": params, "content": text.encode()}
        return self.request_record(JobStatus, "POST", "/jobs", **options)

    def job(self, number: int) -> JobStatus:
        """Return a job; errors as for `request`."""
        return self.request_record(JobStatus, "GET", f"/jobs/{number}")

    def jobs(self, limit: int = 50, offset: int = 0) -> list[JobStatus]:
        """Return jobs, the newest first; errors as for `request`."""
        return self.request_record(JobsPage, "GET", "/jobs", params={"limit": limit, "offset": offset}).jobs

    def cancel(self, number: int) -> JobStatus:
        """Cancel a job; what it has recorded stays. Errors as for `request`."""
        return self.request_record(JobStatus, "POST", f"/jobs/{number}/cancel")

    def resume(self, number: int, accept_changes: bool = False) -> JobStatus:
        """Resume a failed or cancelled job; errors as for `request`."""
        options = {"params": {"accept_changes": accept_changes}}
        return self.request_record(JobStatus, "POST", f"/jobs/{number}/resume", **options)

    def watch(self, number: int) -> Iterator[JobEvent]:
        """Yield the events of a job until it is over; continue when a connection breaks.

        Raises:
            ServerError: there is no such job, or the server refuses.
            ServerUnavailable: the server did not respond in time.
        """
        last = ""
        backoff = self.backoff()
        while True:
            try:
                with self.stream(f"/jobs/{number}/events", {"Last-Event-ID": last}) as response:
                    backoff.reset()
                    if response.status_code == HTTPStatus.NO_CONTENT:
                        return
                    for event in parse_events(response.iter_lines()):
                        last = event.id or last
                        yield event
                if self.request_record(JobStatus, "GET", f"/jobs/{number}").is_over:
                    return
                time.sleep(FIRST_PAUSE)
            except ServerUnavailable as error:
                backoff.wait(error)

    # --- runs -----------------------------------------------------------------------------------------

    def push(self, run: Run, report: Report = lambda *_: None, begun: str = "") -> UploadStatus:
        """Upload a run that is over, with the contents of its checkpoints; return the result once stored.

        Args:
            report: called with the progress.
            begun: the id of an upload that has the first bytes already.

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
        source: Json = {"digest": digest, "size": size, "name": run.name, "run_id": run.run_id}
        source["content_digest"] = run.summary.content_digest
        source["run"] = {} if run.stands_alone else import_record(run)
        upload = _send(self, begun or digest, source, run.recording, f"the run {run.run_id}", report)
        by_digest = {checkpoint.digest: checkpoint for checkpoint in run.checkpoints() if checkpoint.is_here}
        for checkpoint in by_digest.values():
            source = {"digest": checkpoint.digest, "size": checkpoint.size, "checkpoint_of": upload.run_id}
            _send(self, checkpoint.digest, source, checkpoint.path, checkpoint.reference, report)
        return upload

    def pull(self, name: str, recordings: Path, report: Report = lambda *_: None) -> Imported:
        """Download a run with its labels and marks into a recordings folder.

        Args:
            name: a run as the server knows it: its id, the beginning of one, its name, @latest.
            recordings: the recordings folder; created if it is missing.
            report: called with the progress.

        Raises:
            ServerError: the server has no such run, or was unavailable for too long; what was received stays.
            RecordingError: the file is not a sound recording.
            RunnerError: the run is running, or another run of its id is here.
            StorageError: the folder cannot be written, or has no room.
        """
        facts = self.request_record(dict, "GET", f"/runs/{quote(name, safe='')}")
        try:
            run_id, status = str(facts["run_id"]), str(facts["status"])
            if status == "running":
                raise RunnerError(f"run {run_id} is running at {self.url}; wait for its end.")
            path = f"/runs/{quote(run_id, safe='')}/recording"
            head = self.request("HEAD", path)
            tag, size = head.headers["etag"], int(head.headers["content-length"])
        except (ValueError, KeyError) as error:
            raise self.unexpected_response() from error
        folder = recordings / _PULLING_FOLDER
        part = folder / f"{blake3(f'{self.url}{path} {tag}'.encode()).hexdigest()[:32]}.part"
        lock = part.with_suffix(".lock")
        with storage_errors(recordings):
            folder.mkdir(parents=True, exist_ok=True)
            try:
                with FileLock(lock, timeout=0):
                    _download(self, path, tag, size, part, report)
                    summary = {key: facts.get(key) for key in ("seconds", "error", "bytes")}
                    labels = {key: facts.get(key) for key in ("name", "tags", "note")}
                    marks = {"marks": facts.get("marks"), "removed": facts.get("removed_marks")}
                    # The name of the run itself is that in its recording.
                    details = {"status": status, "summary": summary, "labels": labels, "marks": marks}
                    imported = import_recording(part, recordings, details)
                    part.unlink()
                    _pull_contents(self, imported.run, report)
            except Timeout:
                raise RunnerError(
                    f"run {run_id} is being pulled by another process; try again when it has finished."
                ) from None
            except RecordingError as error:
                part.unlink(missing_ok=True)
                message = str(error).replace(str(part), f"run {run_id} of {self.url}")
                raise RecordingError(message) from error
            lock.unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # another pull is in progress, or was interrupted
            folder.rmdir()
        return imported


def _send(
    server: Client, upload_id: str, source: Json, path: Path, what: str, report: Report
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


def put_upload(server: Client, upload_id: str, **source: object) -> UploadStatus:
    """Begin or continue an upload, with the fields of `UploadSource` that are known; return its state.

    The id has 64 hexadecimal digits: the BLAKE3 of the file, or random ones while it is growing.
    """
    return server.request_record(UploadStatus, "PUT", f"/uploads/{upload_id}", json=source)


def append_upload(server: Client, upload: UploadStatus, path: Path, end: int) -> UploadStatus:
    """Send the next piece of a file, not beyond an offset.

    Raises:
        RunnerError: the file has become shorter, or as `Client.request`.
    """
    with path.open("rb") as stream:
        stream.seek(upload.offset)
        piece = stream.read(min(end - upload.offset, PIECE))
    if not piece:
        raise RunnerError(f"{path}: became shorter while it was sent; try again.")
    options = {"content": piece, "headers": {"Upload-Offset": str(upload.offset)}}
    return server.request_record(UploadStatus, "PATCH", f"/uploads/{upload.id}", **options)


def _pull_contents(client: Client, run: Run, report: Report) -> None:
    """Download the contents of a run's checkpoints that are at the server and not here."""
    store = Store(run.folder.parent)
    wanted = {checkpoint.digest: checkpoint for checkpoint in run.checkpoints() if not checkpoint.is_here}
    if not wanted:
        return
    listed = client.request_record(dict, "GET", f"/runs/{quote(run.run_id, safe='')}/checkpoints")
    there = {checkpoint["digest"] for checkpoint in listed["checkpoints"] if checkpoint["here"]}
    for digest, checkpoint in wanted.items():
        if digest in there:
            part = run.folder.parent / _PULLING_FOLDER / f"{run.folder.name}-{digest}.part"
            path = f"/runs/{quote(run.run_id, safe='')}/checkpoints/{digest}"
            _download(client, path, f'"{digest}"', checkpoint.size, part, report)
            try:
                store.put(run.folder.name, part, expected=digest)
            finally:
                part.unlink()


def _download(client: Client, path: str, tag: str, size: int, part: Path, report: Report) -> None:
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


def checked_url(url: str) -> str:
    """Return the address of a server, without a slash at its end.

    Raises:
        RunnerError: it is none.
    """
    parts = urlsplit(url)
    if parts.scheme not in ("http", "https") or not parts.hostname or parts.query or parts.fragment:
        raise RunnerError(f"server: found {url!r}, expected an address such as http://localhost:8000.")
    if parts.username is not None or parts.password is not None:
        raise RunnerError(
            f"server: found a name or password in the address of {parts.hostname}, expected none; "
            f"{_HOW_TO_GIVE_A_TOKEN}"
        )
    return url.rstrip("/")


def find_token(token: str | None = None, file: Path | None = None) -> str | None:
    """Return the given token, or that in a file, else that of the environment variables; None without any.

    Raises:
        RunnerError: it is no token, or its file cannot be read.
    """
    if token is None and file is None:
        token, named = os.environ.get(TOKEN_VARIABLE), os.environ.get(TOKEN_FILE_VARIABLE)
        file = Path(named) if named else None
    source = "token"
    if not token:
        if file is None:
            return None
        source = os.fspath(file)
        try:
            with file.open(encoding="utf-8") as stream:
                token = stream.read(_MAX_TOKEN_FILE)
        except (OSError, ValueError) as error:
            raise RunnerError(f"{file}: cannot be read, expected a file with a token.") from error
    token = token.strip()
    if not token or not token.isascii() or not token.isprintable() or " " in token:
        raise RunnerError(f"{source}: found no token, expected one line of letters and digits.")
    return token
