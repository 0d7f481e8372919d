"""A pool of child processes for work that is long, needs much memory, or cannot be trusted to end.

    with ProcessPool(processes=2, seconds=600, memory_bytes=4 * 10**9) as pool:
        result = await pool(function, argument)

A thread waits for each busy process: unlike an event loop that waits for a pipe, this works on every
platform.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import threading
from collections.abc import Callable
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from multiprocessing import forkserver
from typing import Final, Self, TypeVar, TypeVarTuple

from runner.service.errors import Busy
from runner.util.processes import (
    CallFailed,
    ChildProcess,
    NeverBegun,
    OutOfMemory,
    ProcessDied,
    process_context,
    starting_processes,
)

Args = TypeVarTuple("Args")
Result = TypeVar("Result")

PRELOADED: Final = (
    "duckdb",
    "gymnasium",
    "jinja2",
    "numpy.ma",
    "pygame",
    "runner.analysis.diff",
    "runner.analysis.qtable",
    "runner.analysis.series",
    "runner.debugging.what_if",
    "runner.debugging.when",
    "runner.debugging.why",
    "runner.environments.loading",
    "runner.execution.estimate",
    "runner.execution.session",
    "runner.query.find",
    "runner.replay.environment",
    "runner.runs.importing",
    "runner.service.computed",
    "runner.service.curves",
    "runner.service.jobs.worker",
    "runner.service.uploads",
    "runner.service.preloaded",
)
"""Modules that every process has from its start, where processes can be forked; those that are installed.

Most environments draw by pygame, whose import takes as long as all else until their first picture. NumPy
loads `numpy.ma` only when a process needs it, as nearly all of these do.
"""


KEEP_SECONDS: Final = 60.0
"""How long an idle process waits for its next call, which then need not wait for one to start."""
_STOP_SECONDS: Final = 5.0
"""How long a process may take to end when nobody waits for its call any more."""
_STOPPING: Final = "the service is stopping; try again once it has started again."


def lower_priority() -> None:
    """Let this process, which trains or verifies, yield to the server, whose users are waiting."""
    with contextlib.suppress(OSError, AttributeError):  # not on Windows
        os.nice(5)


class _Call:
    """A call that may be stopped, before and while a process does it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._child: ChildProcess | None = None
        self._is_stopped = False

    def run_in(
        self, child: ChildProcess, function: Callable[[*Args], Result], seconds: float, *args: *Args
    ) -> Result:
        """Return what a function returns in a process; `CancelledError` if it was stopped."""
        with self._lock:
            if self._is_stopped:
                raise CancelledError
            self._child = child
        try:
            return child.call(function, seconds, *args)
        except ProcessDied:
            if self._is_stopped:
                raise CancelledError from None
            raise
        finally:
            with self._lock:
                self._child = None  # which may serve the next call now

    def stop(self) -> None:
        """Have its process, if it has one, remove its temporary files and end."""
        with self._lock:
            self._is_stopped = True
            if self._child is not None:
                self._child.stop()

    def kill(self) -> None:
        """Kill its process, if it has one."""
        with self._lock:
            if self._child is not None:
                self._child.kill()


class ProcessPool:
    """A bounded number of child processes with limits on time and memory; thread-safe.

    Args:
        processes: how many run at the same time.
        seconds: the time limit of a call, after which its process is killed.
        memory_bytes: how much a call may allocate; not limited on Windows.
        keep_seconds: how long after a call its process may serve the next one; see `ChildProcess`.
        max_waiting: how many calls may wait for a process; more are refused.
    """

    def __init__(
        self,
        processes: int,
        seconds: float,
        memory_bytes: int,
        keep_seconds: float | None = KEEP_SECONDS,
        max_waiting: int = 32,
    ) -> None:
        self._seconds = seconds
        self._memory_bytes = memory_bytes
        self._keep_seconds = keep_seconds
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # it would print to the service's stdout
        self._context = process_context(PRELOADED)
        self._threads = ThreadPoolExecutor(processes, "processes")
        self._places = threading.Semaphore(processes + max_waiting)
        self._lock = threading.Lock()
        self._children: set[ChildProcess] = set()
        self._thread = threading.local()
        """The process of each thread, as `child`."""
        self._closed = threading.Event()

    def __enter__(self) -> Self:
        """Start the process that all others are forked from, so that the first call need not wait for it."""
        if self._context.get_start_method() == "forkserver":
            with starting_processes():
                forkserver.ensure_running()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Kill all processes; calls that run or wait fail."""
        with self._lock:
            self._closed.set()
            for child in self._children:
                child.kill()
        self._threads.shutdown(wait=True)
        for child in list(self._children):
            self._end(child)

    async def __call__(
        self, function: Callable[[*Args], Result], *args: *Args, seconds: float | None = None
    ) -> Result:
        """Return what a function returns in a child process, which ends if the caller is cancelled.

        Arguments and errors are as for `submit`; by default it has the time of the pool.
        """
        call = _Call()
        limit = seconds or self._seconds
        future = self._submit(lambda child: call.run_in(child, function, limit, *args))
        waiting = asyncio.wrap_future(future)
        try:
            return await asyncio.shield(waiting)
        except asyncio.CancelledError:
            if not future.cancel():
                call.stop()
                if not (await asyncio.wait({waiting}, timeout=_STOP_SECONDS))[0]:
                    call.kill()
            waiting.add_done_callback(lambda done: done.cancelled() or done.exception())  # nobody asks
            raise

    def submit(self, seconds: float, function: Callable[[*Args], Result], *args: *Args) -> Future[Result]:
        """Return the future result of a function of a module, called in a child process within some seconds.

        Arguments and result are pickled, between our own processes. The future raises the function's own
        `RunnerError` or `OSError`, or `TimedOut`, `OutOfMemory`, `ProcessDied`, or `Busy` when the pool is
        closed; `Busy` is raised if too many calls are waiting.
        """
        return self._submit(lambda child: child.call(function, seconds, *args))

    def _submit(self, call: Callable[[ChildProcess], Result]) -> Future[Result]:
        if not self._places.acquire(blocking=False):
            raise Busy
        try:
            future = self._threads.submit(self._call, call)
        except BaseException:
            self._places.release()
            raise
        future.add_done_callback(lambda _: self._places.release())
        return future

    def _call(self, call: Callable[[ChildProcess], Result]) -> Result:
        """Return the result of a call in the process of this thread, or in a new one."""
        child: ChildProcess | None = self._thread.__dict__.pop("child", None)
        if child is not None:
            # It may have ended while it was idle, or have too little memory left after earlier calls.
            with contextlib.suppress(NeverBegun, OutOfMemory):
                return self._call_in(child, call)
        return self._call_in(self._start(), call)

    def _call_in(self, child: ChildProcess, call: Callable[[ChildProcess], Result]) -> Result:
        self._thread.child = child
        try:
            return call(child)
        except CallFailed:
            del self._thread.child
            self._end(child)
            if self._closed.is_set():
                raise Busy(_STOPPING) from None
            raise

    def _start(self) -> ChildProcess:
        if self._closed.is_set():
            raise Busy(_STOPPING)
        try:
            child = ChildProcess(self._memory_bytes, self._context, keep_seconds=self._keep_seconds)
        except OSError as error:
            raise Busy(f"the system has no process for it ({error.strerror}); try again.") from error
        with self._lock:
            self._children.add(child)
            if self._closed.is_set():  # after all others were killed
                child.kill()
        return child

    def _end(self, child: ChildProcess) -> None:
        child.end()
        with self._lock:
            self._children.discard(child)
