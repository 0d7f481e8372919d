"""Child processes for work that is long, needs much memory, or runs code that cannot be trusted to end.

    with ProcessPool(processes=2, seconds=600, memory_bytes=4 << 30) as pool:
        answer = await pool(function, argument)

A thread waits for each busy process: that works on every platform, unlike an event loop that waits on a pipe.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from http import HTTPStatus
from multiprocessing import forkserver
from typing import Any, Final, ParamSpec, Self, TypeVar

from runner.errors import RunnerError
from runner.service.errors import Refused
from runner.util.processes import CallFailed, ChildProcess, ProcessDied, start_method

Args = ParamSpec("Args")
Answer = TypeVar("Answer")

MAX_WAITING: Final = 32
"""Calls that may wait for a process; more are refused."""
_PRELOADED: Final = ["runner.service.jobs.preload"]


class Busy(Refused):
    """Too many calls are waiting."""

    def __init__(self, message: str, headers: dict[str, str] | None = None) -> None:
        super().__init__(HTTPStatus.SERVICE_UNAVAILABLE, message, headers)


class ProcessPool:
    """A bounded number of child processes with limits on time and memory; may be used by any thread.

    Args:
        processes: how many run at the same time.
        seconds: a call that takes longer is killed.
        memory_bytes: how much a call may allocate; not limited on Windows.
        keep_seconds: how long an idle process is kept for the next call; 0: a process serves one call; None:
            it is kept until the pool is closed.
    """

    def __init__(
        self, processes: int, seconds: float, memory_bytes: int, keep_seconds: float | None = 0.0
    ) -> None:
        self.seconds = seconds
        self._memory_bytes, self._keep_seconds = memory_bytes, keep_seconds
        self._context = start_method(_PRELOADED)
        self._threads = ThreadPoolExecutor(processes, "processes")
        self._places = threading.Semaphore(processes + MAX_WAITING)
        self._lock = threading.Lock()
        self._children: set[_Child] = set()
        self._idle: list[_Child] = []
        self._closed = threading.Event()

    def __enter__(self) -> Self:
        """Start the process that all others are forked from, so that the first call need not wait for it."""
        if self._context.get_start_method() == "forkserver":
            forkserver.ensure_running()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End all processes; calls under way fail."""
        with self._lock:
            self._closed.set()
            children = list(self._children)
        for child in children:
            child.kill()
        self._threads.shutdown(wait=True)  # calls that wait fail, as the pool is closed
        for child in list(self._idle):
            self._end(child)

    async def __call__(
        self, function: Callable[Args, Answer], *args: Args.args, **keywords: Args.kwargs
    ) -> Answer:
        """Return what a function returns in a child process; arguments and errors as for `submit`."""
        return await asyncio.wrap_future(self.submit(function, *args, **keywords))

    def submit(
        self, function: Callable[Args, Answer], *args: Args.args, **keywords: Args.kwargs
    ) -> Future[Answer]:
        """Return the future result of a function that is called in a child process.

        Args:
            function: of a module, not nested.
            args: of it; they and the result are pickled, between our own processes.
            keywords: of it.

        Raises:
            Busy: too many calls are waiting. The future raises the function's own `RunnerError` or `OSError`,
                or `TimedOut`, `OutOfMemory`, `ProcessDied`.
        """
        if not self._places.acquire(blocking=False):
            raise busy()
        try:
            future = self._threads.submit(self._call, function, args, keywords)
        except BaseException:
            self._places.release()
            raise
        future.add_done_callback(lambda _: self._places.release())
        return future

    def _call(self, function: Callable[..., Any], args: Any, keywords: Any) -> Any:
        while True:
            child = self._started()
            was_idle = child.uses > 0
            try:
                return self._called(child, function, args, keywords)
            except ProcessDied:
                if not was_idle:  # else it may have died before: only a new process says whose fault it was
                    raise

    def _called(self, child: _Child, function: Callable[..., Any], args: Any, keywords: Any) -> Any:
        is_reusable = False
        try:
            result = child.call(function, self.seconds, *args, **keywords)
            is_reusable = self._keep_seconds != 0
        except CallFailed:
            raise
        except (RunnerError, OSError, RuntimeError):  # raised by the function: the process waits for the next
            is_reusable = self._keep_seconds != 0
            raise
        finally:
            if is_reusable:
                self._keep(child)
            else:
                self._end(child)
        return result

    def _started(self) -> _Child:
        """Return an idle process that lives, or a new one."""
        while True:
            with self._lock:
                if self._closed.is_set():
                    raise ProcessDied("the service is stopping.")
                child = self._idle.pop() if self._idle else None
                if child is not None and child.timer is not None:
                    child.timer.cancel()  # else each call would leave a thread behind for `keep_seconds`
            if child is None:
                try:
                    child = _Child(self._memory_bytes, self._context)
                except OSError as error:
                    raise Busy(f"the system has no process for it ({error.strerror}); try again.") from error
                with self._lock:
                    self._children.add(child)
                    if self._closed.is_set():  # after all others were killed
                        child.kill()
                return child
            if child.is_alive():
                return child
            self._end(child)

    def _keep(self, child: _Child) -> None:
        """Keep a process for the next call, and end it here, not by itself, when none comes.

        A process that ended by itself could do so just as a call is sent to it.
        """
        with self._lock:
            child.uses += 1
            child.timer = None
            if self._keep_seconds is not None:
                child.timer = threading.Timer(self._keep_seconds, self._end_idle, (child, child.uses))
                child.timer.daemon = True
                child.timer.start()
            self._idle.append(child)

    def _end_idle(self, child: _Child, uses: int) -> None:
        with self._lock:
            if child not in self._idle or child.uses != uses:
                return
            self._idle.remove(child)
        self._end(child)

    def _end(self, child: _Child) -> None:
        child.end()
        with self._lock:
            self._children.discard(child)
            if child in self._idle:
                self._idle.remove(child)


class _Child(ChildProcess):
    """A process of the pool."""

    uses = 0
    timer: threading.Timer | None = None
    """Ends the process while it is idle, unless it is kept until the pool is closed."""


def busy() -> Busy:
    """Return the error that too many calls are waiting."""
    return Busy("the service is busy; try again.", {"retry-after": "5"})
