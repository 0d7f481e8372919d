"""Which values are tried next: Optuna's samplers, asked in batches and told in the order of the trials.

The same told values give the same suggestions. So a search that was cut off is done again from what its
runs gave, and goes on as if it never had been; nothing of it needs to be kept on disk.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from runner.sweep.model import Objective, Range, SweepFile
from runner.util.extras import require


def require_optuna() -> Any:
    """Return the module `optuna`, which says no more than it must.

    Raises:
        MissingExtra: it is not installed.
    """
    optuna = require("optuna", extra="sweep", purpose="a sweep")
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    return optuna


_TRIES: Final = 20
"""How often values are drawn again that were suggested before; of a small space all may have been."""


class Search:
    """Suggests values for trials.

    Args:
        file: the sweep's.

    Raises:
        MissingExtra: Optuna is not installed.
    """

    def __init__(self, file: SweepFile) -> None:
        optuna = require_optuna()
        self._file = file
        self._space = {path: distribution(parameter) for path, parameter in file.parameters.items()}
        self._study = optuna.create_study(sampler=_sampler(file), direction=file.objective.direction)
        self._asked: dict[int, Any] = {}
        self._suggested: set[str] = set()
        self.trials = file.trials or file.grid_points
        """How many there are to be."""

    def ask(self, count: int) -> list[dict[str, Any]]:
        """Return the values of the next trials, by path; fewer where the search ends."""
        start = len(self._asked)
        suggested = []
        for number in range(start, min(start + count, self.trials)):
            if self._file.strategy == "grid":
                self._study.enqueue_trial(self._grid_point(number))
            trial = self._ask_once()
            self._asked[number] = trial
            values = _plain(self._file.parameters, trial.params)
            self._suggested.add(json.dumps(values, sort_keys=True))
            suggested.append(values)
        return suggested

    def _ask_once(self) -> Any:
        """Return a trial of Optuna's; of TPE one whose values are new, if a few tries find any.

        A trial whose values were suggested before teaches nothing: the same values give the same runs.
        """
        from optuna.trial import TrialState

        trial = self._study.ask(self._space)
        if self._file.strategy != "tpe" or self._file.repeats:
            return trial
        for _ in range(_TRIES):
            values = _plain(self._file.parameters, trial.params)
            if json.dumps(values, sort_keys=True) not in self._suggested:
                break
            self._study.tell(trial, state=TrialState.FAIL)
            trial = self._study.ask(self._space)
        return trial

    def tell(self, number: int, value: float | None, pruned: bool, curve: Mapping[int, float]) -> None:
        """Say what came of a trial: its value, that it was given up, or (None) that it failed."""
        from optuna.trial import TrialState

        trial = self._asked[number]
        if value is None:
            self._study.tell(trial, state=TrialState.FAIL)
            return
        for episode, reading in curve.items():
            trial.report(reading, episode)
        if pruned:
            self._study.tell(trial, state=TrialState.PRUNED)
        else:
            self._study.tell(trial, value)

    def _grid_point(self, number: int) -> dict[str, Any]:
        """Return a point of the grid, the last parameter changing fastest, as Optuna has it."""
        point: dict[str, Any] = {}
        rest = number
        for path, parameter in reversed(self._file.parameters.items()):
            if isinstance(parameter, Range):
                rest, at = divmod(rest, parameter.steps + 1)
                point[path] = parameter.at(at)
            else:
                rest, at = divmod(rest, len(parameter))
                point[path] = json.dumps(parameter[at])
        return point


def distribution(parameter: Range | list[Any]) -> Any:
    """Return Optuna's distribution of a parameter; choices are JSON, as they may be of any kind."""
    from optuna import distributions

    if not isinstance(parameter, Range):
        return distributions.CategoricalDistribution([json.dumps(choice) for choice in parameter])
    if parameter.whole:
        step = int(parameter.step or 1)
        return distributions.IntDistribution(
            int(parameter.low), int(parameter.last), log=parameter.log, step=step
        )
    return distributions.FloatDistribution(
        float(parameter.low), float(parameter.last), log=parameter.log, step=parameter.step
    )


def bounds(objective: Objective, curves: list[dict[int, float]], percentile: float) -> dict[int, float]:
    """Return by episode what the best reading so far must not be worse than.

    Args:
        objective: says what is better.
        curves: of the trials that are finished: reading by episode.
        percentile: the share of them, in percent, that a run may be worse than.
    """
    bests: dict[int, list[float]] = {}
    for curve in curves:
        episodes = sorted(curve)
        best = list(itertools.accumulate((objective.sign * curve[e] for e in episodes), max))
        for episode, reading in zip(episodes, best, strict=True):
            bests.setdefault(episode, []).append(reading)
    return {
        episode: objective.sign * float(np.percentile(readings, 100 - percentile))
        for episode, readings in sorted(bests.items())
    }


def _plain(parameters: Mapping[str, Range | list[Any]], suggested: Mapping[str, Any]) -> dict[str, Any]:
    return {
        path: suggested[path] if isinstance(parameter, Range) else json.loads(suggested[path])
        for path, parameter in parameters.items()
    }


def _sampler(file: SweepFile) -> Any:
    from optuna import samplers

    seed = file.search_seed % 2**32
    match file.strategy:
        case "tpe":
            return samplers.TPESampler(seed=seed, n_startup_trials=2 * file.batch)
        case "genetic":
            return samplers.NSGAIISampler(population_size=max(2, file.batch), seed=seed)
        case _:
            return samplers.RandomSampler(seed=seed)
