"""Workers on Ray: the same tasks, on as many machines as a cluster has.

The machines of a cluster must have the project installed, and see the recordings folder under one path: a run
is recorded on its worker's own disk, and moved there when it is whole.
"""

from __future__ import annotations

import os
import socket
import threading
from dataclasses import replace
from typing import Any, Final, Self

from runner.errors import RunnerError
from runner.sweep.task import Result, Task, do
from runner.util.extras import require

_GOODBYE_SECONDS: Final = 30.0
_KNOCK_SECONDS: Final = 5.0


def require_ray() -> Any:
    """Return the module `ray`.

    Raises:
        MissingExtra: it is not installed.
    """
    return require("ray", extra="ray", purpose="a sweep on Ray")


def connect(address: str | None, processors: int | None = None) -> Any:
    """Return the module `ray`, connected to a cluster.

    Args:
        address: of the cluster, or `auto`; None starts Ray on this machine.
        processors: how many Ray is to use of this machine; None for all.

    Raises:
        MissingExtra: Ray is not installed.
        RunnerError: the cluster cannot be reached.
    """
    ray = require_ray()
    options = {"log_to_driver": False, "logging_level": "ERROR"}
    if address is None:
        options |= {"num_cpus": processors or os.cpu_count(), "include_dashboard": False}
    try:
        _knock(address or "")
        ray.init(address=address or "local", **options)
    except (ConnectionError, OSError, RuntimeError, ValueError) as error:
        raise RunnerError(
            f"--ray: no cluster at {address or 'this machine'} can be reached "
            f"({str(error).strip().splitlines()[0]}); `ray status` says whether one runs, and --ray "
            "without an address starts one here. One that asks for a token wants it in RAY_AUTH_TOKEN."
        ) from error
    return ray


class Doer:
    """Does tasks, one at a time, and can be told to stop meanwhile; an actor of Ray."""

    def __init__(self) -> None:
        self._stopping = threading.Event()

    def do(self, task: Task) -> Result:
        """Do a task."""
        return do(task, self._stopping.is_set)

    def stop(self) -> None:
        """Close the recording that is under way, and every one after it at once."""
        self._stopping.set()


class RayWorkers:
    """Actors of Ray, started when they are needed; each keeps what it has loaded.

    Args:
        count: how many at most; None for one a processor of the cluster.
        address: of the cluster, or `auto`; None starts Ray on this machine.
        most: there are never more.

    Raises:
        MissingExtra: Ray is not installed.
        RunnerError: the cluster cannot be reached.
    """

    def __init__(self, count: int | None, address: str | None, most: int) -> None:
        self._ray = connect(address, count)
        processors = int(self._ray.cluster_resources().get("CPU", 1))
        self._count = max(1, min(count or processors, most))
        # Two calls at a time: `stop` must get through while a task is being done.
        self._actor = self._ray.remote(Doer).options(num_cpus=1, max_concurrency=2, max_restarts=0)
        self._elsewhere = address is not None
        self._idle: list[Any] = []
        self._busy: dict[Any, tuple[Any, Task]] = {}

    @property
    def idle(self) -> int:
        """How many more tasks can be given."""
        return self._count - len(self._busy)

    def give(self, task: Task) -> None:
        """Have an idle worker do a task."""
        actor = self._idle.pop() if self._idle else self._actor.remote()
        there = replace(task, elsewhere=self._elsewhere, threads=False)
        self._busy[actor.do.remote(there)] = actor, task

    def collect(self, seconds: float) -> list[tuple[Task, Result | None]]:
        """Return what is done, waiting so long for it; None for a worker that died, and was replaced."""
        done: list[tuple[Task, Result | None]] = []
        ready = self._ray.wait(list(self._busy), timeout=seconds)[0] if self._busy else []
        for reference in ready:
            actor, task = self._busy.pop(reference)
            try:
                result: Result = self._ray.get(reference)
            except self._ray.exceptions.RayError:
                done.append((task, None))
            else:
                done.append((task, result))
                self._idle.append(actor)
        return done

    def stop(self) -> None:
        """Have every worker close its recording and return its task as interrupted."""
        for actor, _ in self._busy.values():
            actor.stop.remote()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        if self._busy:
            self._ray.wait(list(self._busy), num_returns=len(self._busy), timeout=_GOODBYE_SECONDS)
        self._ray.shutdown()


def _knock(address: str) -> None:
    """See if anybody answers at HOST:PORT; Ray itself would wait for minutes.

    Raises:
        OSError: nobody does.
    """
    host, _, port = address.rpartition("//")[2].rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host, int(port)), _KNOCK_SECONDS).close()
