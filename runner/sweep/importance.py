"""Which parameters mattered: shares of variance of parameters and of their pairs (functional ANOVA).

F. Hutter, H. Hoos and K. Leyton-Brown, "An efficient approach for assessing hyperparameter importance",
ICML 2014: random forests predict the objective at every point of a grid, and the variance over the grid is
divided into that of each parameter alone (main effects) and of each pair beyond that (interactions). Shares
are not normalized: the rest is due to three and more parameters.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, SupportsFloat, cast

import numpy as np
from numpy.typing import NDArray

from runner.sweep.model import Range
from runner.util.extras import require

FORESTS: Final = 30
TREES: Final = 32
RESAMPLES: Final = 200
MAX_POINTS: Final = 20_000
"""Points of the grid that forests predict; the grid is coarser for many parameters."""
MAX_LEVELS: Final = 12
MIN_TRIALS: Final = 4


@dataclass(frozen=True)
class Effect:
    """The effect of one parameter, or of two together beyond what each does alone, on the objective."""

    parameters: tuple[str, ...]
    share: float
    """Share of the variance; from forests, the median over them."""
    low: float
    high: float
    """The interval of 95 % of the forests, each of resampled trials; of a whole grid, of resampled seeds."""


def effects_of(
    parameters: Mapping[str, Range | list[object]],
    trials: Sequence[Mapping[str, object]],
    values: Sequence[float],
) -> list[Effect]:
    """Return main effects and interactions, the largest first; empty for too few trials.

    The parameters are the values tried, by path; the values are the objective of each trial, finite.
    """
    ensemble = require("sklearn.ensemble", extra="sweep", purpose="the importance of a sweep's parameters")
    names = list(parameters)
    if len(trials) < MIN_TRIALS or len(set(values)) < 2 or 2 ** len(names) > MAX_POINTS:
        return []
    levels = {name: _levels(parameter, len(names)) for name, parameter in parameters.items()}
    grid = list(itertools.product(*levels.values()))
    coded = _coded(parameters, [dict(zip(names, point, strict=True)) for point in grid])
    tried, objective = _coded(parameters, trials), np.asarray(values, np.float64)
    shape = tuple(len(own) for own in levels.values())
    rng = np.random.default_rng(0)
    all_shares: list[dict[tuple[int, ...], float]] = []
    for forest in range(FORESTS):
        drawn = rng.integers(0, len(trials), len(trials))
        trees = ensemble.RandomForestRegressor(TREES, random_state=forest)
        predicted = trees.fit(tried[drawn], objective[drawn]).predict(coded)
        shares = shares_of_variance(predicted.reshape(shape))
        if shares:
            all_shares.append(shares)
    return _effects(names, all_shares)


def effects_of_grid(
    parameters: Mapping[str, Range | list[object]], seed_values: Sequence[Sequence[float]]
) -> list[Effect]:
    """Return main effects and interactions of a grid whose points were all completed, without a forest.

    `seed_values` is the objective at each seed, finite, of each point; the last parameter changes fastest.
    The interval is over resampled seeds.
    """
    shape = tuple(each.steps + 1 if isinstance(each, Range) else len(each) for each in parameters.values())
    exact = shares_of_variance(np.array([np.median(own) for own in seed_values]).reshape(shape))
    rng = np.random.default_rng(0)
    resampled = []
    for _ in range(RESAMPLES):
        medians = [np.median(rng.choice(own, len(own))) for own in map(np.asarray, seed_values)]
        resampled.append(shares_of_variance(np.array(medians).reshape(shape)))
    effects = _effects(list(parameters), [shares for shares in resampled if shares]) if exact else []
    names = list(parameters)
    shares = {tuple(names[axis] for axis in axes): share for axes, share in exact.items()}
    effects = [replace(effect, share=shares[effect.parameters]) for effect in effects]
    return sorted(effects, key=lambda effect: -effect.share)


def shares_of_variance(values: NDArray[np.float64]) -> dict[tuple[int, ...], float]:
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


def _effects(names: Sequence[str], all_shares: Sequence[Mapping[tuple[int, ...], float]]) -> list[Effect]:
    """Return the median and the interval of each share, the largest first."""
    if not all_shares:
        return []
    effects = []
    for axes in all_shares[0]:
        shares = [each[axes] for each in all_shares]
        low, middle, high = np.quantile(shares, [0.025, 0.5, 0.975]).tolist()
        effects.append(Effect(tuple(names[axis] for axis in axes), middle, low, high))
    return sorted(effects, key=lambda effect: -effect.share)


def _levels(parameter: Range | list[object], parameters: int) -> list[object]:
    """Return the values of a parameter in the grid, evenly spaced; all of them if they are few."""
    limit = max(2, min(MAX_LEVELS, int(MAX_POINTS ** (1 / parameters) + 1e-9)))
    if not isinstance(parameter, Range):
        chosen = np.unique(np.linspace(0, len(parameter) - 1, min(limit, len(parameter))).round().astype(int))
        return [parameter[i] for i in chosen]
    low, high = float(parameter.low), float(parameter.last)
    if parameter.log:
        return list(np.geomspace(low, high, limit).tolist())
    count = min(limit, parameter.steps + 1) if parameter.step is not None or parameter.is_integer else limit
    return list(np.linspace(low, high, count).tolist())


def _coded(
    parameters: Mapping[str, Range | list[object]], points: Sequence[Mapping[str, object]]
) -> NDArray[np.float64]:
    """Return points as columns of numbers: one for a range, or one for each choice."""
    columns = []
    for name, parameter in parameters.items():
        if isinstance(parameter, Range):
            numbers = [float(cast("SupportsFloat", point[name])) for point in points]
            columns.append([math.log(number) for number in numbers] if parameter.log else numbers)
        else:
            texts = [json.dumps(point[name], sort_keys=True) for point in points]
            choices = dict.fromkeys(json.dumps(each, sort_keys=True) for each in parameter)
            columns += [[float(text == choice) for text in texts] for choice in choices]
    return np.array(columns, np.float64).T
