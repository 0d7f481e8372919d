"""A client of the service: pushes runs, and pulls them, whatever the connection does meanwhile.

    from runner.client.http import Client

    with Client("http://localhost:8000") as client:
        client.push(runner.find_run("@latest", Path("recordings")))

What was sent before a connection broke is not sent again; the same run pushed twice is there once.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Final, Self
from urllib.parse import urlsplit

from runner.client import jobs as watching
from runner.client.address import checked_url
from runner.client.backoff import Patience, ServerAway, ServerError
from runner.client.jobs import Happened, JobThere
from runner.client.upload_source import Parcel, Sent
from runner.errors import RunnerError
from runner.runs.run import Run
from runner.util.extras import require
from runner.util.hashing import hash_of

if TYPE_CHECKING:
    import httpx2

    from runner.packing.admission import Admitted

API: Final = "/api/v1"
PIECE: Final = 32 << 20
"""So much is sent in one request; a proxy in front of the server must let it pass."""
_READ: Final = 1 << 20
_WAIT_SECONDS: Final = 20
_PASSING: Final = (408, 429, 500, 502, 503, 504, 507)
"""What a server answers that may answer otherwise a little later."""

Report = Callable[[int, int], object]
"""Told how many bytes of how many are there."""


class Client:
    """A connection to a server; a context manager.

    Args:
        url: where it is, such as `http://localhost:8000`.
        token: what lets it in; `found_token()` looks for one where it is usually kept.
        patience: for so many seconds it is tried again when the server is away.
        tell: told what is waited for meanwhile.

    Raises:
        RunnerError: it is no address of a server.
        MissingExtra: HTTPX is not installed.
    """

    def __init__(
        self,
        url: str,
        token: str | None = None,
        patience: float = 60.0,
        tell: Callable[[str], object] = lambda _: None,
    ) -> None:
        self.url = checked_url(url)
        self._patience, self._tell = patience, tell
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

    # --- jobs -----------------------------------------------------------------------------------------

    def submit(self, text: str, source: str = "job.yaml") -> JobThere:
        """Submit the text of a configuration or a sweep; `source` is the file's name, for messages.

        Raises:
            ServerError: it was refused, each mistake with its line; or the server is away.
        """
        return JobThere.of(self.ask("POST", "/jobs", params={"source": source}, content=text.encode()).json())

    def job(self, number: int) -> JobThere:
        """Return how a job stands; errors as of `ask`."""
        return JobThere.of(self.ask("GET", f"/jobs/{number}").json())

    def jobs(self, limit: int = 50, offset: int = 0) -> list[JobThere]:
        """Return jobs, the newest first; errors as of `ask`."""
        told = self.ask("GET", "/jobs", params={"limit": limit, "offset": offset}).json()
        return [JobThere.of(job) for job in told["jobs"]]

    def watch(self, number: int) -> Iterator[Happened]:
        """Yield what happens to a job until it is over, as `watching.watch` does; it says what is raised."""
        return watching.watch(self, number)

    def cancel(self, number: int) -> JobThere:
        """Have a job not be done, or stopped; what it has recorded is kept. Errors as of `ask`."""
        return JobThere.of(self.ask("POST", f"/jobs/{number}/cancel").json())

    def resume(self, number: int, accept_changes: bool = False) -> JobThere:
        """Have a job that failed or was cancelled go on; errors as of `ask`."""
        params = {"accept_changes": accept_changes}
        return JobThere.of(self.ask("POST", f"/jobs/{number}/resume", params=params).json())

    @contextlib.contextmanager
    def stream(self, path: str, headers: Mapping[str, str]) -> Iterator[httpx2.Response]:
        """Give an answer that is read as it comes; errors as of `ask`, also while it is read."""
        try:
            with self._http.stream("GET", path, headers=dict(headers)) as answer:
                if not answer.is_success:
                    answer.read()
                self._check(answer)
                yield answer
        except self._errors as error:
            raise ServerAway(f"{self.url}: does not answer ({error or type(error).__name__}).") from error

    # --- pushing --------------------------------------------------------------------------------------

    def push(self, parcel: Parcel | Run, report: Report = lambda *_: None, begun: Sent | None = None) -> Sent:
        """Send a run, and return what became of it when the server has verified and stored it.

        Args:
            parcel: a run that is over, or a file with what is said of it.
            report: told the progress.
            begun: the upload that has its beginning already.

        Raises:
            ServerError: it was refused, with the reason.
            ServerAway: the server did not answer for too long; what it has, it keeps for the next time.
            RunnerError: the run cannot be sent.
        """
        if isinstance(parcel, Run):
            parcel = Parcel.of(parcel)
        size, digest = _size_and_digest(parcel.path)
        sent = _Delivery(self, parcel, size, digest, report, begun).done()
        if sent.state == "refused" and begun is not None:  # the file has become another since it began
            sent = _Delivery(self, parcel, size, digest, report, None).done()
        if sent.state == "refused":
            raise ServerError(f"{self.url}: refused the run {parcel.run_id}: {sent.problem}")
        return sent

    def begin(self, **announced: Any) -> Sent:
        """Begin an upload, or find the one of the same bytes.

        Raises:
            ServerError: the server refuses, or is away.
        """
        told = {key: value for key, value in announced.items() if value not in (None, "")}
        return _sent(self.ask("POST", "/uploads", json=told))

    def append(self, sent: Sent, path: Path, end: int) -> Sent:
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
        return Sent(sent.id, sent.state, int(answer.headers["Upload-Offset"]), sent.run_id)

    def standing(self, sent: Sent, wait: float = 0) -> Sent:
        """Return how an upload stands now, or when it is verified.

        Raises:
            ServerError: the server refuses, or is away.
        """
        return _sent(self.ask("GET", f"/uploads/{sent.id}", params={"wait": wait}))

    def complete(self, sent: Sent, parcel: Parcel, size: int, digest: str) -> Sent:
        """Say that all is there.

        Raises:
            ServerError: the server refuses, or is away.
        """
        told = {"digest": digest, "size": size, "run": dict(parcel.run), "labels": dict(parcel.labels)}
        return _sent(self.ask("POST", f"/uploads/{sent.id}/complete", json=told))

    def give_up(self, sent: Sent) -> None:
        """Have an upload forgotten.

        Raises:
            ServerError: the server refuses, or is away.
        """
        self.ask("DELETE", f"/uploads/{sent.id}")

    # --- pulling --------------------------------------------------------------------------------------

    def pull(self, name: str, recordings: Path, report: Report = lambda *_: None) -> Admitted:
        """Bring a run into a folder of runs, as `pulling.pull` does; it says what is raised."""
        from runner.client.pull import pull

        return pull(self, name, recordings, report)

    def download(self, path: str, tag: str, offset: int, size: int) -> Iterator[bytes]:
        """Yield what a file has behind an offset.

        Args:
            path: where it is.
            tag: its ETag.
            offset: where to begin.
            size: its bytes, all of them.

        Raises:
            ServerError: it is another file by now, or the server is away.
        """
        headers = {"Range": f"bytes={offset}-", "If-Range": tag, "Accept-Encoding": "identity"}
        with self.stream(path, headers) as answer:
            begins = f"bytes {offset}-{size - 1}/{size}"
            if answer.headers.get("content-range") != begins:
                raise ServerError(f"{self.url}: the recording has become another meanwhile; pull it again.")
            yield from answer.iter_raw(_READ)

    # --- all ------------------------------------------------------------------------------------------

    def patience(self) -> Patience:
        """Return what waits while the server is away."""
        return Patience(self._patience, self._tell)

    def ask(self, method: str, path: str, **request: Any) -> httpx2.Response:
        """Return the answer to a request, which is no error.

        Raises:
            ServerError: the server refuses, or is away.
        """
        try:
            answer = self._http.request(method, path, **request)
        except self._errors as error:
            raise ServerAway(f"{self.url}: does not answer ({error or type(error).__name__}).") from error
        self._check(answer)
        return answer

    def _check(self, answer: httpx2.Response) -> None:
        if answer.is_success:
            return
        kind = ServerAway if answer.status_code in _PASSING else ServerError
        retry = answer.headers.get("retry-after", "")
        seconds = float(retry) if retry.isdecimal() else 0.0
        raise kind(f"{self.url}: {_message(answer)}", answer.status_code, seconds)


class _Delivery:
    """A file on its way, step by step; a step that fails is taken again after a while."""

    def __init__(
        self, client: Client, parcel: Parcel, size: int, digest: str, report: Report, begun: Sent | None
    ) -> None:
        self._client, self._parcel, self._report = client, parcel, report
        self._size, self._digest = size, digest
        self._sent = begun
        self._is_stale = begun is not None

    def done(self) -> Sent:
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

    def _step(self) -> Sent:
        client, sent, parcel = self._client, self._sent, self._parcel
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
            return client.append(sent, parcel.path, self._size)
        return client.complete(sent, parcel, self._size, self._digest)

    def _begun(self) -> Sent:
        parcel = self._parcel
        known = {"name": parcel.name, "run_id": parcel.run_id, "content_digest": parcel.content_digest}
        return self._client.begin(digest=self._digest, size=self._size, **known)

    def _verified(self, sent: Sent) -> Sent:
        """Return an upload unless it could not be verified for now."""
        if sent.state == "receiving" and sent.problem:
            raise ServerAway(f"{self._client.url}: {sent.problem}")
        return sent


def _may_pass(error: ServerError) -> bool:
    return isinstance(error, ServerAway) or error.status in (HTTPStatus.NOT_FOUND, HTTPStatus.CONFLICT)


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
        piece = stream.read(min(_READ, size))
        if not piece:
            raise RunnerError(f"{path}: became shorter while it was sent; try again.")
        size -= len(piece)
        yield piece


def _sent(answer: httpx2.Response) -> Sent:
    """Return what an answer says of an upload.

    Raises:
        ServerError: it says something else.
    """
    try:
        told = answer.json()
        return Sent(*(told[key] for key in ("id", "state", "offset", "run_id", "already", "problem")))
    except (ValueError, KeyError, TypeError) as error:
        raise ServerError(
            f"{answer.url}: found another answer than a dualtaxi server gives; is the address right?"
        ) from error


def _message(answer: httpx2.Response) -> str:
    """Return what a server says is wrong."""
    with contextlib.suppress(ValueError, KeyError, TypeError):
        return str(answer.json()["error"]["message"])
    return f"answers {answer.status_code} {answer.reason_phrase}; is it a dualtaxi server?"
