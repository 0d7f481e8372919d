"""Statistics over few seeds, as Agarwal et al. (2021) advise: never a bare mean, always an interval.

R. Agarwal, M. Schwarzer, P. S. Castro, A. Courville and M. G. Bellemare, "Deep reinforcement learning at
the edge of the statistical precipice", NeurIPS 2021. Intervals are percentile bootstrap intervals, as
there; the resampling is seeded, so the same values give the same interval.

`NEVER` stands for a level that is not reached: larger than anything, yet finite, so that quantiles
between it and another value are what they should be, beyond all bounds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.extras import require

Values = NDArray[np.float64]

CONFIDENCE: Final = 0.95
RESAMPLES: Final = 10_000
FEW_SEEDS: Final = 5
"""With fewer than this, an interval says little."""
FEWEST_FOR_IQM: Final = 4
"""With fewer, a quarter of the values is less than one of them."""
NEVER: Final = 1e100
_SEED: Final = 2021
_BATCH: Final = 4_000_000


@dataclass(frozen=True)
class Estimate:
    """A statistic and the interval in which it lies with 95 % confidence; nan where there is none."""

    value: float
    low: float
    high: float


def require_scipy() -> Any:
    """Return the module `scipy.stats`.

    Raises:
        MissingExtra: it is not installed.
    """
    return require("scipy.stats", extra="stats", purpose="a comparison")


def median(values: Values) -> float:
    """Return the median."""
    return bounded(float(np.median(values)))


def interquartile_mean(values: Values) -> Estimate:
    """Return the mean of the middle half of the values, and its interval; nan for fewer than four."""
    if len(values) < FEWEST_FOR_IQM:
        return Estimate(np.nan, np.nan, np.nan)
    return _estimate((values,), _iqm, 1)


def improvement(a: Values, b: Values) -> Estimate:
    """Return the probability that a run of A has a higher value than one of B; equal ones count half.

    Args:
        a: values of one configuration, one a seed.
        b: of another, at the same seeds: they are resampled together.
    """
    return _estimate((a, b), _probability, len(a))


def share_at_least(values: Values, thresholds: Values) -> tuple[Values, Values, Values]:
    """Return the share of values that are at least each threshold, and its interval: (share, low, high)."""
    above = (values >= thresholds[:, np.newaxis]).astype(np.float64)
    if len(values) < 2:
        share = above.mean(axis=1)
        return share, np.full_like(share, np.nan), np.full_like(share, np.nan)
    interval = _interval((above,), np.mean, above.size)
    return above.mean(axis=1), interval[0], interval[1]


def bounded(value: float) -> float:
    """Return a value, infinite if it comes of `NEVER`."""
    return float(np.copysign(np.inf, value)) if abs(value) > NEVER / 1e6 else value


def _iqm(values: Values, axis: int) -> Values:
    trimmed: Values = require_scipy().trim_mean(values, 0.25, axis=axis)
    return trimmed


def _probability(a: Values, b: Values, axis: int) -> Values:
    """Return the share of all pairs in which a is higher, along an axis; equal ones count half."""
    left, right = np.moveaxis(a, axis, -1), np.moveaxis(b, axis, -1)
    higher = np.sign(left[..., :, np.newaxis] - right[..., np.newaxis, :])
    return np.asarray(0.5 + 0.5 * higher.mean(axis=(-2, -1)))


def _estimate(data: tuple[Values, ...], statistic: Callable[..., Values], times: int) -> Estimate:
    value = float(statistic(*data, axis=-1))
    if len(data[0]) < 2:
        return Estimate(bounded(value), np.nan, np.nan)
    low, high = _interval(data, statistic, data[0].size * times)
    return Estimate(bounded(value), bounded(float(low)), bounded(float(high)))


def _interval(
    data: tuple[Values, ...], statistic: Callable[..., Values], values_each: int
) -> tuple[Values, Values]:
    """Return the percentile bootstrap interval of a statistic over the last axis of paired samples."""
    result = require_scipy().bootstrap(
        data,
        statistic,
        n_resamples=RESAMPLES,
        batch=max(1, _BATCH // values_each),
        vectorized=True,
        paired=len(data) > 1,
        axis=-1,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=np.random.default_rng(_SEED),
    )
    return result.confidence_interval.low, result.confidence_interval.high
