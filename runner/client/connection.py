"""A connection to a server: requests, streams, and what its errors mean."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final, Self
from urllib.parse import urlsplit

from runner.client.address import checked_url
from runner.client.backoff import Backoff, ServerError, ServerUnavailable
from runner.util.extras import require

if TYPE_CHECKING:
    import httpx2

API: Final = "/api/v1"
READ_BYTES: Final = 1 << 20
_TEMPORARY: Final = (408, 429, 500, 502, 503, 504, 507)
"""Status codes after which the same request may succeed a little later."""

Report = Callable[[int, int], object]
"""Called with the bytes transferred so far, and the bytes in total."""


class Connection:
    """A connection to a server; a context manager.

    Args:
        url: its address, such as `http://localhost:8000`.
        token: the access token; `find_token()` looks where one is usually kept.
        patience: how many seconds to keep retrying while the server is unavailable.
        tell: called with a message while it waits.

    Raises:
        RunnerError: the address is not one of a server.
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

    def patience(self) -> Backoff:
        """Return what waits while the server is away."""
        return Backoff(self._patience, self._tell)

    def ask(self, method: str, path: str, **request: Any) -> httpx2.Response:
        """Return the answer to a request, which is no error.

        Raises:
            ServerError: the server refuses, or is away.
        """
        try:
            answer = self._http.request(method, path, **request)
        except self._errors as error:
            raise ServerUnavailable(
                f"{self.url}: does not answer ({error or type(error).__name__})."
            ) from error
        self._check(answer)
        return answer

    def _check(self, answer: httpx2.Response) -> None:
        if answer.is_success:
            return
        kind = ServerUnavailable if answer.status_code in _TEMPORARY else ServerError
        retry = answer.headers.get("retry-after", "")
        seconds = float(retry) if retry.isdecimal() else 0.0
        raise kind(f"{self.url}: {_message(answer)}", answer.status_code, seconds)

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
            raise ServerUnavailable(
                f"{self.url}: does not answer ({error or type(error).__name__})."
            ) from error

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
            yield from answer.iter_raw(READ_BYTES)


def _message(answer: httpx2.Response) -> str:
    """Return what a server says is wrong."""
    with contextlib.suppress(ValueError, KeyError, TypeError):
        return str(answer.json()["error"]["message"])
    return f"answers {answer.status_code} {answer.reason_phrase}; is it a dualtaxi server?"
