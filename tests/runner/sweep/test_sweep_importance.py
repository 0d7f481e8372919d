"""Importance: shares of variance that can be computed by hand, and their estimates from trials."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from runner.sweep.model import Range
from runner.sweep.results import effects_of, effects_of_grid, shares_of_variance


def test_the_variance_of_a_sum_is_that_of_its_terms():
    a, b = np.array([0.0, 1.0, 2.0]), np.array([0.0, 3.0])
    shares = shares_of_variance(a[:, None] + b[None, :])
    total = a.var() + b.var()
    assert shares[0,] == pytest.approx(a.var() / total)
    assert shares[1,] == pytest.approx(b.var() / total)
    assert shares[0, 1] == pytest.approx(0.0)


def test_an_exclusive_or_has_no_main_effects():
    shares = shares_of_variance(np.array([[0.0, 1.0], [1.0, 0.0]]))
    assert shares == {(0,): 0.0, (1,): 0.0, (0, 1): 1.0}
    thrice = np.array([[[i ^ j ^ k for k in (0, 1)] for j in (0, 1)] for i in (0, 1)], float)
    assert sum(shares_of_variance(thrice).values()) == 0.0  # it is all due to three


def test_values_that_do_not_vary_have_no_shares():
    assert shares_of_variance(np.full((2, 3), 7.0)) == {}


def test_main_effects_are_found_from_trials():
    parameters = {"x": Range(low=0.0, high=1.0), "on": [True, False], "idle": ["a", "b", "c"]}
    rng = np.random.default_rng(0)
    trials = [
        {"x": float(rng.random()), "on": bool(rng.integers(2)), "idle": "abc"[rng.integers(3)]}
        for _ in range(150)
    ]
    values = [trial["x"] * (1.0 if trial["on"] else -1.0) for trial in trials]
    effects = {effect.parameters: effect for effect in effects_of(parameters, trials, values)}
    assert set(effects) == {("x",), ("on",), ("idle",)}
    # over the square: variance 1/3, of which E[x]^2 = 1/4 is due to `on`, the rest to both together
    assert effects["on",].share == pytest.approx(0.75, abs=0.06)
    assert max(effects["x",].share, effects["idle",].share) < 0.03
    for effect in effects.values():
        assert 0 <= effect.low <= effect.share <= effect.high <= 1
    assert effects_of(parameters, trials, values) == list(effects.values())


def test_a_range_drawn_in_the_logarithm_is_weighed_in_it():
    parameters = {"rate": Range(low=1e-6, high=1.0, log=True), "idle": Range(low=1, high=9)}
    rng = np.random.default_rng(1)
    trials = [{"rate": 10.0 ** -rng.uniform(0, 6), "idle": int(rng.integers(1, 10))} for _ in range(80)]
    values = [
        float(trial["rate"] > 1e-3) for trial in trials
    ]  # half of the magnitudes, nearly all of the line
    effect, *_ = effects_of(parameters, trials, values)
    assert effect.parameters == ("rate",)
    assert effect.share > 0.95


def test_too_few_or_equal_trials_have_no_effects():
    grid = [{"x": a, "y": b} for a, b in itertools.product((0, 1), repeat=2)]
    parameters = {"x": [0, 1], "y": [0, 1]}
    assert effects_of(parameters, grid[:3], [1.0, 2.0, 3.0]) == []
    assert effects_of(parameters, grid, [1.0] * 4) == []


def test_the_variance_of_a_whole_grid_is_decomposed_exactly():
    seed_values = [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [1.0, 0.9, 1.0], [0.0, 0.1, 0.0]]
    effects = {
        effect.parameters: effect for effect in effects_of_grid({"x": [0, 1], "y": [0, 1]}, seed_values)
    }
    assert effects["x", "y"].share == pytest.approx(1.0)
    assert effects["x",].share == effects["y",].share == 0.0
    assert effects["x", "y"].low <= 1.0
