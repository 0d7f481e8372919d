"""Which parameters mattered: shares of the objective's variance (functional ANOVA).

F. Hutter, H. Hoos and K. Leyton-Brown, "An efficient approach for assessing hyperparameter importance",
ICML 2014. A completed grid is decomposed exactly, into the share of each parameter alone and of each pair
beyond that; otherwise Optuna's random forests estimate the share of each parameter alone. Shares are not
normalized: the rest is due to several parameters together.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, cast

import numpy as np

from runner.sweep.parameters import Parameter, Range, count_of
from runner.sweep.search import require_optuna
from runner.util.arrays import Floats
from runner.util.extras import require

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution

FORESTS: Final = 30
TREES: Final = 5
MAX_DEPTH: Final = 5
"""Of the trees: without it 500 trials take a minute, and no share changes by more than 0.02."""
RESAMPLES: Final = 200
MIN_TRIALS: Final = 4


@dataclass(frozen=True)
class Effect:
    """The effect on the objective of one parameter, or, in a grid, of two beyond what each does alone."""

    parameters: tuple[str, ...]
    share: float
    """Share of the variance; from forests, the median over them."""
    low: float
    high: float
    """The interval of 95 % of the forests, each of resampled trials; of a whole grid, of resampled seeds."""


def effects_of(
    parameters: Mapping[str, Parameter], trials: Sequence[Mapping[str, object]], values: Sequence[float]
) -> list[Effect]:
    """Return the main effects, found by forests of resampled trials, the largest first.

    Empty for too few trials, or if no value differs.
    The parameters are the values tried, by path; the values are the objective of each trial, finite.
    """
    optuna = require_optuna()
    require("sklearn.ensemble", extra="sweep", purpose="the importance of a sweep's parameters")
    if len(trials) < MIN_TRIALS:
        return []
    names = list(parameters)
    space = {name: _distribution(parameter) for name, parameter in parameters.items()}
    tried = [
        optuna.trial.create_trial(
            params={name: _coded(parameters[name], trial[name]) for name in names},
            distributions=space,
            value=value,
        )
        for trial, value in zip(trials, values, strict=True)
    ]
    rng = np.random.default_rng(0)
    all_shares: list[dict[tuple[str, ...], float]] = []
    for forest in range(FORESTS):
        resampled = rng.integers(0, len(trials), len(trials)).tolist()
        if len({values[trial] for trial in resampled}) > 1:
            study = optuna.create_study()
            study.add_trials([tried[trial] for trial in resampled])
            evaluator = optuna.importance.FanovaImportanceEvaluator(
                n_trees=TREES, max_depth=MAX_DEPTH, seed=forest
            )
            shares = evaluator.evaluate(study, names)
            all_shares.append({(name,): share for name, share in shares.items()})
    return _effects(all_shares)


def effects_of_grid(
    parameters: Mapping[str, Parameter], seed_values: Sequence[Sequence[float]]
) -> list[Effect]:
    """Return main effects and interactions of a grid whose points were all completed, without a forest.

    `seed_values` is the objective at each seed, finite, of each point; the last parameter changes fastest.
    The interval is over resampled seeds.
    """
    shape = tuple(map(count_of, parameters.values()))
    names = list(parameters)
    rng = np.random.default_rng(0)

    def shares_of(points: Iterable[Floats]) -> dict[tuple[str, ...], float]:
        shares = shares_of_variance(np.array(list(map(np.median, points))).reshape(shape))
        return {tuple(names[axis] for axis in axes): share for axes, share in shares.items()}

    points = list(map(np.asarray, seed_values))
    resampled = [shares_of(rng.choice(own, len(own)) for own in points) for _ in range(RESAMPLES)]
    exact = shares_of(points)
    return _effects([shares for shares in resampled if shares], exact) if exact else []


def shares_of_variance(values: Floats) -> dict[tuple[int, ...], float]:
    """Return the share of the variance over a full grid of each axis, (i,), and of each pair, (i, j).

    The interaction of two axes is the variance of their joint means beyond the two main effects. Empty if
    the values do not vary.
    """
    total = float(values.var())
    axes = range(values.ndim)
    if total <= 1e-12 * max(1.0, float(np.abs(values).max()) ** 2):
        return {}

    def explained(*kept: int) -> float:
        others = tuple(axis for axis in axes if axis not in kept)
        return float(values.mean(axis=others).var()) / total

    shares: dict[tuple[int, ...], float] = {(i,): explained(i) for i in axes}
    for i, j in itertools.combinations(axes, 2):
        shares[i, j] = max(0.0, explained(i, j) - shares[i,] - shares[j,])
    return shares


def _effects(
    resampled: Sequence[Mapping[tuple[str, ...], float]], exact: Mapping[tuple[str, ...], float] | None = None
) -> list[Effect]:
    """Return each exact share, or the median of those resampled, with its interval, the largest first."""
    effects = []
    if resampled:
        for parameters in resampled[0]:
            shares = [each[parameters] for each in resampled]
            low, middle, high = np.quantile(shares, [0.025, 0.5, 0.975]).tolist()
            effects.append(Effect(parameters, exact[parameters] if exact else middle, low, high))
    return sorted(effects, key=lambda effect: -effect.share)


def _distribution(parameter: Parameter) -> BaseDistribution:
    """Return where the coded values of a parameter lie, in the logarithm for one that is drawn from it."""
    from optuna.distributions import CategoricalDistribution, FloatDistribution

    if isinstance(parameter, Range):
        return FloatDistribution(_coded(parameter, parameter.low), _coded(parameter, parameter.last))
    return CategoricalDistribution(list(dict.fromkeys(_coded(parameter, choice) for choice in parameter)))


def _coded(parameter: Parameter, value: object) -> float | str:
    """Return a value for Optuna's fANOVA, which takes no logarithms itself: a number, or a choice as JSON."""
    if isinstance(parameter, Range):
        number = float(cast("float", value))
        return math.log(number) if parameter.log else number
    return json.dumps(value, sort_keys=True)
