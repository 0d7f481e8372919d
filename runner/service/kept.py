"""Answers that are kept for a while, for who asks the same next."""

from __future__ import annotations

import asyncio
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any, Final

from starlette.concurrency import run_in_threadpool

SECONDS: Final = 5.0
"""An answer is kept no longer: what it tells may depend on the time of day."""


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
        """Return the answer of a key: as kept, as another request is having it made, or made in a thread.

        Args:
            key: all that it depends on, with the version of the catalogue.
            make: does the work.
        """
        kept = self._answers.get(key)
        if kept is not None and time.monotonic() - kept.made < SECONDS:
            self._answers.move_to_end(key)
            return kept.body
        if key in self._under_way:
            return await asyncio.shield(self._under_way[key])
        self._under_way[key] = task = asyncio.ensure_future(run_in_threadpool(make))
        task.add_done_callback(lambda done: self._done(key, done))
        return await asyncio.shield(task)

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
