"""A short-lived cache of responses, which also merges equal requests that run at the same time."""

from __future__ import annotations

import asyncio
import time
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Hashable
from dataclasses import dataclass
from typing import Final, NamedTuple

MAX_SECONDS: Final = 5.0
"""The default age limit: a response may depend on the time of day."""
ALWAYS: Final = float("inf")
"""The age limit of responses that depend on nothing but their key."""


class _Response(NamedTuple):
    body: bytes
    created: float


@dataclass
class _Pending:
    """A response that is being made."""

    task: asyncio.Future[bytes]
    waiting: int = 0
    """How many requests wait for it."""


class ResponseCache:
    """Response bodies by key; the least recently used ones are dropped beyond a number of bytes."""

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._bytes = 0
        self._responses: OrderedDict[Hashable, _Response] = OrderedDict()
        self._pending: dict[Hashable, _Pending] = {}

    def get(self, key: Hashable, max_seconds: float = ALWAYS) -> bytes | None:
        """Return the cached response of a key; None if there is none, or an older one only."""
        response = self._responses.get(key)
        if response is None or time.monotonic() - response.created >= max_seconds:
            return None
        self._responses.move_to_end(key)
        return response.body

    async def get_or_await(
        self, key: Hashable, make: Callable[[], Awaitable[bytes]], max_seconds: float = MAX_SECONDS
    ) -> bytes:
        """Return the response of a key: cached, not older than `max_seconds`, being made, or made now.

        The key has everything that the response depends on, as far as that is known. Once all who wait for
        it were cancelled, making it is, too.
        """
        if (body := self.get(key, max_seconds)) is not None:
            return body
        pending = self._pending.get(key)
        if pending is None:
            pending = self._pending[key] = _Pending(asyncio.ensure_future(make()))
            pending.task.add_done_callback(lambda done: self._store(key, done))
        pending.waiting += 1
        try:
            return await asyncio.shield(pending.task)
        finally:
            pending.waiting -= 1
            if not pending.waiting and not pending.task.done():
                del self._pending[key]
                pending.task.cancel()

    def _store(self, key: Hashable, done: asyncio.Future[bytes]) -> None:
        if key in self._pending and self._pending[key].task is done:
            del self._pending[key]
        if not done.cancelled() and done.exception() is None:
            self.keep(key, done.result())

    def keep(self, key: Hashable, body: bytes) -> None:
        """Keep the response of a key."""
        self._drop(key)
        self._responses[key] = _Response(body, time.monotonic())
        self._bytes += len(body)
        while self._bytes > self._max_bytes and self._responses:
            self._drop(next(iter(self._responses)))

    def _drop(self, key: Hashable) -> None:
        dropped = self._responses.pop(key, None)
        self._bytes -= len(dropped.body) if dropped else 0
