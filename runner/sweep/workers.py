"""Workers for tasks: processes of this machine, or actors of Ray on the machines of a cluster.

Each runs one task after another, and keeps what it has loaded. The machines of a cluster must have the
project installed, and see the recordings folder under the same path: a run is recorded on its worker's own
disk, and moved there when it is complete.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import socket
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from multiprocessing import connection
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Event
from types import ModuleType
from typing import Any, Final, Generic, Protocol, Self, TypeVar

from runner.errors import RunnerError
from runner.util.extras import require
from runner.util.processes import process_context, start_process, starting_processes

CLOSE_SECONDS: Final = 30.0
"""The time that a worker has to close its recording before it is killed."""


PRELOADED: Final = ("runner.execution.session", "runner.sweep.workers")
"""Modules that every worker has from its start, where processes can be forked."""


class Work(Protocol):
    """A task for workers, which goes to them by pickle; so does its result."""

    def placed(self, threads: bool, on_own_disk: bool = False) -> Self:
        """Return the task for a worker with several processors, or with a disk of its own."""

    def run(self, stop: Callable[[], bool]) -> object:
        """Return the result; `stop` is called every few milliseconds, and returns whether to stop."""


T = TypeVar("T", bound=Work)
R = TypeVar("R")


class Workers(ABC, Generic[T, R]):
    """Workers that run tasks T with results R, on this machine or on others; started when needed."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._idle: list[Any] = []
        self._busy: dict[Any, tuple[Any, T]] = {}
        """By what becomes ready when a task ends, its worker and the task."""

    @property
    def idle(self) -> int:
        """The number of tasks that can be started now."""
        return self._count - len(self._busy)

    @abstractmethod
    def submit(self, task: T) -> None:
        """Start a task on an idle worker."""

    def collect(self, seconds: float) -> list[tuple[T, R | None]]:
        """Wait up to this time for tasks to end; return them with their results (None if the worker died)."""
        done: list[tuple[T, R | None]] = []
        if self._busy:
            for key in self._ready(seconds):
                worker, task = self._busy.pop(key)
                result = self._result(worker, key)
                done.append((task, result))
                if result is not None:
                    self._idle.append(worker)
        return done

    @abstractmethod
    def _ready(self, seconds: float) -> Iterable[Any]:
        """Wait up to this time for tasks to end; return their keys in `_busy`."""

    @abstractmethod
    def _result(self, worker: Any, key: Any) -> R | None:
        """Return the result of a task that ended; None if its worker died."""

    @abstractmethod
    def stop(self) -> None:
        """Make every worker close its recording and return its task as interrupted."""

    def __enter__(self) -> Self:
        return self

    @abstractmethod
    def __exit__(self, *_: object) -> None: ...


class LocalWorkers(Workers[T, R]):
    """Processes of this machine."""

    def __init__(self, count: int) -> None:
        super().__init__(count)
        self._context = process_context(PRELOADED)
        with starting_processes():  # an event starts one that tracks it
            self._stopping = self._context.Event()

    def submit(self, task: T) -> None:
        """Start a task on an idle process, or a new one."""
        local = task.placed(threads=self._count < (os.cpu_count() or 1))
        while self._idle:
            worker = self._idle.pop()
            if worker.send(local):
                break
            worker.end()
        else:
            worker = _SweepWorker[R](self._context, self._stopping)
            worker.send(local)  # `collect` notices if it is dead already
        self._busy[worker.pipe] = worker, task

    def _ready(self, seconds: float) -> Iterable[Any]:
        return connection.wait(list(self._busy), seconds)

    def _result(self, worker: _SweepWorker[R], key: Any) -> R | None:  # noqa: ARG002 - its pipe
        return worker.receive()

    def stop(self) -> None:
        """Set the event that every process watches."""
        self._stopping.set()

    def __exit__(self, *_: object) -> None:
        self.stop()
        for worker in [*self._idle, *(worker for worker, _ in self._busy.values())]:
            worker.end()


class _SweepWorker(Generic[R]):
    """A process and the pipe to it."""

    def __init__(self, context: Any, stopping: Event) -> None:
        self.pipe, theirs = context.Pipe()
        self._process = start_process(context, serve, theirs, stopping, name="sweep-worker", daemon=True)
        theirs.close()

    def send(self, task: Work) -> bool:
        """Send a task; return False if the process is dead."""
        try:
            self.pipe.send(task)
        except OSError:
            return False
        return True

    def receive(self) -> R | None:
        """Return the result of the task; None if the process died."""
        try:
            result: R = self.pipe.recv()
        except (EOFError, OSError):
            self.end()
            return None
        return result

    def end(self) -> None:
        """End the process, by force if it does not end by itself."""
        self.pipe.close()
        self._process.join(CLOSE_SECONDS)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def serve(pipe: Connection, stopping: Event) -> None:
    """Run the tasks that come through a pipe until it is closed; the main function of a worker."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches every process of a terminal
    parent = multiprocessing.parent_process()
    assert parent is not None
    with contextlib.suppress(EOFError, OSError):
        while True:
            pipe.send(pipe.recv().run(lambda: stopping.is_set() or not parent.is_alive()))


_CONNECT_SECONDS: Final = 5.0


def connect(address: str | None, processors: int | None = None) -> ModuleType:
    """Return the module `ray`, connected to a cluster.

    The address is that of the cluster, or `auto`; None starts Ray on this machine, which may
    use a number of its processors, or all.

    Raises:
        RunnerError: the cluster cannot be reached.
    """
    ray: ModuleType = require("ray", extra="ray", purpose="a sweep on Ray")
    options = {"log_to_driver": False, "logging_level": "ERROR"}
    if address is None:
        options |= {"num_cpus": processors or os.cpu_count(), "include_dashboard": False}
    host, _, port = (address or "").rpartition("//")[2].rpartition(":")
    try:
        if host and port.isdecimal():  # Ray itself would wait for minutes if nothing listens there
            socket.create_connection((host, int(port)), _CONNECT_SECONDS).close()
        ray.init(address=address or "local", **options)
    except (ConnectionError, OSError, RuntimeError, ValueError) as error:
        raise RunnerError(
            f"--ray: no cluster at {address or 'this machine'} can be reached "
            f"({str(error).strip().splitlines()[0]}); `ray status` shows whether one runs, and --ray "
            "without an address starts one here. If it requires a token, set RAY_AUTH_TOKEN."
        ) from error
    return ray


class RayActor:
    """Runs one task at a time in a process of Ray."""

    def __init__(self) -> None:
        self._stopping = threading.Event()

    def run(self, task: Work) -> object:
        """Return the result of a task."""
        return task.run(self._stopping.is_set)

    def request_stop(self) -> None:
        """Ask the running task, and every later one, to stop."""
        self._stopping.set()


class RayWorkers(Workers[T, R]):
    """Actors of Ray; each keeps what it has loaded.

    There are at most `count`, None for one per processor of the cluster, and never more than `limit`; the
    address is as for `connect`.
    """

    def __init__(self, count: int | None, address: str | None, limit: int) -> None:
        self._ray = connect(address, count)
        processors = int(self._ray.cluster_resources().get("CPU", 1))
        super().__init__(max(1, min(count or processors, limit)))
        self._on_own_disk = address is not None

    def submit(self, task: T) -> None:
        """Start a task on an idle actor, or a new one."""
        if not self._idle:  # a task and two other calls run at the same time
            options = {"num_cpus": 1, "max_concurrency": 3, "max_restarts": 0}
            self._idle.append(self._ray.remote(RayActor).options(**options).remote())
        actor = self._idle.pop()
        remote = task.placed(threads=False, on_own_disk=self._on_own_disk)
        self._busy[actor.run.remote(remote)] = actor, task

    def _ready(self, seconds: float) -> Iterable[Any]:
        done: list[Any] = self._ray.wait(list(self._busy), timeout=seconds)[0]
        return done

    def _result(self, worker: Any, key: Any) -> R | None:  # noqa: ARG002 - the reference knows its actor
        try:
            result: R = self._ray.get(key)
        except self._ray.exceptions.RayError:
            return None
        return result

    def stop(self) -> None:
        """Ask the actor of every task to stop."""
        for actor, _ in self._busy.values():
            actor.request_stop.remote()

    def __exit__(self, *_: object) -> None:
        self.stop()
        if self._busy:
            self._ray.wait(list(self._busy), num_returns=len(self._busy), timeout=CLOSE_SECONDS)
        self._ray.shutdown()


def worker_pool(count: int | None, ray: str | None, tasks: int) -> Workers[T, R]:
    """Return workers, at most one per task; Ray prints messages about workers that died on stdout.

    There are at most `count`, None for one per processor. `ray` is the address of a cluster, empty for Ray on
    this machine; None for processes without Ray.
    """
    if ray is None:
        return LocalWorkers(min(count or os.cpu_count() or 1, tasks))
    return RayWorkers(count, ray or None, tasks)
