"""Running the service: slow clients are cut off, and running requests are completed at a stop."""

from __future__ import annotations

import asyncio
import gc
import socket
import struct
import sys
from types import FrameType
from typing import Final

import uvicorn
from fastapi import FastAPI
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from runner.errors import RunnerError
from runner.service.logs import FLOODS
from runner.service.settings import ServiceLimits, ServiceSettings

MAX_HEAD_BYTES: Final = 64 << 10
"""Bytes after which a request's target and headers must be complete."""
BACKLOG: Final = 1024
BURST: Final = 8
"""Connections accepted at once; asyncio accepts this many before the first of them is known here."""
OWN_DESCRIPTORS: Final = 64
"""File descriptors of the service itself: log, databases, pipes of child processes, connections to accept."""
GC_THRESHOLD: Final = 4_000
"""New objects after which Python searches for cycles: it takes 2 ms, in which no other thread runs."""
SWITCH_SECONDS: Final = 0.0005
"""How long a thread may keep the interpreter while the event loop waits for it."""
MAX_UNSENT_BYTES: Final = 256 << 10
"""Bytes of a response that the system takes before it can send them; else megabytes that nobody may read."""
_DISCARD: Final = struct.pack("ii", 1, 0)
"""The option SO_LINGER: discard unsent data when the socket is closed."""


def bind(settings: ServiceSettings) -> socket.socket:
    """Return the socket that the service will listen on, so that its port is known before it starts.

    Raises:
        RunnerError: the host or port is not available.
    """
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    try:
        return socket.create_server((settings.host, settings.port), family=family, backlog=BACKLOG)
    except OSError as error:
        reason = str(error.strerror).partition(" (while ")[0]  # Python repeats the address
        raise RunnerError(
            f"{settings.host}:{settings.port}: cannot listen there ({reason}); choose another by --port (0 "
            "for any free one) or --host."
        ) from error


def url_of(listening: socket.socket) -> str:
    """Return the address of the first page."""
    host, port = listening.getsockname()[:2]
    return f"http://[{host}]:{port}/" if ":" in host else f"http://{host}:{port}/"


def serve(app: FastAPI, settings: ServiceSettings, listening: socket.socket) -> None:
    """Serve until SIGINT or SIGTERM, then complete running requests."""
    config = uvicorn.Config(
        app,
        http=_protocol(settings.limits),
        loop="auto",
        ws="none",
        lifespan="off",
        backlog=BURST,
        log_config=None,
        access_log=False,
        server_header=False,
        limit_concurrency=max_connections(settings.limits) + 4 * BURST,  # with those that are being closed
        timeout_keep_alive=settings.limits.keep_alive_seconds,
        timeout_graceful_shutdown=settings.limits.stop_seconds,
        proxy_headers=settings.proxies != "",
        forwarded_allow_ips=settings.proxies or None,
    )
    server = _Server(config, app.state.stopping)

    async def run() -> None:
        async with app.router.lifespan_context(app):
            await server.serve(sockets=[listening])

    sys.setswitchinterval(SWITCH_SECONDS)
    gc.freeze()  # else a search for cycles looks at all that was imported, and stops all threads for 0.1 s
    gc.set_threshold(GC_THRESHOLD)
    with asyncio.Runner(loop_factory=config.get_loop_factory()) as loop:
        loop.run(run())


def max_connections(limits: ServiceLimits) -> int:
    """Return the maximum number of connections; each may need a second descriptor, for a file it reads."""
    try:
        import resource
    except ImportError:  # Windows
        return limits.connections
    descriptors, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if descriptors == resource.RLIM_INFINITY:
        return limits.connections
    return min(limits.connections, max(BURST, (descriptors - OWN_DESCRIPTORS) // 2))


class _Server(uvicorn.Server):
    """Ends event streams when the server stops."""

    def __init__(self, config: uvicorn.Config, stopping: asyncio.Event) -> None:
        super().__init__(config)
        self._stopping = stopping

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        for listening in sockets or ():
            listening.listen(BACKLOG)  # uvicorn also limits the waiting connections to a burst

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        super().handle_exit(sig, frame)
        self._captured_signals.clear()  # uvicorn would raise them again after the stop
        self._stopping.set()


def _protocol(limits: ServiceLimits) -> type[HttpToolsProtocol]:
    """Return uvicorn's HTTP/1.1 with limits on the head of a request and on slow clients.

    Uvicorn itself has no such limits, see docs/decisions/uvicorn-limits.md.
    """
    most = max_connections(limits)
    by_activity: dict[Protocol, None] = {}
    """The open connections, the least recently active one first."""

    class Protocol(HttpToolsProtocol):
        _timer: asyncio.TimerHandle | None = None
        _is_in_head, _head_bytes = False, 0

        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            if len(by_activity) >= most:
                _close_idle()
            by_activity[self] = None
            connection = transport.get_extra_info("socket")
            if connection is not None:  # asyncio does this only for sockets that it made itself
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                if hasattr(socket, "TCP_NOTSENT_LOWAT"):  # not on Windows
                    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, MAX_UNSENT_BYTES)
            self._set_timer(limits.header_seconds)

        def connection_lost(self, exc: Exception | None) -> None:
            self._set_timer(None)
            by_activity.pop(self, None)
            super().connection_lost(exc)

        def data_received(self, data: bytes) -> None:
            super().data_received(data)
            self._head_bytes = self._head_bytes + len(data) if self._is_in_head else 0
            if self._head_bytes > MAX_HEAD_BYTES:
                self.send_400_response("The head of the request is too long.")
            if self in by_activity:
                by_activity[self] = by_activity.pop(self)
            if self.is_idle and self._timer is None and not self.transport.is_closing():
                self._set_timer(limits.header_seconds)

        @property
        def is_idle(self) -> bool:
            """Whether no request is being answered."""
            return self.cycle is None or self.cycle.response_complete

        def on_message_begin(self) -> None:
            self._is_in_head = True
            super().on_message_begin()

        def on_headers_complete(self) -> None:
            self._is_in_head = False
            self._set_timer(None)
            super().on_headers_complete()

        def pause_writing(self) -> None:
            super().pause_writing()
            self._set_timer(limits.idle_seconds)

        def resume_writing(self) -> None:
            self._set_timer(None)
            super().resume_writing()

        def _set_timer(self, seconds: float | None) -> None:
            """Close the connection unless this is called again in time; None to stop the timer."""
            if self._timer is not None:
                self._timer.cancel()
            self._timer = None if seconds is None else self.loop.call_later(seconds, self._abort)

        def _abort(self) -> None:
            self._timer = None
            connection = self.transport.get_extra_info("socket")
            if connection is not None:  # else the system would go on sending
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _DISCARD)
            self.transport.abort()

    def _close_idle() -> None:
        """Make room for another connection; if all are busy, uvicorn answers its request with 503."""
        idle = next((connection for connection in by_activity if connection.is_idle), None)
        if idle is not None:
            del by_activity[idle]
            idle.transport.close()
        FLOODS.warning("too many connections", extra={"maximum": most, "closed_idle": idle is not None})

    return Protocol
