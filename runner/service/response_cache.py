"""Answers that are kept for a while, for who asks the same next."""

from __future__ import annotations

import asyncio
import time
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Hashable
from dataclasses import dataclass
from typing import Any, Final

from starlette.concurrency import run_in_threadpool

SECONDS: Final = 5.0
"""An answer is kept no longer: what it tells may depend on the time of day."""
ALWAYS: Final = float("inf")
"""For answers that depend on nothing but their key."""


@dataclass(frozen=True)
class _Answer:
    body: bytes
    made: float


class Kept:
    """Answers by what they depend on, the most recently asked for; at most so many bytes."""

    def __init__(self, most_bytes: int) -> None:
        self._most, self._bytes = most_bytes, 0
        self._answers: OrderedDict[Hashable, _Answer] = OrderedDict()
        self._under_way: dict[Hashable, asyncio.Future[bytes]] = {}

    async def answer(self, key: Hashable, make: Callable[[], bytes]) -> bytes:
        """Return the answer of a key, made in a thread if it must be; see `awaited`."""
        return await self.awaited(key, lambda: run_in_threadpool(make))

    def found(self, key: Hashable) -> bytes | None:
        """Return the answer of a key if it is kept, however old; None if it must be made."""
        kept = self._answers.get(key)
        if kept is None:
            return None
        self._answers.move_to_end(key)
        return kept.body

    async def awaited(
        self, key: Hashable, make: Callable[[], Awaitable[bytes]], seconds: float = SECONDS
    ) -> bytes:
        """Return the answer of a key: as it is kept, as it is being made for another request, or made now.

        Args:
            key: all that it depends on, as far as that is known.
            make: begins the work.
            seconds: it may be as old as this.
        """
        kept = self._answers.get(key)
        if kept is not None and time.monotonic() - kept.made < seconds:
            self._answers.move_to_end(key)
            return kept.body
        if key not in self._under_way:
            task = asyncio.ensure_future(make())
            self._under_way[key] = task
            task.add_done_callback(lambda done: self._done(key, done))
        return await asyncio.shield(self._under_way[key])

    def _done(self, key: Hashable, done: asyncio.Future[Any]) -> None:
        del self._under_way[key]
        if done.cancelled() or done.exception() is not None:
            return
        self._drop(key)
        self._answers[key] = _Answer(done.result(), time.monotonic())
        self._bytes += len(done.result())
        while self._bytes > self._most and self._answers:
            self._drop(next(iter(self._answers)))

    def _drop(self, key: Hashable) -> None:
        gone = self._answers.pop(key, None)
        self._bytes -= len(gone.body) if gone else 0
