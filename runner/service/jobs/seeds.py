"""A configuration, done: a run a seed, begun or gone on with."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from runner.errors import RunnerError
from runner.runs.run import Run, new_run_id, run_at
from runner.service.jobs.queue import RUNS_FILE, runs_in
from runner.service.jobs.spec import (
    MAX_TEXT,
    TELL_SECONDS,
    Heard,
    Order,
    wait_for_others,
)
from runner.util.files import write_object

if TYPE_CHECKING:
    from runner.config import ExperimentConfig
    from runner.execution.session import Progress


def do_seed(order: Order, line: Heard, config: ExperimentConfig, seed: int, number: int) -> str:
    """Do a job's run of one seed, or go on with it; return its status."""
    known = _run_of(order, seed)
    if known is not None and known.status == "finished":
        return known.status
    from runner.config.job import Job
    from runner.execution.resume import resume
    from runner.execution.session import run_job
    from runner.runs.run import create_run

    if known is not None:
        wait_for_others([known], line.stop)
        telling = Telling(line.tell, known.run_id, seed, number, len(config.seeds))
        run = resume(known, order.accept_changes, telling.report, line.stop)
    else:
        run_id = _intended(order, seed)
        run = create_run(order.recordings, config, seed, run_id=run_id)
        if run.run_id != run_id:
            _note_run(order, seed, run.run_id)
        telling = Telling(line.tell, run.run_id, seed, number, len(config.seeds))
        run = run_job(Job(config, seed), run, telling.report, line.stop)
    telling.end()
    return run.status


def _run_of(order: Order, seed: int) -> Run | None:
    """Return the run of a seed; None if there is none yet, or none any more."""
    run_id = runs_in(order.folder).get(seed)
    if run_id is None or not (order.recordings / run_id).is_dir():
        return None
    with contextlib.suppress(OSError):
        (order.recordings / run_id).rmdir()  # made, and killed before anything was in it
        return None
    with contextlib.suppress(RunnerError):
        return run_at(order.recordings / run_id)
    return None


def _intended(order: Order, seed: int) -> str:
    """Return the id of the run that is to be begun, written down before there is one."""
    run_id = new_run_id(order.recordings)
    _note_run(order, seed, run_id)
    return run_id


def _note_run(order: Order, seed: int, run_id: str) -> None:
    noted = runs_in(order.folder) | {seed: run_id}
    write_object(order.folder / RUNS_FILE, {str(key): value for key, value in noted.items()})


class Telling:
    """Passes a run's progress on, a few times a second, and each line that it logs.

    Args:
        tell: who is told.
        run_id: the run's.
        seed: the run's.
        number: how many runs of the job came before it.
        runs: how many the job has.
    """

    def __init__(
        self, tell: Callable[[str, Any], None], run_id: str, seed: int, number: int, runs: int
    ) -> None:
        self._tell = tell
        self._about = {"run_id": run_id, "seed": seed}
        self._of = {"run": number + 1, "runs": runs}
        self._last, self._logged = 0.0, 0
        self._progress: Progress | None = None
        tell("run", self._about)

    def report(self, progress: Progress) -> None:
        """Take in how far the run is."""
        self._progress = progress
        if time.monotonic() - self._last >= TELL_SECONDS:
            self._last = time.monotonic()
            self._pass_on(progress)

    def end(self) -> None:
        """Pass on what is left."""
        if self._progress is not None:
            self._pass_on(self._progress)

    def _pass_on(self, progress: Progress) -> None:
        for text in progress.log[self._logged :]:
            self._tell("log", self._about | {"text": text[:MAX_TEXT]})
        self._logged = len(progress.log)
        self._tell("progress", self._about | self._of | progress_facts(progress))


def progress_facts(progress: Progress) -> dict[str, Any]:
    """Return how far a run is, as plain values."""
    from runner.execution.session import evaluation_brief

    return {
        "episode": progress.episode,
        "episodes": progress.episodes,
        "train_steps": progress.train_steps,
        "eval_steps": progress.eval_steps,
        "bytes": progress.bytes_written,
        "last_evaluation": evaluation_brief(progress.evaluations[-1]) if progress.evaluations else None,
    }
