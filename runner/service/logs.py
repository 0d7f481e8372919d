"""The service's log: a JSON object a line, for every request and event, without secrets."""

from __future__ import annotations

import contextlib
import json
import logging
import math
import os
import queue
import re
import threading
import time
from collections import Counter
from collections.abc import Iterator
from datetime import UTC, datetime
from logging.handlers import QueueHandler, QueueListener
from typing import Final, TextIO

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from runner.service.tokens import PREFIX
from runner.util.humanize import printable

NAME: Final = "dualtaxi.service"
LOG: Final = logging.getLogger(NAME)
FLOODS: Final = LOG.getChild("floods")
"""For warnings that clients can cause at any rate."""
MAX_WAITING: Final = 5_000
"""Lines that wait to be written; more, if nobody reads them, are dropped and counted."""
FLUSH_SECONDS: Final = 2.0
"""How long the remaining lines may take at the end."""
_LOGGERS: Final = (NAME, "uvicorn.error", "asyncio")
_REPEAT_SECONDS: Final = 1.0
"""Time between two warnings of one kind by libraries or `FLOODS`."""
_SECRET: Final = re.compile(re.escape(PREFIX) + r"[\w-]{20,}")
_OWN: Final = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "taskName", "color_message"}
_MAX_PATH: Final = 2_000
_QUIET: Final = ("/healthz", "/readyz", "/static/")
"""Successful requests below these paths are not logged."""


class LineFormatter(logging.Formatter):
    """Formats a record as a line without secrets.

    For people it is text; else one JSON object: time, level, event, and its extra fields.
    """

    def __init__(self, for_people: bool) -> None:
        super().__init__()
        self._for_people = for_people

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        line = super().format(record) if self._for_people else self._json(record)
        return printable(_SECRET.sub(f"{PREFIX}***", line))

    def _json(self, record: logging.LogRecord) -> str:
        moment = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")
        fields = {"time": moment, "level": record.levelname.lower(), "event": record.getMessage()}
        fields |= {key: value for key, value in vars(record).items() if key not in _OWN}
        if record.exc_info:
            fields["traceback"] = self.formatException(record.exc_info)
        return json.dumps(fields, ensure_ascii=False, default=str)


@contextlib.contextmanager
def logged_to(stream: TextIO, for_people: bool = False) -> Iterator[None]:
    """Log to a file or a pipe in the block: everything as JSON lines, or warnings as text for people.

    A thread of its own writes the log, so that a pipe that nobody reads does not block the service.
    """
    lines: queue.Queue[logging.LogRecord] = queue.Queue(MAX_WAITING)
    handler = _DroppingHandler(lines)
    handler.addFilter(_Thinning())
    handler.setFormatter(LineFormatter(for_people))
    for name in _LOGGERS:
        logger = logging.getLogger(name)
        logger.handlers = [handler]
        logger.propagate = False
        logger.setLevel(logging.WARNING if for_people else logging.INFO)
    listener = _Listener(lines, _DescriptorHandler(stream.fileno()))
    listener.start()
    try:
        yield
    finally:
        for name in _LOGGERS:
            logging.getLogger(name).removeHandler(handler)
        end = threading.Thread(target=listener.stop, daemon=True)
        end.start()
        end.join(FLUSH_SECONDS)


class _Thinning(logging.Filter):
    """Passes one warning a second of each kind; `left_out` is the number dropped before it."""

    def __init__(self) -> None:
        super().__init__()
        self._passed: dict[tuple[str, int], float] = {}
        """When the last record of each statement was passed."""
        self._left_out: Counter[tuple[str, int]] = Counter()

    def filter(self, record: logging.LogRecord) -> bool:
        if record.name == NAME or record.levelno < logging.WARNING:
            return True
        statement = record.pathname, record.lineno
        if record.created - self._passed.get(statement, -math.inf) < _REPEAT_SECONDS:
            self._left_out[statement] += 1
            return False
        self._passed[statement] = record.created
        if left_out := self._left_out.pop(statement, 0):
            record.left_out = left_out
        return True


class _DroppingHandler(QueueHandler):
    """Drops and counts records while the queue is full, where a `QueueHandler` prints a traceback each."""

    dropped = 0

    def enqueue(self, record: logging.LogRecord) -> None:
        try:
            if self.dropped:
                fields = {"name": NAME, "levelno": logging.WARNING, "levelname": "WARNING"}
                fields |= {"msg": "lines left out", "lines": self.dropped}
                self.queue.put_nowait(self.prepare(logging.makeLogRecord(fields)))
                self.dropped = 0
            self.queue.put_nowait(record)
        except queue.Full:
            self.dropped += 1


class _Listener(QueueListener):
    def enqueue_sentinel(self) -> None:
        """Wait for a place in the queue, where a `QueueListener` would raise `queue.Full`."""
        self.queue.put(self._sentinel)  # type: ignore[attr-defined]


class _DescriptorHandler(logging.Handler):
    """Writes lines to a file descriptor, without buffer or lock: the process may end during a write."""

    def __init__(self, descriptor: int) -> None:
        super().__init__()
        self._descriptor = descriptor

    def handle(self, record: logging.LogRecord) -> bool:
        """Write a line, without the lock that `logging.shutdown` waits for."""
        line = memoryview(f"{record.getMessage()}\n".encode(errors="replace"))
        with contextlib.suppress(OSError):  # a log that cannot be written does not stop the service
            while line:
                line = line[os.write(self._descriptor, line) :]
        return True


class AccessLog:
    """Middleware that logs each request when its response is complete."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on."""
        if scope["type"] != "http" or not LOG.isEnabledFor(logging.INFO):
            await self._app(scope, receive, send)
            return
        began = time.perf_counter()
        status = 0
        size = 0

        async def count(message: Message) -> None:
            nonlocal status, size
            if message["type"] == "http.response.start":
                status = message["status"]
            size += len(message.get("body", b""))
            await send(message)

        try:
            await self._app(scope, receive, count)
        finally:
            path, query = scope["path"], scope["query_string"].decode("latin-1")
            if status >= 400 or not path.startswith(_QUIET):
                fields: dict[str, object] = {
                    "client": scope["client"][0] if scope.get("client") else None,
                    "method": scope["method"],
                    "path": (f"{path}?{query}" if query else path)[:_MAX_PATH],
                    "status": status,
                    "bytes": size,
                    "seconds": round(time.perf_counter() - began, 4),
                }
                LOG.info("request", extra=fields)
