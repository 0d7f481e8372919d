"""The service, run: a server that gives slow clients up and stops without cutting anything off."""

from __future__ import annotations

import asyncio
import socket
import struct
from types import FrameType
from typing import TYPE_CHECKING, Final

import uvicorn
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from runner.errors import RunnerError

if TYPE_CHECKING:
    from fastapi import FastAPI

    from runner.service.settings import Limits, Settings

MOST_HEAD_BYTES: Final = 64 << 10
"""Of a request's address and headers."""
BACKLOG: Final = 1024
_AT_ONCE: Final = struct.pack("ii", 1, 0)


def bind(settings: Settings) -> socket.socket:
    """Return the socket that the service will listen on; its port is known now.

    Raises:
        RunnerError: the host or port cannot be had.
    """
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    try:
        return socket.create_server((settings.host, settings.port), family=family, backlog=BACKLOG)
    except OSError as error:
        raise RunnerError(
            f"{settings.host}:{settings.port}: cannot listen there ({error.strerror}); choose another by "
            "--port (0: any that is free) or --host."
        ) from error


def url_of(listening: socket.socket) -> str:
    """Return the address of the first page."""
    host, port = listening.getsockname()[:2]
    return f"http://[{host}]:{port}/" if ":" in host else f"http://{host}:{port}/"


def serve(app: FastAPI, settings: Settings, listening: socket.socket) -> None:
    """Serve until the process is told to stop, then let what is under way come to its end.

    Raises:
        RunnerError: the service cannot begin: another one serves these recordings.
    """
    config = uvicorn.Config(
        app,
        http=_protocol(settings.limits),
        loop="auto",
        ws="none",
        lifespan="off",
        log_config=None,
        access_log=False,
        server_header=False,
        limit_concurrency=settings.limits.connections,
        timeout_keep_alive=settings.limits.keep_alive_seconds,
        timeout_graceful_shutdown=settings.limits.stop_seconds,
        proxy_headers=settings.proxies != "",
        forwarded_allow_ips=settings.proxies or None,
    )
    server = _Server(config, app.state.stopping)

    async def run() -> None:
        async with app.router.lifespan_context(app):
            await server.serve(sockets=[listening])

    with asyncio.Runner(loop_factory=config.get_loop_factory()) as loop:
        loop.run(run())


class _Server(uvicorn.Server):
    """Tells answers that go on for long (events) that they are to end."""

    def __init__(self, config: uvicorn.Config, stopping: asyncio.Event) -> None:
        super().__init__(config)
        self._stopping = stopping

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        super().handle_exit(sig, frame)
        self._captured_signals.clear()  # which would be raised again behind a stop that went well
        self._stopping.set()


def _protocol(limits: Limits) -> type[HttpToolsProtocol]:
    """Return HTTP/1.1 as uvicorn speaks it, with limits on how long and how slow a client may be."""

    class Protocol(HttpToolsProtocol):
        _timer: asyncio.TimerHandle | None = None
        _head_bytes = 0

        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            connection = transport.get_extra_info("socket")
            if connection is not None:  # asyncio does it for sockets that it made itself alone
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._await(limits.header_seconds)

        def connection_lost(self, exc: Exception | None) -> None:
            self._await(None)
            super().connection_lost(exc)

        def data_received(self, data: bytes) -> None:
            super().data_received(data)
            idle = self.cycle is None or self.cycle.response_complete
            if idle and self._timer is None and not self.transport.is_closing():
                self._await(limits.header_seconds)

        def on_message_begin(self) -> None:
            self._head_bytes = 0
            super().on_message_begin()

        def on_url(self, url: bytes) -> None:
            self._count(url)
            super().on_url(url)

        def on_header(self, name: bytes, value: bytes) -> None:
            self._count(name + value)
            super().on_header(name, value)

        def on_headers_complete(self) -> None:
            self._await(None)
            super().on_headers_complete()

        def pause_writing(self) -> None:
            super().pause_writing()
            self._await(limits.idle_seconds)

        def resume_writing(self) -> None:
            self._await(None)
            super().resume_writing()

        def _count(self, part: bytes) -> None:
            self._head_bytes += len(part) + 4
            if self._head_bytes > MOST_HEAD_BYTES:
                raise ValueError("the head of a request is too long")

        def _await(self, seconds: float | None) -> None:
            """Cut the connection off unless something comes in time; None: it came."""
            if self._timer is not None:
                self._timer.cancel()
            self._timer = None if seconds is None else self.loop.call_later(seconds, self._cut_off)

        def _cut_off(self) -> None:
            self._timer = None
            connection = self.transport.get_extra_info("socket")
            if connection is not None:  # so that the system does not go on sending what it has
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _AT_ONCE)
            self.transport.abort()

    return Protocol
