"""Random draws: the published generator, uniform, and no stream has anything to do with another."""

from __future__ import annotations

import itertools

import numba
import numpy as np
import pytest

from runner.learning import draws
from runner.learning.learner import Learner
from tests.runner.learning import plain_draws
from tests.runner.learning.harness import SMALL, experiment, train

PUBLISHED = [
    6457827717110365317,
    3203168211198807973,
    9817491932198370423,
    4593380528125082431,
    16408922859458223821,
]
"""The first outputs of SplitMix64 seeded with 1234567, as its reference implementation prints them."""
STREAMS = range(9)


@numba.njit
def drawn(seed, stream, episode, n):
    """Return the first n draws of a stream in an episode: their bits, and the numbers derived from them."""
    bits = np.empty(n, np.uint64)
    floats = np.empty((n, 2))
    small = np.empty(n, np.int64)
    state = draws.key(seed, stream, episode)
    for index in range(n):
        bits[index] = draws.draw(state, index)
        floats[index] = draws.uniform(bits[index]), draws.coin(bits[index])
        small[index] = draws.below(bits[index], 36)
    return bits, floats, small


@numba.njit
def outputs(state, n):
    """Return n outputs of the generator in a state."""
    bits = np.empty(n, np.uint64)
    for index in range(n):
        bits[index] = draws.draw(state, index)
    return bits


def chi_squared(counts: np.ndarray) -> float:
    """Return by how many standard deviations the counts' chi squared is off, were they uniform."""
    expected, freedom = counts.sum() / counts.size, counts.size - 1
    return float((((counts - expected) ** 2 / expected).sum() - freedom) / np.sqrt(2 * freedom))


def test_the_generator_is_the_published_one():
    assert outputs(np.uint64(1234567), 5).tolist() == PUBLISHED
    assert [plain_draws.splitmix64(1234567, index) for index in range(5)] == PUBLISHED


@pytest.mark.parametrize("seed", [0, 7, 2**63 + 1, 2**64 - 1])
def test_keys_and_numbers_are_the_twins(seed):
    for stream, episode in [(0, 0), (1, 0), (7, 1), (3, 10**12)]:
        bits, floats, small = drawn(np.uint64(seed), stream, episode, 50)
        expected = [plain_draws.draw(seed, stream, episode, index) for index in range(50)]
        assert bits.tolist() == expected
        assert floats.tolist() == [[plain_draws.uniform(each), plain_draws.coin(each)] for each in expected]
        assert small.tolist() == [plain_draws.below(each, 36) for each in expected]


def test_the_streams_have_the_specified_numbers():
    names = ("START", "EXPLORATION", "OUTCOME", "UPDATE")
    names += ("EVALUATION_START", "EVALUATION_OUTCOME", "EVALUATION_ACTION", "INITIAL_Q", "POLICY")
    assert [getattr(draws, name) for name in names] == [getattr(plain_draws, name) for name in names]


@pytest.mark.parametrize("stream", STREAMS)
def test_draws_are_uniform_along_an_episode_and_across_episodes(stream):
    along = drawn(np.uint64(3), stream, 5, 40_000)
    across = [drawn(np.uint64(3), stream, episode, 1) for episode in range(4_000)]
    for bits, floats, small in (along, tuple(np.concatenate(part) for part in zip(*across, strict=True))):
        assert floats.min() >= 0
        assert floats.max() < 1
        assert abs(chi_squared(np.histogram(floats[:, 0], 64, (0, 1))[0])) < 5
        assert abs(chi_squared(np.bincount(small, minlength=36))) < 5
        for bit in range(64):
            ones = int((bits >> np.uint64(bit) & np.uint64(1)).sum())
            assert abs(ones - len(bits) / 2) < 5 * np.sqrt(len(bits)) / 2, f"bit {bit}"


def test_whether_to_explore_is_independent_of_the_action_drawn():
    _, floats, small = drawn(np.uint64(1), draws.EXPLORATION, 0, 40_000)
    table = np.histogram2d(floats[:, 1], small, bins=(8, 36), range=((0, 1), (-0.5, 35.5)))[0]
    assert abs(chi_squared(table)) < 5


def test_no_seed_stream_or_episode_repeats_another():
    of = itertools.product(range(5), STREAMS, range(60))
    every = [drawn(np.uint64(seed), stream, episode, 20)[0] for seed, stream, episode in of]
    assert len(np.unique(every)) == np.size(every)


@pytest.mark.parametrize("other", [(0, 2, 0), (0, 1, 1), (1, 1, 0), (1, 2, 1)])
def test_neighbouring_streams_episodes_and_seeds_are_uncorrelated(other):
    n = 40_000
    first = drawn(np.uint64(0), 1, 0, n)[1][:, 0]
    second = drawn(np.uint64(other[0]), other[1], other[2], n)[1][:, 0]
    for lag in range(3):
        correlation = np.corrcoef(first[lag:], second[: n - lag])[0, 1]
        assert abs(correlation) < 5 / np.sqrt(n)


def test_runs_of_one_seed_share_starts_and_exploration_whatever_they_learn():
    played = []
    for values in ({"step_size": 0.1}, {"step_size": 0.9, "discount": 0.2, "initial_q": 5.0}):
        config, mdp = experiment(SMALL, {"epsilon": 0.5}, values)
        played.append(train(Learner(config, mdp, 8), 50, 10**6, 1000).steps)
    starts, coins = [], []
    for steps in played:
        starts.append(steps["state"][steps["t"] == 0].tolist())
        keys = zip(steps["episode"].tolist(), steps["t"].tolist(), strict=True)
        coins.append(dict(zip(keys, steps["explored"].tolist(), strict=True)))
    assert starts[0] == starts[1]
    assert len(set(starts[0])) > 5
    shared = coins[0].keys() & coins[1].keys()
    assert len(shared) > 500
    assert [coins[0][at] for at in shared] == [coins[1][at] for at in shared]
    assert played[0]["action"].tolist() != played[1]["action"].tolist()
