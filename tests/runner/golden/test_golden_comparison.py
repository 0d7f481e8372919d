"""The statistics of golden runs: an error rate that holds, and arguments that are refused."""

from __future__ import annotations

import numpy as np
import pytest

from runner.errors import ConfigError
from runner.golden.comparison import error_rates, non_inferiority


def test_equal_scores_pass_and_far_worse_ones_do_not():
    scores = [200.0, 190.0, 210.0, 205.0, 195.0, 198.0, 203.0]
    assert non_inferiority(scores, scores, margin=20).is_shown
    assert not non_inferiority(scores, [score - 40 for score in scores], margin=20).is_shown
    assert non_inferiority(scores, [score + 40 for score in scores], margin=20).is_shown


@pytest.mark.parametrize("seeds", [6, 30])
def test_scores_that_are_worse_by_the_margin_pass_as_rarely_as_stated(seeds):
    random = np.random.default_rng(seeds)
    passed = sum(
        non_inferiority(
            random.normal(0, 1, seeds).tolist(), random.normal(-1, 2, seeds).tolist(), 1.0, 0.05
        ).is_shown
        for _ in range(600)
    )
    assert passed / 600 < 0.08  # 0.05, and more than three standard errors of 600 samples


@pytest.mark.parametrize(
    ("seeds", "share"),
    [(6, 0.9), (6, 0.7), (10, 1.0), (10, 0.9), (10, 0.7), (20, 1.0), (20, 0.9), (20, 0.7)],
)
def test_a_drop_in_the_share_of_seeds_that_solve_passes_as_rarely_as_stated(seeds, share):
    random, drop = np.random.default_rng(seeds), 0.3
    passed = sum(
        non_inferiority(
            (500.0 * (random.random(seeds) < share)).tolist(),
            (500.0 * (random.random(seeds) < share - drop)).tolist(),
            margin=500 * drop,
        ).is_shown
        for _ in range(400)
    )
    assert passed / 400 < 0.09  # 0.05, and more than three standard errors of 400 samples


def test_two_values_are_compared_by_their_means():
    result = non_inferiority([1.0] * 9 + [0.0], [1.0] * 7 + [0.0] * 3, margin=0.2)
    assert (result.measure, result.golden, result.new) == ("mean", 0.9, 0.7)
    assert not result.is_shown
    assert non_inferiority([1.0] * 29 + [0.0], [1.0] * 30, margin=0.2).is_shown


def test_both_error_rates_are_estimated_from_the_golden_scores():
    scores = np.random.default_rng(1).normal(0, 1, 20).tolist()
    (strict, missed), (generous, _) = error_rates(scores, 0.3, 0.05), error_rates(scores, 3.0, 0.05)
    assert strict > 0.5
    assert generous < 0.01
    assert 0.01 < missed < 0.12
    alarms, missed = error_rates([1.0] * 9 + [0.0], 0.3, 0.05)
    assert 0.2 < alarms < 0.6  # of the exact rate at this share, 0.38
    assert missed <= 0.06


def test_scores_without_spread_are_compared_as_they_are():
    assert non_inferiority([1.0] * 6, [0.95] * 6, margin=0.1).is_shown
    assert not non_inferiority([1.0] * 6, [0.85] * 6, margin=0.1).is_shown


@pytest.mark.parametrize(
    ("golden", "new", "margin", "error_rate", "named"),
    [
        ([1.0] * 5, [1.0] * 6, 1.0, 0.05, "golden scores"),
        ([1.0] * 6, [1.0] * 5 + [float("nan")], 1.0, 0.05, "new scores"),
        ([1.0] * 6, [1.0] * 6, 0.0, 0.05, "margin"),
        ([1.0] * 6, [1.0] * 6, 1.0, 0.7, "error_rate"),
    ],
)
def test_arguments_that_cannot_be_used_are_refused(golden, new, margin, error_rate, named):
    with pytest.raises(ConfigError, match=named):
        non_inferiority(golden, new, margin, error_rate)
