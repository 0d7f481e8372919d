"""What the service says of itself: a JSON object a line, of every request and event; no secret is in it."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import queue
import re
import threading
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from logging.handlers import QueueHandler, QueueListener
from typing import TYPE_CHECKING, Any, Final, TextIO

from runner.service.tokens import PREFIX

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

NAME: Final = "dualtaxi.service"
LOG: Final = logging.getLogger(NAME)
_LOGGERS: Final = (NAME, "uvicorn.error")
_SECRET: Final = re.compile(re.escape(PREFIX) + r"[\w-]{20,}")
_OWN: Final = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "taskName", "color_message"}
MOST_WAITING: Final = 5_000
"""Lines that wait to be written; more, if nobody reads them, are left out, and counted."""
GOODBYE_SECONDS: Final = 2.0
"""How long, in the end, those that still wait may take."""
_LONGEST_PATH: Final = 2_000
_QUIET: Final = ("/healthz", "/readyz", "/static/")
"""Requests that are not logged when all went well."""


class JsonLines(logging.Formatter):
    """A record as one line of JSON: time, level, event, and what was said besides."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        moment = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")
        told = {"time": moment, "level": record.levelname.lower(), "event": record.getMessage()}
        told |= {key: value for key, value in vars(record).items() if key not in _OWN}
        if record.exc_info:
            told["traceback"] = self.formatException(record.exc_info)
        return without_secrets(json.dumps(told, ensure_ascii=False, default=str))


class Plain(logging.Formatter):
    """A record as a line for people."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        return without_secrets(super().format(record))


def without_secrets(text: str) -> str:
    """Return a text without the tokens in it."""
    return _SECRET.sub(f"{PREFIX}***", text)


@contextlib.contextmanager
def logged_to(stream: TextIO, for_people: bool = False) -> Iterator[None]:
    """Have the service log to a file or a pipe: everything as JSON lines, or to people what went wrong.

    It is written by a thread of its own: a pipe that nobody reads keeps nobody waiting but that thread.
    """
    waiting: queue.Queue[logging.LogRecord] = queue.Queue(MOST_WAITING)
    output = _Waiting(waiting)
    output.setFormatter(Plain() if for_people else JsonLines())
    for name in _LOGGERS:
        logger = logging.getLogger(name)
        logger.handlers, logger.propagate = [output], False
        logger.setLevel(logging.WARNING if for_people else logging.INFO)
    listener = _Writer(waiting, _Lines(stream.fileno()))
    listener.start()
    try:
        yield
    finally:
        for name in _LOGGERS:
            logging.getLogger(name).removeHandler(output)
        end = threading.Thread(target=listener.stop, daemon=True)
        end.start()
        end.join(GOODBYE_SECONDS)


class _Waiting(QueueHandler):
    """Puts lines where they wait to be written; those that find no room are counted."""

    left_out = 0

    def enqueue(self, record: logging.LogRecord) -> None:
        """Have a line wait, behind the notice of those that were left out."""
        try:
            if self.left_out:
                self.queue.put_nowait(self.prepare(self._notice()))
                self.left_out = 0
            self.queue.put_nowait(record)
        except queue.Full:
            self.left_out += 1

    def _notice(self) -> logging.LogRecord:
        facts = {"name": NAME, "levelno": logging.WARNING, "levelname": "WARNING", "msg": "lines left out"}
        return logging.makeLogRecord(facts | {"lines": self.left_out})


class _Writer(QueueListener):
    """Writes the lines that wait."""

    def enqueue_sentinel(self) -> None:
        """Have it end behind the last line, also where there is no room for a sign of that yet."""
        self.queue.put(self._sentinel)  # type: ignore[attr-defined]


class _Lines(logging.Handler):
    """Writes lines to a file descriptor, for one thread, without buffer or lock: a process may end then."""

    def __init__(self, descriptor: int) -> None:
        super().__init__()
        self._descriptor = descriptor

    def handle(self, record: logging.LogRecord) -> bool:
        """Write a line, without the lock that the end of a process asks for."""
        self.emit(record)
        return True

    def emit(self, record: logging.LogRecord) -> None:
        """Write a line; one that cannot be written is no reason to stop."""
        line = memoryview(f"{record.getMessage()}\n".encode(errors="replace"))
        with contextlib.suppress(OSError):
            while line:
                line = line[os.write(self._descriptor, line) :]


class AccessLog:
    """Logs each request when its answer is over: who, what, how it went, how long it took."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on."""
        if scope["type"] != "http" or not LOG.isEnabledFor(logging.INFO):
            await self._app(scope, receive, send)
            return
        began, answer = time.perf_counter(), {"status": 0, "bytes": 0}

        async def sending(message: Message) -> None:
            if message["type"] == "http.response.start":
                answer["status"] = message["status"]
            answer["bytes"] += len(message.get("body", b""))
            await send(message)

        try:
            await self._app(scope, receive, sending)
        finally:
            if answer["status"] >= 400 or not scope["path"].startswith(_QUIET):
                LOG.info("request", extra=_told(scope) | answer | {"seconds": _since(began)})


def _told(scope: Scope) -> dict[str, Any]:
    client = scope.get("client")
    query = scope["query_string"].decode("latin-1")
    return {
        "client": client[0] if client else None,
        "method": scope["method"],
        "path": (scope["path"] + (f"?{query}" if query else ""))[:_LONGEST_PATH],
    }


def _since(began: float) -> float:
    return round(time.perf_counter() - began, 4)
