"""Workers on Ray: the same tasks, on the machines of a cluster.

The machines of a cluster must have the project installed, and see the recordings folder under the same path:
a run is recorded on its worker's own disk, and moved there when it is complete.
"""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Callable, Iterable
from types import ModuleType
from typing import Any, Concatenate, Final, ParamSpec, TypeVar

from runner.errors import RunnerError
from runner.sweep.local import CLOSE_SECONDS, LocalWorkers, R, Work, Workers
from runner.sweep.local import T as TaskT
from runner.util.extras import require

_CONNECT_SECONDS: Final = 5.0
P = ParamSpec("P")
T = TypeVar("T")


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
    """Runs one function at a time in a process of Ray."""

    def __init__(self) -> None:
        self._stopping = threading.Event()

    def run(self, function: Callable[Concatenate[RayActor, P], T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Call a function with this actor and these arguments."""
        return function(self, *args, **kwargs)

    def request_stop(self) -> None:
        """Ask the running function, and every later one, to stop."""
        self._stopping.set()

    def stop(self) -> bool:
        """Return whether the function must stop."""
        return self._stopping.is_set()


def _run(actor: RayActor, task: Work) -> object:
    return task.run(actor.stop)


class RayWorkers(Workers[TaskT, R]):
    """Actors of Ray; each keeps what it has loaded.

    There are at most `count`, None for one per processor of the cluster, and never more than `limit`; the
    address is as for `connect`.
    """

    def __init__(self, count: int | None, address: str | None, limit: int) -> None:
        self._ray = connect(address, count)
        processors = int(self._ray.cluster_resources().get("CPU", 1))
        super().__init__(max(1, min(count or processors, limit)))
        self._on_own_disk = address is not None

    def submit(self, task: TaskT) -> None:
        """Start a task on an idle actor, or a new one."""
        if not self._idle:  # a task and two other calls run at the same time
            options = {"num_cpus": 1, "max_concurrency": 3, "max_restarts": 0}
            self._idle.append(self._ray.remote(RayActor).options(**options).remote())
        actor = self._idle.pop()
        remote = task.placed(threads=False, on_own_disk=self._on_own_disk)
        self._busy[actor.run.remote(_run, remote)] = actor, task

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


def worker_pool(count: int | None, ray: str | None, tasks: int) -> Workers[TaskT, R]:
    """Return workers, at most one per task; Ray prints messages about workers that died on stdout.

    There are at most `count`, None for one per processor. `ray` is the address of a cluster, empty for Ray on
    this machine; None for processes without Ray.
    """
    if ray is None:
        return LocalWorkers(min(count or os.cpu_count() or 1, tasks))
    return RayWorkers(count, ray or None, tasks)
