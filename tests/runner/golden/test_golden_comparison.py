"""The statistics of golden runs: an error rate that holds, and arguments that are refused."""

from __future__ import annotations

import numpy as np
import pytest

from runner.errors import ConfigError
from runner.golden.comparison import non_inferiority


def test_equal_scores_pass_and_far_worse_ones_do_not():
    scores = [200.0, 190.0, 210.0, 205.0, 195.0, 198.0, 203.0]
    assert non_inferiority(scores, scores, margin=20).is_shown
    assert not non_inferiority(scores, [score - 40 for score in scores], margin=20).is_shown
    assert non_inferiority(scores, [score + 40 for score in scores], margin=20).is_shown


@pytest.mark.parametrize("seeds", [6, 10, 30])
def test_scores_that_are_worse_by_the_margin_pass_as_rarely_as_stated(seeds):
    random = np.random.default_rng(seeds)
    passed = sum(
        non_inferiority(
            random.normal(0, 1, seeds).tolist(), random.normal(-1, 2, seeds).tolist(), 1.0, 0.05
        ).is_shown
        for _ in range(2000)
    )
    assert passed / 2000 < 0.07


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
