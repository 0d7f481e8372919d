"""The workers that commands use: processes of this machine, or a cluster."""

from __future__ import annotations

import os
from contextlib import AbstractContextManager

from runner.sweep.local import LocalWorkers, R, T, Workers


def worker_pool(
    count: int | None, ray: str | None, tasks: int
) -> AbstractContextManager[Workers[T, R], None]:
    """Return workers, at most one per task; Ray prints messages about workers that died on stdout.

    There are at most `count`, None for one per processor. `ray` is the address of a cluster, empty for Ray on
    this machine; None for processes without Ray.
    """
    if ray is None:
        return LocalWorkers(min(count or os.cpu_count() or 1, tasks))
    from runner.sweep.cluster import RayWorkers

    return RayWorkers(count, ray or None, tasks)
