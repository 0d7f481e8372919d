"""Work in a process of its own: what takes long, or much memory, or may be cut off."""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import signal
import traceback
from collections.abc import Callable
from http import HTTPStatus
from multiprocessing import forkserver
from multiprocessing.connection import Connection
from typing import Any, Final, ParamSpec, TypeVar

from runner.errors import RunnerError
from runner.service.refused import Refused

Args = ParamSpec("Args")
Answer = TypeVar("Answer")

WAITING: Final = 32
"""So many may wait for their turn; more are turned away."""
_PRELOADED: Final = ["runner.service.preloaded"]


class Apart:
    """Processes for work, a few at the same time; each does one thing and ends.

    Args:
        processes: how many.
        seconds: after which one is killed.
    """

    def __init__(self, processes: int, seconds: float) -> None:
        self._turns, self._seconds = asyncio.Semaphore(processes), seconds
        self._waiting = 0
        self._context = _context()

    def prepare(self) -> None:
        """Begin the process that the others come from, so that the first one is there at once."""
        if self._context.get_start_method() == "forkserver":
            forkserver.ensure_running()

    async def __call__(
        self, function: Callable[Args, Answer], *args: Args.args, **keywords: Args.kwargs
    ) -> Answer:
        """Return what a function returns in a process of its own.

        Args:
            function: of a module, not nested.
            args: of it; they and the answer are handed over by `pickle`, between our own processes.
            keywords: of it.

        Raises:
            Refused: too many are waiting, or it took too long.
            RunnerError: as the function does; or the process died.
        """
        if self._waiting >= WAITING:
            raise Refused(
                HTTPStatus.SERVICE_UNAVAILABLE, "the service is busy; try again.", {"retry-after": "5"}
            )
        self._waiting += 1
        try:
            await self._turns.acquire()
        finally:
            self._waiting -= 1
        try:
            answer: Answer = await self._done(function, args, keywords)
            return answer
        finally:
            self._turns.release()

    async def _done(self, function: Callable[..., Any], args: Any, keywords: Any) -> Any:
        mine, its = self._context.Pipe(duplex=False)
        process = self._context.Process(target=_work, args=(its, function, args, keywords), daemon=True)
        loop = asyncio.get_running_loop()
        try:
            await loop.run_in_executor(None, process.start)
            its.close()
            kind, found = await self._received(mine)
        finally:
            process.kill() if process.is_alive() else None
            await loop.run_in_executor(None, process.join)
            process.close()
            mine.close()
        if kind == "error":
            raise _rebuilt(*found)
        if kind == "unexpected":
            raise RuntimeError(found)
        return found

    async def _received(self, mine: Connection) -> tuple[str, Any]:
        """Return what a process sends, without a thread that waits for it."""
        loop, there = asyncio.get_running_loop(), asyncio.Event()
        loop.add_reader(mine.fileno(), there.set)
        try:
            async with asyncio.timeout(self._seconds):
                await there.wait()
        except TimeoutError:
            raise Refused(
                HTTPStatus.SERVICE_UNAVAILABLE,
                f"this took longer than {self._seconds:.0f} s and was given up; ask for less.",
            ) from None
        finally:
            loop.remove_reader(mine.fileno())
            os.set_blocking(mine.fileno(), True)  # which the loop may have taken away
        try:
            found: tuple[str, Any] = await loop.run_in_executor(None, mine.recv)
            return found
        except EOFError:
            raise Refused(
                HTTPStatus.SERVICE_UNAVAILABLE,
                "the process that worked on this died; it may have run out of memory.",
            ) from None


def _context() -> Any:
    """Return the way to begin a process: of one that has loaded what they need, where that is possible."""
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_PRELOADED)
    return context


def _work(its: Connection, function: Callable[..., Any], args: Any, keywords: Any) -> None:
    """Send what a function returns, or its error."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the service's to act on
    try:
        told = ("done", function(*args, **keywords))
    except (RunnerError, OSError) as error:
        told = ("error", (type(error), error.args, vars(error)))
    except Exception:
        told = ("unexpected", traceback.format_exc())
    its.send(told)
    its.close()


def _rebuilt(kind: type[Exception], args: tuple[Any, ...], attributes: dict[str, Any]) -> Exception:
    """Return an error as it was in the other process."""
    error = kind.__new__(kind, *args)
    vars(error).update(attributes)
    return error
