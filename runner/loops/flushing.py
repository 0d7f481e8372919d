"""One thread that flushes all loops of a process; a forked process leaves its parent's loops alone."""

from __future__ import annotations

import os
import threading
import time
import weakref
from typing import Protocol

from runner.recording.recorder import FLUSH_SECONDS


class Flushable(Protocol):
    """A loop that is being recorded."""

    def flush(self) -> bool:
        """Write what waits; return whether to call it again."""

    def disown(self) -> None:
        """Stop recording in a process that was forked from the one that records."""


class _Watched:
    """The loops of this process that are open, and the thread that flushes them."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget all loops, the thread, and whoever holds the lock."""
        self.loops: weakref.WeakSet[Flushable] = weakref.WeakSet()
        self.to_flush: weakref.WeakSet[Flushable] = weakref.WeakSet()
        self.thread: threading.Thread | None = None
        self.lock = threading.Lock()


_watched = _Watched()


def watch(loop: Flushable) -> None:
    """Flush a loop twice a second from now on, as long as `flush` returns True."""
    with _watched.lock:
        _watched.loops.add(loop)
        _watched.to_flush.add(loop)
        if _watched.thread is None:
            _watched.thread = threading.Thread(target=_flush_all, name="recording-flush", daemon=True)
            _watched.thread.start()


def _flush_all() -> None:
    watched = _watched
    while True:
        time.sleep(FLUSH_SECONDS)
        with watched.lock:
            loops = list(watched.to_flush)
            if not loops:
                watched.thread = None
                return
        for loop in loops:
            if not loop.flush():
                with watched.lock:
                    watched.to_flush.discard(loop)
        del loop, loops  # nothing is kept alive while the thread sleeps


def _after_fork() -> None:
    """In a forked process: no thread is left there, and the recordings belong to the other process."""
    loops = list(_watched.loops)
    _watched.clear()
    for loop in loops:
        loop.disown()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
