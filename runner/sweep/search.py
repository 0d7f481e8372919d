"""The values to try next: Optuna's samplers, queried in batches; results are reported in trial order.

The same results give the same suggestions. An interrupted search is therefore replayed from its runs and
continues as if undisturbed; nothing of it is stored.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from runner.sweep.model import Sweep
from runner.sweep.parameters import Parameter, Range, count_of, points_of
from runner.util.extras import require

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution
    from optuna.trial import Trial

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
        sampler = file.searched.sampler(self._optuna.samplers, file.batch, file.search_seed % 2**32)
        self._study = self._optuna.create_study(sampler=sampler, direction=file.objective.direction)
        self._asked_trials: list[Trial] = []
        self._suggested: set[str] = set()
        self._points = self._distinct_points() if file.searched.is_grid else []
        self.trials = file.trials or len(self._points)
        """The number of trials of the whole search."""

    def ask(self, count: int) -> list[dict[str, object]]:
        """Return the values of the next trials, by path; fewer at the end of the search."""
        suggested = []
        for number in range(len(self._asked_trials), min(len(self._asked_trials) + count, self.trials)):
            if self._points:
                self._study.enqueue_trial(self._grid_point(self._points[number]))
            trial, values = self._draw()
            if self._file.searched.skips_repeats and not self._file.repeats:
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

    def _draw(self) -> tuple[Trial, dict[str, object]]:
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
