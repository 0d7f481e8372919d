"""Running a sweep: batches of trials become tasks for workers, and their results the next batch."""

from __future__ import annotations

import shutil
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from runner.recording.labels import Labels
from runner.runs.listing import run_in
from runner.runs.run import new_run
from runner.runs.trust_marks import environment_of_job, mark
from runner.sweep import tag_of
from runner.sweep.local import Workers
from runner.sweep.model import Sweep
from runner.sweep.objective import Curve
from runner.sweep.task import Result, Task
from runner.sweep.trials import JobResults, Trial, Trials, best_of

INTERRUPTED: Final = "interrupted"
_WAIT_SECONDS: Final = 0.2


@dataclass
class SweepStatus:
    """The progress of a sweep."""

    runs: int
    """All runs of the sweep, done or not."""
    trials: int
    done: int = 0
    running: int = 0
    pruned: int = 0
    failed: int = 0
    excluded: int = 0
    """Trials without runs, because their values contradict each other."""
    started: int = 0
    """Runs that this process started or resumed."""
    resumed: int = 0
    """Those of them that existed before."""
    bytes: int = 0
    seconds: float = 0.0
    best: Trial | None = None
    stopped: str = ""
    """The reason why it stopped before its end; empty if it did not."""


Limit = Callable[[SweepStatus, Task], str]
"""Returns why a task may not be started; empty if it may."""


def run_sweep(
    sweep: Sweep,
    recordings: Path,
    workers: Workers[Task, Result],
    *,
    stop: Callable[[], bool] = lambda: False,
    report: Callable[[SweepStatus], None] = lambda _: None,
    limit: Limit = lambda *_: "",
    accept_changes: bool = False,
) -> tuple[Trials, SweepStatus]:
    """Run the rest of a sweep that `state.begin` wrote to disk; return its trials and its status.

    `stop` and `report` are called several times a second, and `stop` returns whether to; `limit` returns why
    a task may not be started, empty if it may. Runs that other code started are resumed only if the changes
    are accepted.
    """
    runner = _Runner(sweep, recordings, workers, stop, report, limit, accept_changes)
    trials, status = runner.trials, runner.status
    while batch := trials.ask():
        runner.prepare(batch, trials.bounds())
        runner.run(batch)
        if status.stopped:
            break
        trials.tell(batch)
    report(status)
    return trials, status


@dataclass(eq=False)
class _Runner:
    """The runs of a sweep's batches: each job once, also if several trials need it. See `run_sweep`."""

    sweep: Sweep
    recordings: Path
    workers: Workers[Task, Result]
    stop: Callable[[], bool]
    report: Callable[[SweepStatus], None]
    limit: Limit
    accept_changes: bool

    def __post_init__(self) -> None:
        self.trials = Trials(self.sweep)
        count = self.trials.search.trials
        self.status = SweepStatus(count * len(self.sweep.seeds), count)
        self._results = JobResults(self.sweep, self.recordings)
        self._counted: set[str] = set()
        """Ids of the runs whose bytes are counted."""
        self._retried: set[str] = set()
        self._waiting: deque[Task] = deque()

    def prepare(self, batch: list[Trial], bounds: Curve) -> None:
        """Add the results of runs that are over, and queue the others: those that can be resumed first."""
        tasks: dict[str, Task] = {}
        for trial in batch:
            if trial.error:
                self.status.excluded += 1
                self.status.runs -= len(self.sweep.seeds)
            for seed, identity in trial.identities.items():
                result = self._results.get(identity)
                if result is not None:
                    self._add(trial, seed, result)
                elif identity not in tasks:
                    tasks[identity] = Task(
                        identity=identity,
                        seed=seed,
                        config=trial.config,
                        trial=trial.number,
                        recordings=str(self.recordings),
                        objective=self.sweep.objective,
                        bounds=bounds,
                        run_id=self._results.run_id(identity),
                        accept_changes=self.accept_changes,
                    )
        self._waiting = deque(sorted(tasks.values(), key=lambda task: not task.run_id))

    def run(self, batch: list[Trial]) -> None:
        """Finish every queued run, or, when stopped, only those in progress."""
        began = time.monotonic()
        before = self.status.seconds
        status = self.status
        while status.running or (self._waiting and not status.stopped):
            if not status.stopped and self.stop():
                status.stopped = INTERRUPTED
                self.workers.stop()
            self._start_tasks()
            status.seconds = before + time.monotonic() - began
            self.report(status)
            for task, received in self.workers.collect(_WAIT_SECONDS):
                status.running -= 1
                if received is None and task.identity not in self._retried:  # its worker died
                    self._retried.add(task.identity)
                    self._waiting.appendleft(task)
                    continue
                result = received or self._died_twice(task)
                if result.status == "interrupted":
                    status.stopped = status.stopped or INTERRUPTED
                self._results.add(task.identity, result)
                for trial in batch:
                    for seed, identity in trial.identities.items():
                        if identity == task.identity:
                            self._add(trial, seed, result)

    def _start_tasks(self) -> None:
        status = self.status
        while self._waiting and self.workers.idle and not status.stopped:
            task = self._waiting[0]
            status.stopped = self.limit(status, task)
            if not status.stopped:
                self._waiting.popleft()
                self.workers.submit(replace(task, run_id=task.run_id or self._created(task)))
                status.running += 1
                if task.identity not in self._retried:
                    status.started += 1
                    status.resumed += bool(task.run_id)

    def _created(self, task: Task) -> str:
        """Create the run of a task, interrupted before its first step; return its id.

        A worker could be killed between creating a run and telling the sweep, and its run would be lost.
        """
        labels = Labels(tags=tuple(sorted((tag_of(self.sweep.name), f"trial={task.trial}"))))
        facts = task.config, task.seed, self.sweep.name
        run = new_run(self.recordings, *facts, labels=labels, status="interrupted")
        mark(run.folder, environment_of_job(task.config))
        return run.run_id

    def _died_twice(self, task: Task) -> Result:
        """Return the result of a task whose worker died twice; remove its run if it has no recording."""
        folder = self.recordings / task.run_id
        run = run_in(folder)
        if run is not None and run.recording.exists():
            return Result("failed", task.run_id, error="its worker died twice")
        shutil.rmtree(folder, ignore_errors=True)
        return Result("failed", error="its worker died twice")

    def _add(self, trial: Trial, seed: int, result: Result) -> None:
        """Add a result to a trial and to the status."""
        trial.add(seed, result, self.sweep)
        status = self.status
        if result.run_id not in self._counted:
            self._counted.add(result.run_id)
            status.bytes += result.bytes
        status.done += result.status in ("finished", "pruned")
        status.pruned += result.status == "pruned"
        status.failed += result.status == "failed"
        status.best = best_of(filter(None, (status.best, trial)), self.sweep)
