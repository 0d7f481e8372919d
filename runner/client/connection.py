"""A connection to a server: address and token, requests, errors, and retries while it is unavailable."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterator, Mapping
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self, TypeVar
from urllib.parse import urlsplit

from pydantic import TypeAdapter

from runner.errors import RunnerError
from runner.util.extras import require
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


class Connection:
    """A connection to a server; a context manager.

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

    def request_object(self, method: str, path: str, **options: object) -> Json:
        """Return the JSON object that a server responds with; errors as for `request`."""
        return self.request_record(dict, method, path, **options)

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
