"""A cache of responses, which also merges equal requests that run at the same time."""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Hashable
from dataclasses import dataclass


@dataclass
class _Pending:
    """A response that is being made."""

    task: asyncio.Future[bytes]
    waiting: int = 0
    """How many requests wait for it."""


class ResponseCache:
    """Response bodies by key, which has all that they depend on.

    The least recently used ones are dropped beyond a number of bytes.
    """

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._bytes = 0
        self._responses: OrderedDict[Hashable, bytes] = OrderedDict()
        self._pending: dict[Hashable, _Pending] = {}

    def get(self, key: Hashable) -> bytes | None:
        """Return the cached response of a key; None if there is none."""
        if key in self._responses:
            self._responses.move_to_end(key)
        return self._responses.get(key)

    async def get_or_await(self, key: Hashable, make: Callable[[], Awaitable[bytes]]) -> bytes:
        """Return the response of a key: cached, being made, or made now.

        Once all who wait for it were cancelled, making it is, too.
        """
        if (body := self.get(key)) is not None:
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
        """Keep the response of a key; one that is larger than the cache would only drop all others."""
        if len(body) > self._max_bytes:
            return
        self._bytes += len(body) - len(self._responses.pop(key, b""))
        self._responses[key] = body
        while self._bytes > self._max_bytes:
            self._bytes -= len(self._responses.popitem(last=False)[1])
