"""Child processes for work that is long, needs much memory, or runs code that cannot be trusted to end.

    with ProcessPool(processes=2, seconds=600, memory_bytes=4 << 30) as pool:
        answer = await pool(function, argument)

A thread waits for each busy process: that works on every platform, unlike an event loop that waits on a pipe.
"""

from __future__ import annotations

import asyncio
import contextlib
import multiprocessing
import signal
import threading
import traceback
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from http import HTTPStatus
from multiprocessing import forkserver
from pathlib import Path
from typing import Any, Final, ParamSpec, Self, TypeVar

from runner.errors import RunnerError
from runner.service.errors import Refused

Args = ParamSpec("Args")
Answer = TypeVar("Answer")

MAX_WAITING: Final = 32
"""Calls that may wait for a process; more are refused."""
_PRELOADED: Final = ["runner.service.jobs.preload"]


class WorkFailed(Refused):
    """A call came to no end of its own."""

    def __init__(self, message: str, headers: dict[str, str] | None = None) -> None:
        super().__init__(HTTPStatus.SERVICE_UNAVAILABLE, message, headers)


class Busy(WorkFailed):
    """Too many calls are waiting."""


class TimedOut(WorkFailed):
    """A call exceeded its time limit."""


class OutOfMemory(WorkFailed):
    """A call exceeded its memory limit."""


class ProcessDied(WorkFailed):
    """The process died over a call."""


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
        self._context = _context()
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
            kind, result = child.call((function, args, keywords), self.seconds)
            is_reusable = kind != "memory" and self._keep_seconds != 0
        finally:
            if is_reusable:
                self._keep(child)
            else:
                self._end(child)
        if kind == "memory":
            limit = f"{self._memory_bytes / (1 << 30):g} GiB"
            raise OutOfMemory(f"this needs more than {limit} of memory, and was given up; ask for less.")
        if kind == "error":
            raise _rebuilt(*result)
        if kind == "unexpected":
            raise RuntimeError(result)
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
                    child = _Child(self._context, self._memory_bytes)
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


class _Child:
    """A process that calls functions, one after the other."""

    def __init__(self, context: Any, memory_bytes: int) -> None:
        self.uses = 0
        self.timer: threading.Timer | None = None
        """Ends the process while it is idle, unless that is kept until the pool is closed."""
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, memory_bytes), daemon=True)
        try:
            self._process.start()
        except BaseException:
            self._pipe.close()
            raise
        finally:
            theirs.close()

    def call(self, work: tuple[Callable[..., Any], Any, Any], seconds: float) -> tuple[str, Any]:
        """Return the kind of a call's result, and the result.

        Raises:
            TimedOut, ProcessDied: there is none.
        """
        try:
            self._pipe.send(work)
            if not self._pipe.poll(seconds):
                raise TimedOut(f"this took longer than {seconds:g} s and was given up; ask for less.")
            kind, result = self._pipe.recv()
        except (EOFError, OSError):
            raise ProcessDied(
                "the process that worked on this died; it may have run out of memory."
            ) from None
        return kind, result

    def is_alive(self) -> bool:
        """Return whether the process lives."""
        return bool(self._process.is_alive())

    def kill(self) -> None:
        """Kill the process, while another thread may be waiting for it."""
        with contextlib.suppress(ValueError):  # closed meanwhile
            self._process.kill()

    def end(self) -> None:
        """Kill the process and free what it held."""
        self.kill()
        with contextlib.suppress(ValueError):
            self._process.join()
            self._process.close()
        self._pipe.close()


def busy() -> Busy:
    """Return the error that too many calls are waiting."""
    return Busy("the service is busy; try again.", {"retry-after": "5"})


def _context() -> Any:
    """Return how processes are started: forked from one that has loaded what they need, where possible."""
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_PRELOADED)
    return context


def _serve(pipe: Any, memory_bytes: int) -> None:
    """Call functions that come through a pipe, and send what they return, until it is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the service's to act on
    _limit_memory(memory_bytes)
    with contextlib.suppress(EOFError, BrokenPipeError):
        while True:
            function, args, keywords = pipe.recv()
            pipe.send(_outcome(function, args, keywords))


def _outcome(function: Callable[..., Any], args: Any, keywords: Any) -> tuple[str, Any]:
    try:
        return "done", function(*args, **keywords)
    except MemoryError:
        return "memory", None
    except (RunnerError, OSError) as error:
        if _ran_out_of_memory(error):
            return "memory", None
        return "error", (type(error), error.args, vars(error))
    except Exception as error:
        return ("memory", None) if _ran_out_of_memory(error) else ("unexpected", traceback.format_exc())


def _ran_out_of_memory(error: BaseException) -> bool:
    """Return whether an error came of a `MemoryError`, which others may have wrapped."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, MemoryError):
            return True
        cause = cause.__cause__ or cause.__context__
    return False


def _limit_memory(more_bytes: int) -> None:
    """Limit what this process may allocate from now on."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        limit = _allocated_bytes() + more_bytes
        resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))


def _allocated_bytes() -> int:
    """Return what counts against `RLIMIT_DATA` already: stacks and buffers of libraries, by the core."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmData:"):
                return int(line.split()[1]) << 10
    return 0


def _rebuilt(kind: type[Exception], args: tuple[Any, ...], attributes: dict[str, Any]) -> Exception:
    """Return an error as it was in the other process."""
    error = kind.__new__(kind, *args)
    vars(error).update(attributes)
    return error
