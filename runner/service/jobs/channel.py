"""The specification of a job, and the worker's end of the pipe to the server."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final, Protocol, TypeVar

from runner.client.jobs import EventData
from runner.errors import RunnerError
from runner.runs.listing import run_at
from runner.runs.run import Run
from runner.service.jobs.store import Job, read_values

T = TypeVar("T")
REPORT_SECONDS: Final = 0.25
OTHER_OWNER_SECONDS: Final = 60.0
"""Time limit for another owner to release a run; on another host it counts as dead after 15 s."""


@dataclass(frozen=True)
class JobSpec:
    """What a worker process needs to know of a job."""

    job: Job
    recordings: Path
    workers: int | None
    """How many processes may train at once; None for as many as a cluster has."""
    ray: str | None
    """The address of the Ray cluster that runs the job; None for this machine."""

    def values(self) -> dict[str, object]:
        """Return the configuration or sweep, every value present."""
        return read_values(self.recordings, self.job.number)


class JobChannel(Protocol):
    """Where a run sends its events, and learns that it must stop."""

    def send(self, event: EventData) -> None:
        """Send an event to the server."""

    def stop(self) -> bool:
        """Return whether the run must stop."""


class PipeChannel:
    """The worker's end of the pipe to the server.

    The server sends one message: that the job must stop. If the server dies, the worker stops as well: it
    closes its recording, so that the next server of the folder can resume it.
    """

    def __init__(self, pipe: Connection) -> None:
        self._pipe = pipe
        self._stopping = threading.Event()
        self._lock = threading.Lock()
        threading.Thread(target=self._receive, name="channel", daemon=True).start()

    def send(self, event: EventData) -> None:
        """Send an event to the server; nothing happens if it is gone."""
        with self._lock, contextlib.suppress(OSError):
            self._pipe.send(event)

    def stop(self) -> bool:
        """Return whether the job must stop."""
        return self._stopping.is_set()

    def request_stop(self, *_: object) -> None:
        """Stop the job; also a handler of signals."""
        self._stopping.set()

    def _receive(self) -> None:
        with contextlib.suppress(EOFError, OSError):
            self._pipe.recv()
        self.request_stop()


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
            until_free(partial(_require_free, run.folder), RunnerError, stop, OTHER_OWNER_SECONDS)


def _require_free(folder: Path) -> None:
    run = run_at(folder)
    if run.status == "running":
        owner = run.file.owner
        raise RunnerError(
            f"run {run.run_id} is still running (process {owner.get('pid')} on {owner.get('host')}); "
            "resume the job when that has ended."
        )
