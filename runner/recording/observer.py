"""One thread of the process that watches its machine and its output, for all runs that are being recorded.

Only a run that lasts longer than a second costs a thread. What was seen waits until its recorder writes the
next chunk; a recorder never waits for the thread.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Final

from runner.recording import schema
from runner.recording.console import ConsoleLog, Tee
from runner.recording.machine import SAMPLE_SECONDS, HostSampler, Stopwatch, interval
from runner.recording.messages import Message, encode
from runner.recording.schema import Topic

_MAX_WAITING: Final = 1 << 18
"""The most messages that wait for a recorder; those beyond are left out."""


class Observer:
    """What is seen while one run is recorded: the time that passes, the machine, the output.

    Args:
        folder: the folder of the run.
        host: whether to see what the process uses of its machine.
        console: returns a line of the output as it is to be recorded, without secrets; None for no output.
    """

    def __init__(self, folder: Path, host: bool = False, console: Callable[[str], str] | None = None) -> None:
        self._folder = folder
        self._stopwatch = Stopwatch()
        self.host = host
        self._next_host = 0.0
        self.console = None if console is None else ConsoleLog(console)
        self._seen: deque[tuple[Topic, bytes]] = deque()
        self._needs_thread = host or console is not None

    def take(self, is_last: bool = False) -> list[tuple[Topic, bytes]]:
        """Return the messages since the last call, and the time if that is due.

        The first call begins the session; after the last one nothing more is watched.
        """
        is_first = self._stopwatch.begin()
        if self._needs_thread and is_first:  # not earlier: a resumed run may end without a session
            _thread.add(self)
        if self._needs_thread and is_last:
            _thread.remove(self)
            self.see_console(time.monotonic(), is_last=True)
        elif self._needs_thread and not is_first:  # a short run needs no thread
            _thread.ensure_running()
        messages = [self._seen.popleft() for _ in range(len(self._seen))]
        if is_first or is_last or self._stopwatch.is_due():
            messages.append((schema.CLOCK_TOPIC, self._stopwatch.sample()))
        return messages

    def wants_host(self) -> bool:
        """Return whether a sample of the machine is due."""
        return self.host and self._stopwatch.seconds_at(time.monotonic()) >= self._next_host

    def see_host(self, sample: Message) -> None:
        """Take in a sample of the machine."""
        seconds = self._stopwatch.seconds
        self._next_host = seconds + interval(seconds) - SAMPLE_SECONDS / 2
        with contextlib.suppress(OSError):
            sample = sample | {"disk_free_bytes": float(shutil.disk_usage(self._folder).free)}
        self._see(schema.HOST_TOPIC, time.monotonic(), sample)

    def see_console(self, now: float, is_last: bool = False) -> None:
        """Take in the lines that are due."""
        if self.console is not None:
            for begun, fields in self.console.take(now, is_last):
                self._see(schema.CONSOLE_TOPIC, begun, fields)

    def write(self, now: float, stream: int, text: str) -> None:
        """Take in output; what came before the run began, or in its pause, is none of it."""
        if self.console is not None and self._stopwatch.seconds_at(now) >= 0:
            self.console.write(now, stream, text)

    def _see(self, topic: Topic, now: float, fields: dict[str, object]) -> None:
        stamps = {"started": self._stopwatch.started, "seconds": max(0.0, self._stopwatch.seconds_at(now))}
        if len(self._seen) < _MAX_WAITING:
            self._seen.append((topic, encode(topic.message, stamps | fields)))


class _Thread:
    """The observers of this process, and the thread that serves them once a second."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget all observers and the thread."""
        self._observers: weakref.WeakSet[Observer] = weakref.WeakSet()
        # Reentrant: a signal or a garbage collection may close another run in the thread that holds it.
        self._lock = threading.RLock()
        self._wake = threading.Event()
        self._thread: threading.Thread | None = None
        self._tee: Tee | None = None

    def disown(self) -> None:
        """In a forked process, which has no such thread: leave everything to the process that records."""
        tee = self._tee
        self.clear()  # another thread may have held the lock
        if tee is not None:
            tee.stop()

    def add(self, observer: Observer) -> None:
        """Watch for an observer, once `ensure_running` was called."""
        with self._lock:
            self._observers.add(observer)
            if observer.console is not None and self._tee is None:
                self._tee = Tee()
                self._tee.start()

    def remove(self, observer: Observer) -> None:
        """Watch for it no more; after the last one, stop the thread and give back the streams."""
        with self._lock:
            self._distribute()
            self._observers.discard(observer)
            self._stop_unheard()
            thread = self._thread
            if self._observers or thread is None:
                return
            self._wake.set()
            self._thread, self._wake = None, threading.Event()  # another, or the next thread would stop, too
        # Without the lock, which the thread may wait for. A garbage collection may get here in that thread.
        if thread is not threading.current_thread():
            thread.join(SAMPLE_SECONDS)  # it may wait for a driver or a disk for ever

    def ensure_running(self) -> None:
        """Start the thread, if it does not run."""
        if self._thread is None:  # asked again with the lock: most calls need none
            with self._lock:
                if self._thread is None and self._observers:
                    self._thread = threading.Thread(
                        target=self._run, args=(self._wake,), name="recording-observer", daemon=True
                    )
                    self._thread.start()

    def _run(self, wake: threading.Event) -> None:
        sampler = HostSampler() if any(observer.host for observer in self._observers) else None
        while not wake.wait(SAMPLE_SECONDS):
            with self._lock:
                observers = list(self._observers)
            if not observers:  # their recorders were never closed
                with self._lock:
                    self._stop_unheard()
                    self._thread = None
                return
            if due := [observer for observer in observers if observer.wants_host()]:
                sampler = sampler or HostSampler()
                # Without the lock: a driver may take long to answer, and a recorder never waits for that.
                sample = sampler.sample()
                for observer in due:
                    observer.see_host(sample)
            with self._lock:
                if self._tee is not None:
                    self._tee.patch()
                self._distribute()
                for observer in self._observers:
                    observer.see_console(time.monotonic())
                self._stop_unheard()
            del observers, due  # no recorder is kept alive

    def _distribute(self) -> None:
        """Give what was written to every observer. The caller holds the lock."""
        observers = list(self._observers)
        if self._tee is not None:
            for write in self._tee.take():
                for observer in observers:
                    observer.write(*write)

    def _stop_unheard(self) -> None:
        """Give the streams back if no observer wants more of them. The caller holds the lock."""
        observers = list(self._observers)
        if self._tee is not None and not any(
            observer.console is not None and not observer.console.is_full for observer in observers
        ):
            self._tee.stop()
            self._tee = None


_thread = _Thread()

if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_thread.disown)
