"""The intervals of comparisons cover what they say they cover."""

from __future__ import annotations

import math

import numpy as np
import pytest

from runner.analysis import statistics


def test_the_interval_of_the_iqm_has_its_nominal_coverage():
    rng = np.random.default_rng(1)
    inside = [
        estimate.low <= 0 <= estimate.high
        for estimate in (statistics.interquartile_mean(rng.normal(0, 1, 20)) for _ in range(40))
    ]
    assert sum(inside) >= 33  # 95 % of 40 is 38; a percentile interval of 20 values is a little short


def test_the_band_of_a_curve_is_the_interval_of_a_single_value():
    values = np.random.default_rng(4).normal(0, 1, (12, 3))
    middle, low, high = statistics.iqm_band(values)
    for k in range(3):
        alone = statistics.interquartile_mean(values[:, k])
        assert middle[k] == pytest.approx(alone.value)
        assert (low[k], high[k]) == pytest.approx((alone.low, alone.high), abs=0.06)


def test_a_band_has_the_runs_that_come_as_far_and_their_range_below_four():
    values = np.array([[1.0, 1, 1], [2, 2, np.nan], [3, 3, 3], [100, np.nan, np.nan], [4, np.nan, np.nan]])
    middle, low, high = statistics.iqm_band(values)
    assert middle.tolist() == [3, 2, 2]  # of five runs, the lowest and the highest are cut off
    assert (low[1:].tolist(), high[1:].tolist()) == ([1, 1], [3, 3])
    same = statistics.iqm_band(np.full((6, 2), 7.0))
    assert np.allclose(same, 7)


@pytest.mark.parametrize(("seeds", "shift"), [(5, 0.0), (5, 1.5), (10, 0.8)])
def test_the_interval_of_the_probability_of_improvement_has_its_nominal_coverage(seeds, shift):
    rng = np.random.default_rng(2)
    true = 0.5 * (1 + math.erf(shift / 2))  # of normal values, P(X + shift > Y)
    estimates = [
        statistics.improvement(rng.normal(shift, 1, seeds), rng.normal(0, 1, seeds)) for _ in range(400)
    ]
    covered = np.mean([estimate.low <= true <= estimate.high for estimate in estimates])
    assert 0.91 <= covered <= 0.99


def test_a_probability_of_improvement_of_one_is_not_certain():
    always = statistics.improvement(np.ones(20), np.zeros(20))
    assert (always.value, always.high) == (1.0, 1.0)
    # Newcombe's equation, (1 - p)^2 = z^2 p (1 - p) (1 + 19 ((1 - p) / (2 - p) + p / (1 + p))) / 400
    assert always.low == pytest.approx(0.898669, abs=1e-6)
    never = statistics.improvement(np.zeros(20), np.ones(20))
    assert (never.value, never.low, never.high) == (0.0, 0.0, pytest.approx(1 - always.low))
    few = statistics.improvement(np.ones(5), np.zeros(5))
    assert few.low < always.low


@pytest.mark.parametrize("seeds", [6, 8, 20])
def test_simultaneous_intervals_hold_all_at_once_as_often_as_they_say(seeds):
    rng = np.random.default_rng(3)
    together = []
    for _ in range(300):
        shared = rng.normal(0, 0.5, seeds)
        samples = [shared + rng.normal(0, 1, seeds) for _ in range(6)]  # six differences, none of them true
        estimates = statistics.simultaneous(samples)
        together.append(all(each.low <= 0 <= each.high for each in estimates))
        assert max(each.high - each.low for each in estimates) < 25  # standard deviations
    assert 0.9 <= np.mean(together) <= 0.98
