"""A job, as its worker is told, and what both kinds of job share."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, Protocol

from runner.errors import RunnerError
from runner.runs.run import Run, run_at
from runner.service.jobs.queue import CONFIG_FILE

TELL_SECONDS: Final = 0.25
OTHERS_SECONDS: Final = 60.0
"""How long another owner of a run may take to let go of it; on another host believed dead after 15 s."""
MAX_TEXT: Final = 4000
"""Of one line of a log."""


@dataclass(frozen=True)
class Order:
    """A job, as its worker is told."""

    number: int
    kind: str
    name: str
    folder: Path
    """Of the job."""
    recordings: Path
    accept_changes: bool
    retry: bool
    """Whether runs of a sweep that failed are tried again."""
    ray: str | None
    """The address of a cluster of Ray that does the work; None: this machine does."""


@dataclass(frozen=True)
class Outcome:
    """What came of it."""

    state: Literal["finished", "interrupted", "failed"]
    error: str = ""


class Heard(Protocol):
    """Those who are told of a run, and say when it is to stop."""

    def tell(self, kind: str, data: Any) -> None:
        """Take in what is told."""

    def stop(self) -> bool:
        """Return whether the run is to stop."""


def described(order: Order) -> Any:
    """Return the configuration or the sweep of a job, as plain values."""
    from runner.config.document import read_yaml
    from runner.config.loading import read_text

    path = order.folder / CONFIG_FILE
    return read_yaml(read_text(path), str(path)).value


def wait_for_others(runs: Iterable[Run], stop: Callable[[], bool]) -> None:
    """Wait until no process owns one of these runs: that of a server that was killed is about to stop.

    Raises:
        RunnerError: one still does after a minute.
    """
    deadline = time.monotonic() + OTHERS_SECONDS
    for run in runs:
        while run.status == "running" and not stop():
            if time.monotonic() > deadline:
                owner = run.file.owner
                raise RunnerError(
                    f"run {run.run_id} is still running (process {owner.get('pid')} on {owner.get('host')}); "
                    "resume the job when that has come to its end."
                )
            time.sleep(TELL_SECONDS)
            run = run_at(run.folder)  # noqa: PLW2901
