"""What a job is given: its folder, where its events go, and whether it must stop."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final, TypeVar

from runner.client.jobs import EventData
from runner.errors import RunnerError
from runner.runs.locking import locked
from runner.runs.run import Run
from runner.service.jobs.store import QueuedJob, read_values

T = TypeVar("T")
REPORT_SECONDS: Final = 0.25
OTHER_OWNER_SECONDS: Final = 60.0
"""Time limit for another owner to release a run; on another host it counts as dead after 15 s."""


@dataclass(frozen=True)
class JobSpec:
    """A job, its folder, and where to do it."""

    folder: Path
    job: QueuedJob
    ray: str | None = None
    """The address of the Ray cluster that this process belongs to; None if it belongs to none."""

    @property
    def recordings(self) -> Path:
        """The recordings folder of the job."""
        return self.folder.parents[1]

    @property
    def workers(self) -> int | None:
        """How many processes may train at once; None for as many as the cluster has."""
        return self.job.workers if self.ray is None else None

    def values(self) -> dict[str, object]:
        """Return the configuration, sweep or question, with every value."""
        return read_values(self.folder)


@dataclass(frozen=True)
class JobChannel:
    """Where a job sends its events, and learns that it must stop."""

    send: Callable[[EventData], None]
    stop: Callable[[], bool]
    """Returns whether the job must stop; called every few milliseconds."""


def until_free(
    attempt: Callable[[], T],
    busy: type[RunnerError],
    stop: Callable[[], bool],
    seconds: float = math.inf,
    waiting: Callable[[], None] = lambda: None,
) -> T:
    """Return the result of a call that is repeated as long as it raises `busy`; `waiting` is called then.

    The error is raised when the job must stop, or after this time.
    """
    deadline = time.monotonic() + seconds
    while True:
        try:
            return attempt()
        except busy:
            if stop() or time.monotonic() > deadline:
                raise
            waiting()
            time.sleep(REPORT_SECONDS)


def wait_for_owners(runs: Iterable[Run], stop: Callable[[], bool]) -> None:
    """Wait until no process owns one of these runs: the workers of a server that was killed are stopping.

    Raises:
        RunnerError: one is still owned after a minute, or when the job must stop.
    """
    for run in runs:
        if run.status == "running":
            until_free(partial(_require_free, run), RunnerError, stop, OTHER_OWNER_SECONDS)


def _require_free(run: Run) -> None:
    with locked(run):
        pass
