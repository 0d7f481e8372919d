"""The trials of a sweep, batch by batch: from what is recorded, or by having workers run them."""

from __future__ import annotations

import math
import statistics
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from runner.config import ConfigError
from runner.config.job import identity_of
from runner.runs.run import Run
from runner.sweep import state
from runner.sweep.local import Workers
from runner.sweep.model import Sweep
from runner.sweep.names import tag_of
from runner.sweep.readings import Curve, value_of
from runner.sweep.search import Search, bounds
from runner.sweep.state import is_over
from runner.sweep.task import Result, Task, result_of

INTERRUPTED: Final = "interrupted"
WAIT_SECONDS: Final = 0.2
State = Literal["finished", "pruned", "unfinished", "failed", "excluded"]


@dataclass
class Trial:
    """Values of the parameters, and what came of them."""

    number: int
    values: dict[str, Any]
    config: dict[str, Any]
    """The configuration as plain values; empty if the values do not go together."""
    identities: dict[int, str]
    """Seed to the identity of its job; empty as well."""
    error: str = ""
    results: dict[int, Result] = field(default_factory=dict)
    """By seed, as far as they are known."""
    seed_values: dict[int, float] = field(default_factory=dict)
    """By seed, what its run is worth; a run that was given up is worth what it had then."""

    @property
    def state(self) -> State:
        """Whether all its runs are over; pruned if half of them were given up; excluded: there are none."""
        states = [result.status for result in self.results.values()]
        if self.error:
            return "excluded"
        if "failed" in states:
            return "failed"
        if len(states) < len(self.identities) or "interrupted" in states:
            return "unfinished"
        return "pruned" if 2 * states.count("pruned") >= len(states) else "finished"

    @property
    def value(self) -> float | None:
        """The median over its seeds; None if it has none."""
        known = [value for value in self.seed_values.values() if not math.isnan(value)]
        return statistics.median(known) if known and self.state in ("finished", "pruned") else None

    @property
    def curve(self) -> Curve:
        """The median over its seeds by episode, as far as all of them came."""
        curves = [result.curve for result in self.results.values() if result.curve]
        shared = set.intersection(*(set(curve) for curve in curves)) if curves else set()
        return {episode: float(np.median([curve[episode] for curve in curves])) for episode in sorted(shared)}

    def take(self, seed: int, result: Result, sweep: Sweep) -> None:
        """Take in what came of a seed."""
        self.results[seed] = result
        if result.status in ("finished", "pruned"):
            self.seed_values[seed] = value_of(sweep.objective, result.curve)

    @property
    def errors(self) -> list[str]:
        """Why it failed."""
        said = [f"seed {seed}: {result.error}" for seed, result in self.results.items() if result.error]
        return [self.error] if self.error else said


@dataclass
class SweepStatus:
    """How far a sweep is, as its `report` is told."""

    runs: int
    """Runs to do, with those that are done."""
    trials: int
    done: int = 0
    running: int = 0
    pruned: int = 0
    failed: int = 0
    excluded: int = 0
    """Trials whose values do not go together; they have no runs."""
    begun: int = 0
    """Runs that this process had begun, or gone on with."""
    resumed: int = 0
    """Of them, those that were there already."""
    bytes: int = 0
    seconds: float = 0.0
    best: Trial | None = None
    stopped: str = ""
    """Why it stopped before its end; empty if it did not."""


Report = Callable[[SweepStatus], None]
Room = Callable[[SweepStatus, Task], str]


class Trials:
    """A sweep's trials; each batch follows from what came of those before.

    Args:
        sweep: whose.
    """

    def __init__(self, sweep: Sweep) -> None:
        self.sweep = sweep
        self.search = Search(sweep.file)
        self.told: list[Trial] = []
        adaptive = sweep.file.strategy in ("tpe", "genetic") or sweep.file.pruning is not None
        self._size = sweep.file.batch if adaptive else self.search.trials

    def ask(self) -> list[Trial]:
        """Return the next batch; empty at the end."""
        start = len(self.told)
        return [
            self._trial(start + i, values)
            for i, values in enumerate(self.search.ask(self._size) if start < self.search.trials else ())
        ]

    def tell(self, batch: list[Trial]) -> None:
        """Take in a batch whose runs are all over, or failed."""
        for trial in batch:
            self.search.tell(trial.number, trial.value, trial.state == "pruned", trial.curve)
            self.told.append(trial)

    def bounds(self) -> Curve:
        """Return what the runs of the next batch must reach, by episode."""
        plan = self.sweep.file.pruning
        curves = [trial.curve for trial in self.told if trial.state == "finished"]
        if plan is None or len(curves) < plan.trials:
            return {}
        found = bounds(self.sweep.objective, curves, plan.percentile)
        return {episode: bound for episode, bound in found.items() if episode >= plan.after}

    def best(self) -> Trial | None:
        """Return the finished trial with the best value, the first of several."""
        return best_of(self.told, self.sweep)

    def _trial(self, number: int, values: dict[str, Any]) -> Trial:
        try:
            config = self.sweep.config(values).to_mapping()
        except ConfigError as error:
            return Trial(number, values, {}, {}, str(error))
        return Trial(number, values, config, {seed: identity_of(config, seed) for seed in self.sweep.seeds})


def best_of(trials: list[Trial], sweep: Sweep) -> Trial | None:
    """Return the finished trial with the best value, the first of several; None if none is finished."""
    finished = [(trial.value, trial) for trial in trials if trial.state == "finished"]
    valued = [(value, trial) for value, trial in finished if value is not None]
    sign = sweep.objective.sign
    return max(valued, key=lambda pair: (sign * pair[0], -pair[1].number))[1] if valued else None


def recorded(trials: Trials, recordings: Path) -> Iterator[Trial]:
    """Yield the trials of a sweep as far as its runs are recorded, each as it stands.

    Raises:
        RunnerError: a run cannot be read.
    """
    record = _Record(trials.sweep, recordings)
    while batch := trials.ask():
        for trial in batch:
            for seed, identity in trial.identities.items():
                result = record.result_of(identity)
                if result is not None:
                    trial.take(seed, result, trials.sweep)
            yield trial
        if any(trial.state == "unfinished" for trial in batch):
            return
        trials.tell(batch)


def run_sweep(
    sweep: Sweep,
    recordings: Path,
    workers: Workers,
    *,
    stop: Callable[[], bool] = lambda: False,
    report: Report = lambda _: None,
    room: Room = lambda *_: "",
    accept_changes: bool = False,
) -> tuple[Trials, SweepStatus]:
    """Run what is left of a sweep; return its trials, and how it stands.

    Args:
        sweep: written down by `state.begin`.
        recordings: the folder of its runs.
        workers: those who do the runs.
        stop: asked several times a second whether to stop.
        report: called with the status several times a second.
        room: says why a task may not be begun; empty if it may.
        accept_changes: go on with runs that were begun by other code.

    Raises:
        RunnerError: a run that is there cannot be read.
    """
    trials = Trials(sweep)
    status = SweepStatus(trials.search.trials * len(sweep.seeds), trials.search.trials)
    watch = Watch(stop, report, room)
    record = _Record(sweep, recordings)
    while batch := trials.ask():
        work = _Batch(sweep, batch, recordings, status, record)
        work.prepare(trials.bounds(), accept_changes)
        work.run(workers, watch)
        if status.stopped:
            break
        trials.tell(batch)
        status.best = trials.best()
    report(status)
    return trials, status


@dataclass(frozen=True)
class Watch:
    """What a sweep asks and tells while it goes on, as `run_sweep` has it."""

    stop: Callable[[], bool]
    report: Report
    room: Room


class _Batch:
    """The runs of one batch of trials: each job once, also if two trials want it."""

    def __init__(
        self,
        sweep: Sweep,
        batch: list[Trial],
        recordings: Path,
        status: SweepStatus,
        record: _Record,
    ) -> None:
        self._sweep, self._batch, self._recordings = sweep, batch, recordings
        self._status, self._record = status, record
        self._retried: set[str] = set()
        self._waiting: deque[Task] = deque()

    def prepare(self, bounds: Curve, accept_changes: bool) -> None:
        """Take in the runs that are over, and find out which are left to do: those that were begun first."""
        tasks: dict[str, Task] = {}
        for trial in self._batch:
            if trial.error:
                self._status.excluded += 1
                self._status.runs -= len(self._sweep.seeds)
            for seed, identity in trial.identities.items():
                result = self._record.result_of(identity)
                if result is None:
                    task = self._task(trial, seed, bounds)
                    tasks.setdefault(identity, replace(task, accept_changes=accept_changes))
                else:
                    trial.take(seed, result, self._sweep)
                    self._count(result)
        self._waiting.extend(sorted(tasks.values(), key=lambda task: not task.run_id))

    def run(self, workers: Workers, watch: Watch) -> None:
        """Have every run done; or say in the status why not, when those under way have come to rest."""
        began, before = time.monotonic(), self._status.seconds
        status = self._status
        while status.running or (self._waiting and not status.stopped):
            if not status.stopped and watch.stop():
                status.stopped = INTERRUPTED
                workers.stop()
            self._give(workers, watch)
            status.seconds = before + time.monotonic() - began
            watch.report(status)
            for task, result in workers.collect(WAIT_SECONDS):
                status.running -= 1
                self._take(task, result)

    def _give(self, workers: Workers, watch: Watch) -> None:
        """Give tasks to those who are idle, while there is room for their runs."""
        status = self._status
        while self._waiting and workers.idle and not status.stopped:
            task = self._waiting[0]
            status.stopped = watch.room(status, task)
            if not status.stopped:
                workers.give(self._waiting.popleft())
                status.running += 1
                if task.identity not in self._retried:
                    status.begun += 1
                    status.resumed += bool(task.run_id)

    def _take(self, task: Task, result: Result | None) -> None:
        """Take in what came of a task; that of a worker that died is tried once more."""
        if result is None and task.identity not in self._retried:
            self._retried.add(task.identity)
            there = state.runs_of(self._sweep.name, self._recordings)
            self._waiting.appendleft(replace(task, run_id=_id_in(there, task.identity)))
            return
        result = result or Result("failed", task.run_id, error="its worker died twice")
        if result.status == "interrupted":
            self._status.stopped = self._status.stopped or INTERRUPTED
        self._record.note(task.identity, result)
        for trial in self._batch:
            for seed, identity in trial.identities.items():
                if identity == task.identity:
                    trial.take(seed, result, self._sweep)
                    self._count(result)

    def _count(self, result: Result) -> None:
        status = self._status
        status.bytes += self._record.weigh(result)
        status.done += result.status in ("finished", "pruned")
        status.pruned += result.status == "pruned"
        status.failed += result.status == "failed"

    def _task(self, trial: Trial, seed: int, bounds: Curve) -> Task:
        identity = trial.identities[seed]
        return Task(
            identity=identity,
            seed=seed,
            config=trial.config,
            name=self._sweep.name,
            tags=(tag_of(self._sweep.name), f"trial={trial.number}"),
            recordings=str(self._recordings),
            objective=self._sweep.objective,
            bounds=bounds,
            run_id=_id_in(self._record.runs, identity),
        )


class _Record:
    """What is recorded of a sweep, and what came since.

    A job that failed stays so: what was tried next follows from it. `state.forget_failures` lets it be tried
    again.
    """

    def __init__(self, sweep: Sweep, recordings: Path) -> None:
        self._sweep, self._recordings = sweep, recordings
        self.runs = state.runs_of(sweep.name, recordings)
        self._failures = state.failures_of(sweep.name, recordings)
        self._weighed: set[str] = set()
        self._results = {
            identity: Result("failed", _id_in(self.runs, identity), error=error)
            for identity, error in self._failures.items()
        }

    def result_of(self, identity: str) -> Result | None:
        """Return what came of a job; None if its run is not over."""
        run = self.runs.get(identity)
        if identity not in self._results and run is not None and is_over(run):
            self._results[identity] = result_of(run, self._sweep.objective)
        return self._results.get(identity)

    def weigh(self, result: Result) -> int:
        """Return the bytes of a result's run, if they were not asked for before."""
        if result.run_id in self._weighed:
            return 0
        self._weighed.add(result.run_id)
        return result.bytes

    def note(self, identity: str, result: Result) -> None:
        """Keep what came of a job."""
        if result.status != "interrupted":
            self._results[identity] = result
        if result.status == "failed":
            self._failures[identity] = result.error
            state.note_failures(self._sweep.name, self._recordings, self._failures)


def _id_in(runs: Mapping[str, Run], identity: str) -> str:
    return runs[identity].run_id if identity in runs else ""
