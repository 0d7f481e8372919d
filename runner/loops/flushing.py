"""One thread that flushes all open loops of this process twice a second; and what a fork or SIGTERM ends."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time
import weakref
from typing import Any, Final, Protocol

from runner.recording.recorder import FLUSH_SECONDS

_RETRY_SECONDS: Final = 0.01
"""When a signal that interrupted the recording of a step is sent again; a step takes microseconds."""


class Flushable(Protocol):
    """An open loop."""

    started: float
    closed: bool
    is_foreign: bool

    def flush(self) -> bool:
        """Write what is half a second old; return whether to call it again."""

    def disown(self) -> None:
        """Leave the recording to the process that this one was just forked from."""


class Flusher:
    """The open loops of this process, and one thread that flushes them twice a second."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget all loops and the thread, and replace the lock."""
        self.loops: weakref.WeakSet[Flushable] = weakref.WeakSet()
        self._to_flush: weakref.WeakSet[Flushable] = weakref.WeakSet()
        self._thread: threading.Thread | None = None
        self._lock = threading.Lock()  # for `_to_flush` and `_thread`: a loop is added, or the thread ends

    def add(self, loop: Flushable) -> None:
        """Flush a loop from now on, as long as its `flush` returns True; close it before SIGTERM ends it."""
        is_main = threading.current_thread() is threading.main_thread()
        if is_main and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:  # else the user has a handler
            with contextlib.suppress(ValueError):  # not the main interpreter
                signal.signal(signal.SIGTERM, _end_by_signal)
        with self._lock:
            self.loops.add(loop)
            self._to_flush.add(loop)
            if self._thread is None:
                self._thread = threading.Thread(target=self._flush_all, name="recording-flush", daemon=True)
                self._thread.start()

    def _flush_all(self) -> None:
        while True:
            time.sleep(FLUSH_SECONDS)
            with self._lock:
                loops = list(self._to_flush)
                if not loops:
                    self._thread = None
                    return
            for loop in loops:
                if not loop.flush():  # without the lock: a loop that begins does not wait for slow disks
                    with self._lock:
                        self._to_flush.discard(loop)
            del loop, loops  # nothing is kept alive while the thread sleeps


FLUSHER = Flusher()


def open_loops() -> list[Any]:
    """Return the loops that this process records, each a `Loop`, the oldest first."""
    loops = [loop for loop in FLUSHER.loops if not loop.closed and not loop.is_foreign]
    return sorted(loops, key=lambda loop: loop.started)


def _end_by_signal(number: int, _frame: object) -> None:
    """Close the recordings of this process as interrupted, then let the signal end it as it would have."""
    loops = open_loops()
    if any(loop.lock._is_owned() for loop in loops):  # this thread is recording: it must complete that first
        threading.Timer(_RETRY_SECONDS, os.kill, (os.getpid(), number)).start()
        return
    signal.signal(number, signal.SIG_DFL)  # a second signal ends it at once
    for loop in loops:
        with contextlib.suppress(Exception):  # the run then has the status failed, with the reason
            loop.close("interrupted")
    os.kill(os.getpid(), number)


_mask: set[int] = set()
"""The signals that were blocked before the last fork."""


def _before_fork() -> None:
    """Keep SIGTERM waiting for a forked process until it has no handler: before, it would be lost."""
    global _mask  # noqa: PLW0603 - passed between the hooks of one fork
    _mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])


def _unblock() -> None:
    signal.pthread_sigmask(signal.SIG_SETMASK, _mask)


def _after_fork() -> None:
    """In a forked process: it has no such thread, and the recordings belong to the other process."""
    loops = list(FLUSHER.loops)
    FLUSHER.clear()
    if signal.getsignal(signal.SIGTERM) is _end_by_signal:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
    _unblock()
    for loop in loops:
        loop.disown()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_before_fork, after_in_parent=_unblock, after_in_child=_after_fork)
