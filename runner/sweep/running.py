"""Running a sweep from its start, or from where it stopped, to its end: on disk, locked, within its limits.

Batches of trials become tasks for workers, and their results the next batch. The runs and the disk that a
sweep will take are measured by a run of one episode.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from runner.config import ConfigError, ExperimentConfig, from_mapping
from runner.config.model import Job
from runner.environments.loading import load_mdp
from runner.environments.mdp import Mdp
from runner.errors import StorageError
from runner.execution.estimate import estimate, free_bytes
from runner.execution.session import run_job
from runner.recording.labels import Labels
from runner.recording.reader import open_recording
from runner.runs.run import create_run, new_run, run_in
from runner.runs.trust_marks import environment_of_job, mark
from runner.sweep import state, tag_of
from runner.sweep.model import Sweep, SweepLimits
from runner.sweep.task import Curve, Result, Task, curve_of
from runner.sweep.trials import JobResults, Search, Trial, Trials, best_of
from runner.sweep.workers import Workers, worker_pool
from runner.util.humanize import size

INTERRUPTED: Final = "interrupted"
_WAIT_SECONDS: Final = 0.2
_BYTES_PER_EPISODE: Final = 40
_BYTES_PER_EVALUATION: Final = 1500
_COMPRESSED_SHARE: Final = 0.75
"""Size of a compressed table as a share of its bytes."""


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

# --- batches of runs --------------------------------------------------------------------------------------


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


# --- what a sweep takes ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Plan:
    """What a sweep will take."""

    trials: int
    runs: int
    bytes_per_run: int
    """An estimate: recordings grow with what is learned."""
    excluded: int = 0
    """Points of a grid without runs, because their values contradict each other."""

    @property
    def bytes(self) -> int:
        """The estimate for all runs together."""
        return self.runs * self.bytes_per_run


def plan_of(sweep: Sweep) -> Plan:
    """Return what a sweep will take, measured by its first trial with one episode."""
    search = Search(sweep)
    is_grid = sweep.file.search_strategy.is_grid
    configs: list[ExperimentConfig] = []
    errors: list[ConfigError] = []
    for values in search.ask(search.trials if is_grid else sweep.file.batch):
        try:
            configs.append(sweep.config(values))
        except ConfigError as error:
            errors.append(error)
    if not configs:
        raise errors[0]
    config = configs[0]
    mdp = load_mdp(config.env.id, config.env.kwargs, config.rewards)
    bytes_per_run = _measured_bytes(config, mdp, sweep.objective.metric) + _estimated_bytes(config, mdp)
    excluded = len(errors) if is_grid else 0
    trials = search.trials - excluded
    return Plan(trials, trials * len(sweep.seeds), bytes_per_run, excluded)


def _measured_bytes(config: ExperimentConfig, mdp: Mdp, metric: str) -> int:
    """Return the bytes of a run of one episode, which must have readings of the metric."""
    values = config.to_mapping() | {"initial_q": 0.0}  # there are no other runs in a temporary folder
    if config.evaluation is not None:
        values["evaluation"] |= {"every": 1, "trials": 1}
    short = from_mapping(values, ["episodes=1"])
    with tempfile.TemporaryDirectory() as folder:
        run = create_run(Path(folder), short, short.seeds[0])
        run = run_job(Job(short, short.seeds[0]), run, mdp=mdp)
        with open_recording(run.recording) as recording:
            curve_of(recording, metric)
            return recording.file.size


def _estimated_bytes(config: ExperimentConfig, mdp: Mdp) -> int:
    """Return an estimate of the bytes that one episode does not show."""
    counts = (mdp.joint_actions,) if config.tables == "joint" else mdp.action_counts
    table = mdp.states * sum(counts) * 8
    estimated = estimate(config, mdp.step_limit)
    trials = estimated.evaluations * (config.evaluation.trials if config.evaluation else 0)
    return round(
        estimated.snapshots * table * _COMPRESSED_SHARE
        + (config.episodes + trials) * _BYTES_PER_EPISODE
        + estimated.evaluations * _BYTES_PER_EVALUATION
        + (estimated.typical_bytes if config.recording.steps == "all" else 0)
    )


def require_disk(plan: Plan, done: int, recordings: Path) -> None:
    """Refuse a sweep that does not fit on the disk; `done` of its runs exist already.

    Raises:
        StorageError: there is too little space.
    """
    needed = max(0, plan.runs - done) * plan.bytes_per_run
    free = free_bytes(recordings)
    if needed > free:
        raise StorageError(
            f"{recordings}: {plan.runs - done:,} runs need about {size(needed)}, and {size(free)} are free: "
            "free some, choose another --recordings, or try fewer values."
        )


def limit_of(limits: SweepLimits, plan: Plan, recordings: Path, before: int) -> Limit:
    """Return the function that gives the reason why a task may not be started, if there is one.

    `before` is the number of runs of the sweep that existed before.
    """

    def reason(status: SweepStatus, task: Task) -> str:
        runs = before + status.started - status.resumed
        in_progress = (status.running + 1) * plan.bytes_per_run
        if limits.runs is not None and not task.run_id and runs >= limits.runs:
            return f"limits.runs: {limits.runs:,} runs were started"
        if limits.seconds is not None and status.seconds >= limits.seconds:
            return f"limits.seconds: {limits.seconds:g} s are over"
        if limits.disk is not None and status.bytes + in_progress > limits.disk:
            return (
                f"limits.disk: {size(status.bytes)} of {size(limits.disk)} are used, and a run needs about "
                f"{size(plan.bytes_per_run)}"
            )
        if free_bytes(recordings) < in_progress:
            return f"the disk of {recordings} is full: a run needs about {size(plan.bytes_per_run)}"
        return ""

    return reason


# --- the whole sweep ------------------------------------------------------------------------------------


def run_whole_sweep(
    sweep: Sweep,
    recordings: Path,
    workers: int | None,
    ray: str | None,
    *,
    resume: bool,
    retry_failed: bool,
    accept_changes: bool,
    stop: Callable[[], bool],
    report: Callable[[SweepStatus], None],
    planned: Callable[[Plan, int], None] = lambda *_: None,
) -> tuple[Trials, SweepStatus]:
    """Run what is left of a sweep; return its trials and its status.

    `workers` and `ray` are as for `worker_pool`, `stop` and `report` as for `run_sweep`. `planned` is called
    before the first run, with what the sweep takes and the number of its runs that there are already.

    Raises:
        SweepBusy: another process runs the sweep.
        RunnerError: it exists, and is not to be resumed or differs; or the disk would not hold its runs.
    """
    with state.locked(sweep.name, recordings):
        state.require_startable(sweep, recordings, resume, accept_changes)
        plan = plan_of(sweep)
        before = len(state.runs_of(sweep.name, recordings))
        require_disk(plan, before, recordings)
        planned(plan, before)
        pool: Workers[Task, Result]
        with worker_pool(workers, ray, plan.runs) as pool:
            state.begin(sweep, recordings, resume, accept_changes)
            if retry_failed:
                state.forget_failures(sweep.name, recordings)
            return run_sweep(
                sweep,
                recordings,
                pool,
                stop=stop,
                report=report,
                limit=limit_of(sweep.file.limits, plan, recordings, before),
                accept_changes=accept_changes,
            )
