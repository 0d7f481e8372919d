"""The workers that commands use: processes of this machine, or a cluster."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator

from runner.sweep.local import LocalWorkers, R, T, Workers


@contextlib.contextmanager
def worker_pool(count: int | None, ray: str | None, tasks: int) -> Iterator[Workers[T, R]]:
    """Yield workers, at most one per task.

    Args:
        count: the maximum number of workers; None for one per processor.
        ray: the address of a cluster, empty for Ray on this machine; None for processes without Ray.
        tasks: the number of tasks.

    Raises:
        MissingExtra: Ray is not installed.
        RunnerError: the cluster cannot be reached.
    """
    if ray is None:
        with LocalWorkers[T, R](min(count or os.cpu_count() or 1, tasks)) as local:
            yield local
        return
    from runner.sweep.cluster import RayWorkers

    with contextlib.redirect_stdout(sys.stderr):  # Ray's messages about dead workers are no results
        cluster: RayWorkers[T, R] = RayWorkers(count, ray or None, tasks)
        with cluster as remote:
            yield remote
