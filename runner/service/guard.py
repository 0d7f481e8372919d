"""What every request passes first and every answer last: host, token, origin, size and pace of its body."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlencode

from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import RedirectResponse, Response

from runner.errors import RunnerError
from runner.service.errors import Refused
from runner.service.problems import status_of
from runner.service.security import (
    SAFE_METHODS,
    Token,
    Tokens,
    is_allowed_host,
    is_embedded_elsewhere,
    is_same_origin,
    unauthorized,
)
from runner.service.sessions import COOKIE, Sessions

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

    from runner.service.settings import Settings

Refusal = Callable[[Request, RunnerError], Response]
"""Returns the answer to a request that is refused."""
OPEN_PATHS: Final = ("/healthz", "/readyz", "/login", "/logout", "/static/")
"""What needs no token: these, and what is below those that end in a slash."""
UPLOADS: Final = "/api/v1/uploads"
"""Below it what is sent by PATCH may be as long as a recording."""
LEAST_RATE: Final = 1000
"""Bytes a second of a body, on average; slower clients are cut off."""
POLICY: Final = (
    "default-src 'self'; img-src 'self' data:; object-src 'none'; base-uri 'none'; form-action 'self'; "
    "frame-ancestors 'self'"
)
_HEADERS: Final = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "referrer-policy": "same-origin",  # with `no-referrer` a form's own origin would be null
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "private, no-cache",
}
"""Of every answer that has none of its own."""


class Guard:
    """Refuses what may not be, before any route is looked for; so no route can forget to."""

    def __init__(
        self, app: ASGIApp, settings: Settings, tokens: Tokens, sessions: Sessions, refused: Refusal
    ) -> None:
        self._app, self._settings = app, settings
        self._tokens, self._sessions, self._refused = tokens, sessions, refused

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = [(name.decode("latin-1"), value.decode("latin-1")) for name, value in scope["headers"]]
        try:
            self._check(scope, headers)
        except RunnerError as error:
            await self._answer(error, scope, dict(headers))(scope, receive, _with_headers(send))
            return
        limits = self._settings.limits
        streamed = scope["method"] == "PATCH" and scope["path"].startswith(UPLOADS)
        most = limits.upload_bytes if streamed else limits.body_bytes
        body = Body(receive, most, limits.idle_seconds)
        await self._app(scope, body.receive, _with_headers(send))

    def _check(self, scope: Scope, listed: list[tuple[str, str]]) -> None:
        """Refuse a request that names another host, lacks a token, or comes from another site.

        Raises:
            Refused: it does.
        """
        headers = dict(listed)
        hosts = [value for name, value in listed if name == "host"]
        if len(hosts) != 1 or not is_allowed_host(hosts[0], self._settings.hosts):
            raise Refused(
                HTTPStatus.MISDIRECTED_REQUEST,
                f"host: found {', '.join(hosts) or 'none'}, expected an address, localhost or a name that "
                "was allowed by --allow-host.",
            )
        reads = scope["method"] in SAFE_METHODS
        if not is_open(scope["path"]):
            token = self._token(headers)
            scope["state"] = {**scope.get("state", {}), "token": token}
            if token is not None and not reads and not token.can_write:
                raise Refused(HTTPStatus.FORBIDDEN, "token: found one for reading, expected one for writing.")
            if token is None and self._settings.needs_token:
                raise unauthorized("token: found none, expected `Authorization: Bearer TOKEN`, or a login.")
            if "authorization" in headers:
                return  # which no page of another site can make a browser send
        if reads and is_embedded_elsewhere(headers):
            raise Refused(
                HTTPStatus.FORBIDDEN, "origin: found a page of another site, expected the service's own."
            )
        if not reads and not is_same_origin(headers):
            raise Refused(
                HTTPStatus.FORBIDDEN,
                "origin: found another than the service's own, or none; expected the same, or a token. "
                "A program without one says `Origin: http://HOST:PORT`.",
            )

    def _token(self, headers: dict[str, str]) -> Token | None:
        """Return the token that a request brings, or that its session stands for; None if it has none.

        Raises:
            Refused: it is a wrong one.
        """
        kind, _, secret = headers.get("authorization", "").partition(" ")
        if kind:
            if kind.lower() != "bearer" or not secret.strip():
                raise unauthorized(f"authorization: found {kind[:20]!r}, expected `Bearer TOKEN`.")
            token = self._tokens.find(secret.strip())
            if token is None:
                raise unauthorized("token: found one that is unknown, or was revoked.")
            return token
        session = _cookie(headers) if self._settings.needs_token else ""
        if not session:
            return None
        token = self._sessions.token_of(session)
        if token is None:
            raise unauthorized("session: it has ended; log in again.")
        return token

    def _answer(self, error: RunnerError, scope: Scope, headers: dict[str, str]) -> Response:
        """Return how a request is refused: a browser that asks for a page is led to the login."""
        status = status_of(error)
        pages = "text/html" in headers.get("accept", "") and not scope["path"].startswith("/api/")
        if pages and status == HTTPStatus.UNAUTHORIZED and scope["method"] == "GET":
            asked = scope["path"] + (
                f"?{scope['query_string'].decode('latin-1')}" if scope["query_string"] else ""
            )
            return RedirectResponse(f"/login?{urlencode({'next': asked})}", HTTPStatus.SEE_OTHER)
        return self._refused(Request(scope), error)


def is_open(path: str) -> bool:
    """Return whether a path needs no token."""
    return any(path.startswith(part) if part.endswith("/") else path == part for part in OPEN_PATHS)


class Body:
    """A request's body on its way in, within limits of size and pace."""

    def __init__(self, receive: Receive, most: int, idle_seconds: float) -> None:
        self._receive, self._most, self._idle = receive, most, idle_seconds
        self._began, self._length, self._more = time.monotonic(), 0, True

    async def receive(self) -> Message:
        """Return the next part of it; what comes behind its end is waited for as long as it takes.

        Raises:
            HTTPException: it is too long, or too slow.
        """
        if not self._more:
            return await self._receive()
        try:
            async with asyncio.timeout(self._idle):
                message = await self._receive()
        except TimeoutError:
            raise self._too_slow() from None
        self._more = message.get("more_body", False)
        self._length += len(message.get("body", b""))
        if self._length > self._most:
            raise HTTPException(
                HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
                f"body: found more than {self._most:,} bytes, expected at most so many.",
                {"connection": "close"},
            )
        if self._more and time.monotonic() - self._began > self._idle + self._length / LEAST_RATE:
            raise self._too_slow()
        return message

    def _too_slow(self) -> HTTPException:
        message = f"body: found {self._length:,} bytes in {time.monotonic() - self._began:.0f} s, too few."
        return HTTPException(HTTPStatus.REQUEST_TIMEOUT, message, {"connection": "close"})


def _cookie(headers: dict[str, str]) -> str:
    try:
        found = SimpleCookie(headers.get("cookie", "")).get(COOKIE)
    except CookieError:
        return ""
    return found.value if found else ""


def _with_headers(send: Send) -> Any:
    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in _HEADERS.items():
                headers.setdefault(name, value)
        await send(message)

    return sending
