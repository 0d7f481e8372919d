"""The trials of a sweep, batch by batch, and their recorded results."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from runner.config import ConfigError
from runner.sweep import state
from runner.sweep.model import Sweep
from runner.sweep.objective import Curve, pruning_bounds, value_of
from runner.sweep.search import Search
from runner.sweep.task import Result, result_of
from runner.util.values import Json

State = Literal["finished", "pruned", "unfinished", "failed", "excluded"]


@dataclass
class Trial:
    """Values of the parameters that its algorithm uses, and the results of their runs."""

    number: int
    values: Json
    config: Json
    """The configuration as plain values; empty if the values contradict each other."""
    identities: dict[int, str]
    """By seed, the identity of its job; empty if the values contradict each other."""
    error: str = ""
    results: dict[int, Result] = field(default_factory=dict)
    """By seed; seeds whose runs are not over are missing."""
    seed_values: dict[int, float] = field(default_factory=dict)
    """By seed, the value of its run; of a pruned run the value that it had then."""

    @property
    def state(self) -> State:
        """Whether all runs are over; pruned if half of them were pruned; excluded if there are none."""
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
        values = [value for value in self.seed_values.values() if not math.isnan(value)]
        return statistics.median(values) if values and self.state in ("finished", "pruned") else None

    @property
    def curve(self) -> Curve:
        """The median over its seeds by episode, at the episodes that all of them have."""
        curves = [result.curve for result in self.results.values() if result.curve]
        shared = set.intersection(*(set(curve) for curve in curves)) if curves else set()
        return {episode: float(np.median([curve[episode] for curve in curves])) for episode in sorted(shared)}

    def add(self, seed: int, result: Result, sweep: Sweep) -> None:
        """Add the result of a seed."""
        self.results[seed] = result
        if result.status in ("finished", "pruned"):
            self.seed_values[seed] = value_of(sweep.objective, result.curve)

    @property
    def errors(self) -> list[str]:
        """The reasons why it failed or is excluded."""
        failed = [f"seed {seed}: {result.error}" for seed, result in self.results.items() if result.error]
        return [self.error] if self.error else failed


class Trials:
    """A sweep's trials; each batch depends on the results of those before."""

    def __init__(self, sweep: Sweep) -> None:
        self.sweep = sweep
        self.search = Search(sweep)
        self.done: list[Trial] = []
        """The trials of the batches that are over."""
        adaptive = sweep.file.searched.is_adaptive or sweep.file.pruning is not None
        self._batch_size = sweep.file.batch if adaptive else self.search.trials

    def ask(self) -> list[Trial]:
        """Return the next batch; empty at the end."""
        batch = []
        for number, suggested in enumerate(self.search.ask(self._batch_size), start=len(self.done)):
            values = self.sweep.applicable(suggested)
            try:
                config = self.sweep.config(values).to_mapping()
            except ConfigError as error:
                batch.append(Trial(number, values, {}, {}, str(error)))
            else:
                identities = {seed: state.job_identity(config, seed) for seed in self.sweep.seeds}
                batch.append(Trial(number, values, config, identities))
        return batch

    def tell(self, batch: Iterable[Trial]) -> None:
        """Report a batch whose runs are all over or failed."""
        for trial in batch:
            self.search.tell(trial.number, trial.value, trial.state == "pruned", trial.curve)
            self.done.append(trial)

    def bounds(self) -> Curve:
        """Return the bounds that the runs of the next batch must reach, by episode."""
        pruning = self.sweep.file.pruning
        curves = [trial.curve for trial in self.done if trial.state == "finished"]
        if pruning is None or len(curves) < pruning.trials:
            return {}
        bounds = pruning_bounds(self.sweep.objective, curves, pruning.percentile)
        return {episode: bound for episode, bound in bounds.items() if episode >= pruning.after}


def best_of(trials: Iterable[Trial], sweep: Sweep) -> Trial | None:
    """Return the finished trial with the best value, the first of several; None if none is finished."""
    finished = ((trial.value, trial) for trial in trials if trial.state == "finished")
    valued = [(sweep.objective.sign * value, trial) for value, trial in finished if value is not None]
    return max(valued, key=lambda pair: (pair[0], -pair[1].number), default=(0, None))[1]


class JobResults:
    """The results of a sweep's jobs, recorded before or added since.

    A failed job stays failed, because later suggestions depend on it, until `state.forget_failures`.
    """

    def __init__(self, sweep: Sweep, recordings: Path) -> None:
        self._sweep = sweep
        self._recordings = recordings
        self._runs = state.runs_of(sweep.name, recordings)
        self._failures = state.failures_of(sweep.name, recordings)
        self._results = {
            identity: Result("failed", self.run_id(identity), error=error)
            for identity, error in self._failures.items()
        }

    def run_id(self, identity: str) -> str:
        """Return the id of the run of a job; empty if there was none."""
        return self._runs[identity].run_id if identity in self._runs else ""

    def get(self, identity: str) -> Result | None:
        """Return the result of a job; None if its run is not over."""
        run = self._runs.get(identity)
        if identity not in self._results and run is not None and state.is_over(run):
            self._results[identity] = result_of(run, self._sweep.objective)
        return self._results.get(identity)

    def add(self, identity: str, result: Result) -> None:
        """Add the result of a job."""
        if result.status != "interrupted":
            self._results[identity] = result
        if result.status == "failed":
            self._failures[identity] = result.error
            state.write_failures(self._sweep.name, self._recordings, self._failures)


def recorded_trials(trials: Trials, recordings: Path) -> Iterator[Trial]:
    """Yield the trials of a sweep that have been suggested so far, with the results that are recorded."""
    results = JobResults(trials.sweep, recordings)
    while batch := trials.ask():
        for trial in batch:
            for seed, identity in trial.identities.items():
                if (result := results.get(identity)) is not None:
                    trial.add(seed, result, trials.sweep)
            yield trial
        if any(trial.state == "unfinished" for trial in batch):
            return
        trials.tell(batch)
