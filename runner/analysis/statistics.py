"""Statistics over few seeds, as Agarwal et al. (2021) advise: never a bare mean, always an interval.

R. Agarwal, M. Schwarzer, P. S. Castro, A. Courville and M. G. Bellemare, "Deep reinforcement learning at
the edge of the statistical precipice", NeurIPS 2021. Intervals of the IQM and of profiles are percentile
bootstrap intervals, as there; the resampling is seeded, so the same values give the same interval. The
probability of improvement has a score interval, which is right for few seeds too, and never without width.

`NEVER` stands for a level that is not reached: larger than anything, yet finite, so that quantiles
between it and another value are what they should be, beyond all bounds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import ModuleType
from typing import Final

import numpy as np

from runner.util.arrays import Floats
from runner.util.extras import require

CONFIDENCE: Final = 0.95
RESAMPLES: Final = 10_000
FEW_SEEDS: Final = 10
"""With fewer than this, bootstrap intervals are too narrow: at 4 seeds one of 95 % covers 86 %."""
FEWEST_FOR_IQM: Final = 4
"""With fewer, a quarter of the values is less than one of them."""
FEWEST_TOGETHER: Final = 6
"""With fewer, the middle half is at most three values, too few for simultaneous intervals of any use."""
NEVER: Final = 1e100
_BAND_RESAMPLES: Final = 2_000
_TAILS: Final = (0.5 - CONFIDENCE / 2, 0.5 + CONFIDENCE / 2)
_SEED: Final = 2021
_BATCH: Final = 4_000_000
"""Values that are drawn at a time, which bounds the memory."""


@dataclass(frozen=True)
class Estimate:
    """A statistic and the interval in which it lies with 95 % confidence; nan where there is none."""

    value: float = np.nan
    low: float = np.nan
    high: float = np.nan

    @property
    def excludes_zero(self) -> bool:
        """Whether the interval excludes 0; without an interval, whether the value is not 0."""
        if np.isnan(self.low):
            return self.value != 0
        return self.low > 0 or self.high < 0


def require_scipy() -> ModuleType:
    """Return the module `scipy.stats`."""
    stats: ModuleType = require("scipy.stats", extra="stats", purpose="a comparison")
    return stats


def median(values: Floats) -> float:
    """Return the median."""
    return bounded(float(np.median(values)))


def interquartile_mean(values: Floats) -> Estimate:
    """Return the mean of the middle half of the values, and its interval; nan for fewer than four."""
    n = len(values)
    if n < FEWEST_FOR_IQM:
        return Estimate()
    ends = np.quantile(_weights(n, RESAMPLES, n // 4) @ np.sort(values), _TAILS)
    return Estimate(*(bounded(float(value)) for value in (iqm(values, -1), *ends)))


def iqm_band(values: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the IQM of runs at each position of a curve, and its interval: (IQM, low, high).

    The values are float64 [runs, positions], NaN where a run has none; each position has at least one. Where
    fewer than four runs have a value the interval is their range, as nothing can be cut off. The percentile
    bootstrap is that of `interquartile_mean`, for hundreds of positions at once and without SciPy: the IQM of
    a resample is a weighted mean of the sorted values, so that all positions share the weights.
    """
    runs_at = (~np.isnan(values)).sum(axis=0)
    result = np.empty((3, values.shape[1]))
    for n in np.unique(runs_at).tolist():
        columns = np.flatnonzero(runs_at == n)
        ordered = np.sort(values[:, columns], axis=0)[:n]  # NaN is sorted last
        if n < FEWEST_FOR_IQM:
            result[:, columns] = ordered.mean(axis=0), ordered[0], ordered[-1]
            continue
        cut = n // 4
        weights = _weights(n, _BAND_RESAMPLES, cut)
        result[0, columns] = ordered[cut : n - cut].mean(axis=0)
        for start in range(0, len(columns), _BATCH // _BAND_RESAMPLES):
            batch = slice(start, start + _BATCH // _BAND_RESAMPLES)
            result[1:, columns[batch]] = np.quantile(weights @ ordered[:, batch], _TAILS, axis=0)
    return result[0], result[1], result[2]


@lru_cache(maxsize=64)
def _weights(n: int, resamples: int, cut: int = 0) -> Floats:
    """Return the weight of each of n sorted values in the mean of each resample, [resamples, n].

    The mean leaves out the `cut` lowest and the `cut` highest values of the resample.
    """
    drawn = np.random.default_rng(_SEED).integers(n, size=(resamples, n))
    kept = np.sort(drawn, axis=1)[:, cut : n - cut] if cut else drawn
    weights = np.empty((resamples, n))
    for row, numbers in zip(weights, kept, strict=True):
        row[:] = np.bincount(numbers, minlength=n)
    weights /= kept.shape[1]
    return weights


def stratified(
    strata: Sequence[Floats], statistic: Callable[[Sequence[Floats]], Floats], cells: int = 0
) -> tuple[Floats, Floats, Floats]:
    """Return a statistic of several samples and its percentile bootstrap interval: (value, low, high).

    Each sample, float64 [n, columns] with equal columns, is resampled by itself; the interval is nan if no
    sample has two values. The statistic takes one column of all samples, [n, resamples] each, and returns
    [resamples]; `cells` are the numbers that it holds for each resample, if more than there are values.
    """
    columns = strata[0].shape[1]
    value = np.array([float(statistic([sample[:, [k]] for sample in strata])[0]) for k in range(columns)])
    if all(len(sample) < 2 for sample in strata):
        return value, np.full(columns, np.nan), np.full(columns, np.nan)
    resamples = RESAMPLES if columns == 1 else _BAND_RESAMPLES
    batch = max(1, _BATCH // max(cells, sum(map(len, strata))))
    rng = np.random.default_rng(_SEED)
    drawn: list[list[Floats]] = [[] for _ in range(columns)]
    for start in range(0, resamples, batch):
        size = min(batch, resamples - start)
        rows = [rng.integers(len(sample), size=(len(sample), size)) for sample in strata]
        for k in range(columns):  # all columns share the draws
            resampled = [sample[:, k][at] for sample, at in zip(strata, rows, strict=True)]
            drawn[k].append(statistic(resampled))
    ends = np.quantile([np.concatenate(batches) for batches in drawn], _TAILS, axis=1)
    return value, ends[0], ends[1]


def bootstrap_means(values: Floats) -> list[Estimate]:
    """Return the mean of each row, and its percentile bootstrap interval; all rows are resampled alike.

    The values are of the same seeds in each row, [rows, seeds]; of one seed the interval is nan.
    """
    n = values.shape[1]
    low = np.full(len(values), np.nan)
    high = low
    if n > 1:
        low, high = np.quantile(_weights(n, RESAMPLES) @ values.T, _TAILS, axis=0)
    rows = zip(values.mean(axis=1).tolist(), low.tolist(), high.tolist(), strict=True)
    return [Estimate(*row) for row in rows]


def bootstrap_ratio(numerator: Floats, denominator: Floats) -> Estimate:
    """Return the ratio of two means over the same seeds, [seeds], and its percentile bootstrap interval."""
    n = len(numerator)
    value = float(numerator.mean() / denominator.mean()) if denominator.any() else np.nan
    if n < 2 or np.isnan(value):
        return Estimate(value)
    weights = _weights(n, RESAMPLES)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = (weights @ numerator) / (weights @ denominator)
    low, high = np.quantile(ratios[~np.isnan(ratios)], _TAILS)
    return Estimate(value, float(low), float(high))


def improvement(a: Floats, b: Floats) -> Estimate:
    """Return the probability that a run of A has a higher value than one of B; equal ones count half.

    The interval is the score interval of R. G. Newcombe, "Confidence intervals for an effect size measure
    based on the Mann-Whitney statistic, part 2", Statistics in Medicine 25 (2006), method 5. It takes the
    runs of A and B as independent; where runs of one seed are alike it is wider than it need be.
    """
    value = 0.5 + 0.5 * float(np.sign(a[:, np.newaxis] - b).mean())
    if min(len(a), len(b)) < 2:
        return Estimate(value)
    low = 1.0 - _highest_probability(1.0 - value, len(a), len(b))
    return Estimate(value, low, _highest_probability(value, len(a), len(b)))


def simultaneous(samples: Sequence[Sequence[float]]) -> list[Estimate]:
    """Return the IQM of each sample with intervals that hold all at once with 95 % confidence.

    Each is the t interval of a trimmed mean, from the winsorized variance (J. W. Tukey and D. H. McLaughlin,
    Sankhya A 25, 1963), at the level of Z. Sidak (Journal of the American Statistical Association 62, 1967)
    for this number of intervals. Bootstrap intervals are no choice here: of few seeds, the studentized ones
    are wide beyond any use, because standard errors of resamples come close to 0, and percentile ones cover
    far too seldom. A sample of equal values has an interval without width; one with a level that is never
    reached, or of fewer than `FEWEST_TOGETHER` values, has none.
    """
    level = 0.5 + 0.5 * CONFIDENCE ** (1 / max(1, len(samples)))
    estimates = []
    for sample in samples:
        values = np.array(sample, np.float64)
        value = bounded(float(iqm(values, -1))) if len(values) >= FEWEST_FOR_IQM else np.nan
        error = np.nan
        if len(values) >= FEWEST_TOGETHER and bool((abs(values) < NEVER).all()):
            freedom = len(values) - 2 * (len(values) // 4) - 1
            error = float(require_scipy().t.ppf(level, freedom)) * _standard_error(values)
        estimates.append(Estimate(value, value - error, value + error))
    return estimates


def _standard_error(values: Floats) -> float:
    """Return the standard error of the IQM, from the winsorized variance."""
    n = len(values)
    cut = n // 4
    ordered = np.sort(values)
    winsorized = np.clip(values, ordered[cut], ordered[n - cut - 1])
    left = n - 2 * cut
    return float(winsorized.std(ddof=1) * np.sqrt((n - 1) / (left * (left - 1))))


def bounded(value: float) -> float:
    """Return a value, infinite if it was computed from `NEVER`."""
    return float(np.copysign(np.inf, value)) if abs(value) > NEVER / 1e6 else value


def iqm(values: Floats, axis: int) -> Floats:
    """Return the interquartile mean along an axis."""
    trimmed: Floats = require_scipy().trim_mean(values, 0.25, axis=axis)
    return trimmed


def _highest_probability(value: float, m: int, n: int) -> float:
    """Return the highest true probability that an observed one does not contradict, of m and n values."""
    from scipy.optimize import brentq
    from scipy.special import ndtri

    quantile = float(ndtri(0.5 + CONFIDENCE / 2))
    pairs = (m + n) / 2 - 1

    def contradiction(true: float) -> float:
        share = (1 - true) / (2 - true) + true / (1 + true)
        variance = true * (1 - true) * (1 + pairs * share) / (m * n)
        return (true - value) ** 2 - quantile**2 * variance

    if value >= 1.0:
        return 1.0
    start = value if value > 0 else 1e-12  # at 0 and 1 themselves the variance is 0
    return float(brentq(contradiction, start, 1.0)) if contradiction(start) < 0 else 1.0
