"""The intervals of comparisons cover what they say they cover."""

from __future__ import annotations

import math

import numpy as np
import pytest

from runner.analysis.compare import statistics


def test_the_interval_of_the_iqm_has_its_nominal_coverage():
    rng = np.random.default_rng(1)
    inside = [
        estimate.low <= 0 <= estimate.high
        for estimate in (statistics.interquartile_mean(rng.normal(0, 1, 20)) for _ in range(40))
    ]
    assert sum(inside) >= 33  # 95 % of 40 is 38; a percentile interval of 20 values is a little short


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
