"""What the service says of itself: a JSON object a line, of every request and event; no secret is in it."""

from __future__ import annotations

import json
import logging
import re
import time
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final, TextIO

from runner.service.security import PREFIX

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

NAME: Final = "dualtaxi.service"
LOG: Final = logging.getLogger(NAME)
_LOGGERS: Final = (NAME, "uvicorn.error")
_SECRET: Final = re.compile(re.escape(PREFIX) + r"[\w-]{20,}")
_OWN: Final = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "taskName", "color_message"}
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


def configure(stream: TextIO, for_people: bool = False) -> None:
    """Have the service log to a stream: everything as JSON lines, or to people what went wrong."""
    output = logging.StreamHandler(stream)
    output.setFormatter(Plain() if for_people else JsonLines())
    for name in _LOGGERS:
        logger = logging.getLogger(name)
        logger.handlers, logger.propagate = [output], False
        logger.setLevel(logging.WARNING if for_people else logging.INFO)


class Access:
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
        "path": scope["path"] + (f"?{query}" if query else ""),
    }


def _since(began: float) -> float:
    return round(time.perf_counter() - began, 4)
