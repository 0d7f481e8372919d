"""Worker processes of this machine: each does one task after the other, and keeps what it has loaded."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
from dataclasses import replace
from multiprocessing import connection
from typing import Any, Final, Protocol, Self

from runner.sweep.task import Result, Task, do

_GOODBYE_SECONDS: Final = 30.0
"""How long a worker may take to close a recording before it is ended."""


class Workers(Protocol):
    """Those who do tasks, here or elsewhere."""

    @property
    def idle(self) -> int:
        """How many more tasks can be given."""

    def give(self, task: Task) -> None:
        """Have an idle worker do a task."""

    def collect(self, seconds: float) -> list[tuple[Task, Result | None]]:
        """Return what is done, waiting so long for it; None for a worker that died, and was replaced."""

    def stop(self) -> None:
        """Have every worker close its recording and return its task as interrupted."""


class LocalWorkers:
    """Processes, started when they are needed.

    Args:
        count: how many at most.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        # Fresh interpreters: a fork would take the locks of this one's threads along.
        self._context = multiprocessing.get_context("spawn")
        self._stopping = self._context.Event()
        self._idle: list[_Worker] = []
        self._busy: dict[Any, tuple[_Worker, Task]] = {}

    @property
    def idle(self) -> int:
        """How many more tasks can be given."""
        return self._count - len(self._busy)

    def give(self, task: Task) -> None:
        """Have an idle worker do a task."""
        here = replace(task, threads=self._count < (os.cpu_count() or 1))
        while self._idle:
            worker = self._idle.pop()
            if worker.ask(here):
                break
            worker.end()
        else:
            worker = _Worker(self._context, self._stopping)
            worker.ask(here)  # `collect` finds out if it is gone already
        self._busy[worker.pipe] = worker, task

    def collect(self, seconds: float) -> list[tuple[Task, Result | None]]:
        """Return what is done, waiting so long for it; None for a worker that died, and was replaced."""
        done: list[tuple[Task, Result | None]] = []
        for pipe in connection.wait(list(self._busy), seconds) if self._busy else ():
            worker, task = self._busy.pop(pipe)
            result = worker.answer()
            done.append((task, result))
            if result is not None:
                self._idle.append(worker)
        return done

    def stop(self) -> None:
        """Have every worker close its recording and return its task as interrupted."""
        self._stopping.set()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        for worker in [*self._idle, *(worker for worker, _ in self._busy.values())]:
            worker.end()


class _Worker:
    """One process, and the pipe to it."""

    def __init__(self, context: Any, stopping: Any) -> None:
        self.pipe, theirs = context.Pipe()
        self._process = context.Process(
            target=serve, args=(theirs, stopping), name="sweep-worker", daemon=True
        )
        self._process.start()
        theirs.close()

    def ask(self, task: Task) -> bool:
        """Send a task; return False if the process is gone."""
        try:
            self.pipe.send(task)
        except OSError:
            return False
        return True

    def answer(self) -> Result | None:
        """Return what came of the task; None if the process died over it."""
        try:
            result: Result = self.pipe.recv()
        except (EOFError, OSError):
            self.end()
            return None
        return result

    def end(self) -> None:
        """Let the process go, or end it if it does not."""
        self.pipe.close()
        self._process.join(_GOODBYE_SECONDS)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def serve(pipe: Any, stopping: Any) -> None:
    """Do the tasks that come through a pipe, until it is closed; a worker's main function."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches every process of a terminal
    parent = os.getppid()
    with contextlib.suppress(EOFError, OSError):
        while True:
            pipe.send(do(pipe.recv(), lambda: stopping.is_set() or os.getppid() != parent))
