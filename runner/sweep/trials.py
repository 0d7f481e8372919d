"""The trials of a sweep, batch by batch, with their recorded results.

Optuna's samplers suggest the values of the next batch, and get the results in the order of the trials. The
same results give the same suggestions. An interrupted search is therefore replayed from its runs and
continues as if undisturbed; nothing of it is stored.
"""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from runner.config import ConfigError
from runner.sweep import state
from runner.sweep.model import Parameter, Range, Sweep, count_of, points_of
from runner.sweep.task import Curve, Result, pruning_bounds, result_of, value_of
from runner.util.extras import require
from runner.util.values import Json

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution
    from optuna.trial import Trial as OptunaTrial

_MAX_DRAWS: Final = 20
"""Draws to find values that were not suggested before; all values of a small space may have been."""


def require_optuna() -> ModuleType:
    """Return the module `optuna`, which logs errors only."""
    optuna: ModuleType = require("optuna", extra="sweep", purpose="a sweep")
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    return optuna


class Search:
    """Suggests values for trials; a grid suggests the values of a configuration once."""

    def __init__(self, sweep: Sweep) -> None:
        self._optuna = require_optuna()
        self._sweep = sweep
        file = sweep.file
        self._file = file
        self._space = {path: self._distribution(parameter) for path, parameter in file.parameters.items()}
        sampler = file.search_strategy.sampler(self._optuna.samplers, file.batch, file.search_seed % 2**32)
        self._study = self._optuna.create_study(sampler=sampler, direction=file.objective.direction)
        self._asked_trials: list[OptunaTrial] = []
        self._suggested: set[str] = set()
        self._points = self._distinct_points() if file.search_strategy.is_grid else []
        self.trials = file.trials or len(self._points)
        """The number of trials of the whole search."""

    def ask(self, count: int) -> list[dict[str, object]]:
        """Return the values of the next trials, by path; fewer at the end of the search."""
        suggested = []
        for number in range(len(self._asked_trials), min(len(self._asked_trials) + count, self.trials)):
            if self._points:
                self._study.enqueue_trial(self._grid_point(self._points[number]))
            trial, values = self._draw()
            if self._file.search_strategy.skips_repeats and not self._file.repeats:
                # The same values would give the same runs, from which the search learns nothing.
                for _ in range(_MAX_DRAWS):
                    if self._identity(values) not in self._suggested:
                        break
                    self._study.tell(trial, state=self._optuna.trial.TrialState.FAIL)
                    trial, values = self._draw()
            self._asked_trials.append(trial)
            self._suggested.add(self._identity(values))
            suggested.append(values)
        return suggested

    def tell(self, number: int, value: float | None, pruned: bool, curve: Mapping[int, float]) -> None:
        """Report the result of a trial: its value and whether it was pruned; None if it failed."""
        trial = self._asked_trials[number]
        states = self._optuna.trial.TrialState
        if value is None:
            self._study.tell(trial, state=states.FAIL)
            return
        for episode, reading in curve.items():
            trial.report(reading, episode)
        if pruned:
            self._study.tell(trial, state=states.PRUNED)
        else:
            self._study.tell(trial, value)

    def _draw(self) -> tuple[OptunaTrial, dict[str, object]]:
        """Return the next trial of Optuna and its values; choices are JSON there."""
        trial = self._study.ask(self._space)
        return trial, self._values(trial.params)

    def _values(self, params: Mapping[str, Any]) -> dict[str, object]:
        """Return Optuna's values of the parameters as those of a configuration."""
        return {
            path: parameter.nearest(params[path])
            if isinstance(parameter, Range)
            else json.loads(params[path])
            for path, parameter in self._file.parameters.items()
        }

    def _identity(self, values: Mapping[str, object]) -> str:
        """Return a text that values have in common with those that differ in unused parameters alone."""
        return json.dumps(self._sweep.applicable(values), sort_keys=True)

    def _distinct_points(self) -> Sequence[int]:
        """Return the points of the grid, the first of those that differ in unused parameters alone."""
        points = range(points_of(self._file.parameters.values()))
        if "algorithm" not in self._file.parameters:
            return points  # all parameters are used
        firsts: dict[str, int] = {}
        for number in points:
            firsts.setdefault(self._identity(self._values(self._grid_point(number))), number)
        return list(firsts.values())

    def _grid_point(self, number: int) -> dict[str, object]:
        """Return a point of the grid, the last parameter changing fastest, as values for Optuna."""
        parameters = self._file.parameters
        at = np.unravel_index(number, [count_of(parameter) for parameter in parameters.values()])
        return {
            path: parameter.at(int(place)) if isinstance(parameter, Range) else json.dumps(parameter[place])
            for place, (path, parameter) in zip(at, parameters.items(), strict=True)
        }

    def _distribution(self, parameter: Parameter) -> BaseDistribution:
        kinds = self._optuna.distributions
        if not isinstance(parameter, Range):
            return kinds.CategoricalDistribution([json.dumps(choice) for choice in parameter])
        if parameter.is_integer:
            step = int(parameter.step or 1)
            return kinds.IntDistribution(
                int(parameter.low), int(parameter.last), log=parameter.log, step=step
            )
        return kinds.FloatDistribution(
            float(parameter.low), float(parameter.last), log=parameter.log, step=parameter.step
        )


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
        adaptive = sweep.file.search_strategy.is_adaptive or sweep.file.pruning is not None
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
