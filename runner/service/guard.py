"""Middleware for every request: host, token, origin, security headers, and size and pace of the body.

On a loopback host, reading needs no token, and writing needs the same origin or a token: no page of another
site can write. On any other host everything needs a token. Starlette has no middleware for these rules, see
docs/decisions/own-guard.md.
"""

from __future__ import annotations

import asyncio
import ipaddress
import re
import time
from collections.abc import Callable, Mapping
from http import HTTPStatus
from typing import Final
from urllib.parse import urlencode

from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from runner.errors import RunnerError
from runner.service.errors import Refused, Unauthorized
from runner.service.problems import requests_page, status_of
from runner.service.settings import ServiceSettings
from runner.service.tokens import COOKIE, Sessions, Token, Tokens

SAFE_METHODS: Final = ("GET", "HEAD", "OPTIONS")
OPEN_PATHS: Final = ("/healthz", "/readyz", "/login", "/logout", "/static/")
"""Paths that need no token: these, and those below the ones that end in a slash."""
UPLOADS: Final = "/api/v1/uploads"
"""A body of PATCH below this path may be as long as a recording."""
MIN_RATE: Final = 1000
"""Bytes a second of a body, on average; slower clients are cut off."""
POLICY: Final = (
    "default-src 'self'; img-src 'self' data: blob:; object-src 'none'; base-uri 'none'; form-action 'self'; "
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
"""Headers of every response that does not set its own."""


class Guard:
    """Refuses requests before they are routed, so that no route can forget to."""

    def __init__(
        self,
        app: ASGIApp,
        settings: ServiceSettings,
        tokens: Tokens,
        sessions: Sessions,
        refusal: Callable[[Request, RunnerError], Response],
    ) -> None:
        self._app = app
        self._settings = settings
        self._tokens = tokens
        self._sessions = sessions
        self._refusal = refusal

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        request = Request(scope)
        try:
            self._check(request)
        except RunnerError as error:
            await self._refuse(request, error)(scope, receive, send_with_headers)
            return
        limits = self._settings.limits
        is_upload = request.method == "PATCH" and scope["path"].startswith(UPLOADS)
        max_bytes = limits.upload_bytes if is_upload else limits.body_bytes
        body = Body(receive, max_bytes, limits.idle_seconds)
        await self._app(scope, body.receive, send_with_headers)

    def _check(self, request: Request) -> None:
        """Refuse a request that names another host, lacks a token, or comes from another site."""
        headers = request.headers
        hosts = headers.getlist("host")
        if len(hosts) != 1 or not is_allowed_host(hosts[0], self._settings.hosts):
            raise Refused(
                HTTPStatus.MISDIRECTED_REQUEST,
                f"host: found {', '.join(hosts) or 'none'}, expected an address, localhost or a name that "
                "was allowed by --allow-host.",
            )
        is_read = request.method in SAFE_METHODS
        path = request.scope["path"]
        if not any(path.startswith(known) if known.endswith("/") else path == known for known in OPEN_PATHS):
            token = self._token(request)
            request.state.token = token
            if token is not None and not is_read and not token.can_write:
                raise Refused(
                    HTTPStatus.FORBIDDEN,
                    "token: found one for reading, expected one for writing, as `dualtaxi token create NAME "
                    "--scope write` makes.",
                )
            if token is None and self._settings.needs_token:
                raise Unauthorized("token: found none, expected `Authorization: Bearer TOKEN`, or a login.")
            if "authorization" in headers:
                return  # which no page of another site can make a browser send
        # A page of another site that embeds this one could not read it, but make the service work; following
        # a link is another matter.
        site, mode = headers.get("sec-fetch-site"), headers.get("sec-fetch-mode")
        if is_read and site in ("cross-site", "same-site") and mode != "navigate":
            raise Refused(
                HTTPStatus.FORBIDDEN, "origin: found a page of another site, expected the service's own."
            )
        if not is_read and not is_same_origin(headers):
            raise Refused(
                HTTPStatus.FORBIDDEN,
                "origin: found another than the service's own, or none; expected the same, or a token. "
                "A program without one sends `Origin: http://HOST:PORT`.",
            )

    def _token(self, request: Request) -> Token | None:
        """Return the token of a request, or of its session; None if it has none.

        Raises:
            Unauthorized: it is a wrong one.
        """
        scheme, _, secret = request.headers.get("authorization", "").partition(" ")
        if scheme:
            if scheme.lower() != "bearer" or not secret.strip():
                raise Unauthorized(f"authorization: found {scheme[:20]!r}, expected `Bearer TOKEN`.")
            return self._tokens.find(secret.strip())
        session = request.cookies.get(COOKIE) if self._settings.needs_token else None
        if not session:
            return None
        token = self._sessions.token_of(session)
        if token is None:
            raise Unauthorized("session: it has ended; log in again.")
        return token

    def _refuse(self, request: Request, error: RunnerError) -> Response:
        """Return the response to a request that is refused; a browser is redirected to the login."""
        is_login_needed = status_of(error) == HTTPStatus.UNAUTHORIZED and request.method == "GET"
        if is_login_needed and requests_page(request):
            path = request.scope["path"]
            query = request.scope["query_string"].decode("latin-1")
            target = f"{path}?{query}" if query else path
            return RedirectResponse(f"/login?{urlencode({'next': target})}", HTTPStatus.SEE_OTHER)
        return self._refusal(request, error)


class Body:
    """The body of a request, within limits of size and pace."""

    def __init__(self, receive: Receive, max_bytes: int, idle_seconds: float) -> None:
        self._receive = receive
        self._max_bytes = max_bytes
        self._idle = idle_seconds
        self._began = time.monotonic()
        self._length = 0
        self._more = True

    async def receive(self) -> Message:
        """Return its next part; after its end there is no limit on waiting.

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
        if self._length > self._max_bytes:
            raise HTTPException(
                HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
                f"body: found more than the maximum of {self._max_bytes:,} bytes.",
                {"connection": "close"},
            )
        if self._more and time.monotonic() - self._began > self._idle + self._length / MIN_RATE:
            raise self._too_slow()
        return message

    def _too_slow(self) -> HTTPException:
        message = f"body: found {self._length:,} bytes in {time.monotonic() - self._began:.0f} s, too few."
        return HTTPException(HTTPStatus.REQUEST_TIMEOUT, message, {"connection": "close"})


def is_allowed_host(header: str, hosts: tuple[str, ...]) -> bool:
    """Return whether a Host header names this service.

    Any address does: a site whose name was made to point at this machine still sends its own name.
    """
    name = re.sub(r":\d{1,5}$", "", header) if not header.endswith("]") else header
    name = name.strip("[]").lower().rstrip(".")
    if name in ("localhost", *hosts):
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def is_same_origin(headers: Mapping[str, str]) -> bool:
    """Return whether a page of this service sends a request, according to the browser; or a program.

    No page can make a browser send a wrong `Origin` or `Sec-Fetch-Site`.
    """
    site, origin = headers.get("sec-fetch-site"), headers.get("origin")
    if site is not None and site != "same-origin":
        return False
    if origin is not None:
        scheme, _, host = origin.partition("://")
        return scheme in ("http", "https") and host.lower() == headers.get("host", "").lower()
    return site == "same-origin"
