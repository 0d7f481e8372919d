"""Shapley values, interactions and minimal sets against independent computations."""

from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np
import pytest

from runner.debugging.game import minimal_set, shapley_interactions, shapley_values


def over_all_orders(values, count):
    """Return the Shapley values of one column by their definition: the mean effect over all orders."""
    shares = [Fraction(0)] * count
    orders = list(itertools.permutations(range(count)))
    for order in orders:
        mixture = 0
        for i in order:
            shares[i] += Fraction(int(values[mixture | 1 << i])) - Fraction(int(values[mixture]))
            mixture |= 1 << i
    return [float(share / len(orders)) for share in shares]


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_shapley_values_are_the_mean_over_all_orders(count):
    values = np.random.default_rng(count).integers(-50, 50, size=(2**count, 3)).astype(float)
    found = shapley_values(values)
    for column in range(3):
        np.testing.assert_allclose(found[:, column], over_all_orders(values[:, column], count), atol=1e-12)
    np.testing.assert_allclose(found.sum(axis=0), values[-1] - values[0], atol=1e-12)


def test_interactions_are_those_of_a_polynomial():
    """A product of settings S divides its coefficient among pairs in S: 1 / (|S| - 1) for each of them."""
    count, rng = 4, np.random.default_rng(7)
    coefficients = {
        players: float(rng.integers(-9, 9))
        for size in range(count + 1)
        for players in itertools.combinations(range(count), size)
    }
    values = np.zeros((2**count, 1))
    for mixture in range(2**count):
        chosen = {i for i in range(count) if mixture >> i & 1}
        values[mixture] = sum(value for players, value in coefficients.items() if chosen.issuperset(players))
    for (i, j), found in shapley_interactions(values).items():
        expected = sum(
            value / (len(players) - 1) for players, value in coefficients.items() if {i, j} <= set(players)
        )
        assert found[0] == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("seed", range(20))
def test_a_minimal_set_holds_and_none_of_it_can_be_left_out(seed):
    rng = np.random.default_rng(seed)
    items = list(range(12))
    causes = [set(rng.choice(12, size=rng.integers(1, 6), replace=False).tolist()) for _ in range(2)]
    tested = []

    def holds(chosen):
        tested.append(tuple(chosen))
        return any(cause.issubset(chosen) for cause in causes)

    found = minimal_set(items, holds)
    assert set(found) in causes
    for item in found:
        assert not any(cause.issubset(set(found) - {item}) for cause in causes)
    assert len(tested) <= 12**2 + 3 * 12
