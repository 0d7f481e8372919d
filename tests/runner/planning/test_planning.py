"""Planning against what anybody would write: episodes played out, equations solved."""

from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runner.environments import load_mdp
from runner.errors import EnvironmentNotUsable
from runner.mdp import Mdp
from runner.planning import best_response, evaluate_policy, greedy_policy, optimal_values

DISCOUNT = 0.9


@st.composite
def processes(draw, outcomes=1):
    """Small processes of two agents with two actions each, whole rewards, and a success event."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    states = draw(st.integers(1, 8))
    shape = (states, 4, outcomes)
    chances = rng.integers(1, 5, shape).astype(float)
    start = rng.integers(0, 3, states).astype(float)
    start[rng.integers(states)] += 1
    return Mdp(
        env_id="Small-v0",
        kwargs={},
        next_state=rng.integers(0, states, shape).astype(np.int32),
        probability=chances / chances.sum(axis=-1, keepdims=True),
        rewards=rng.integers(-9, 10, (*shape, 2)).astype(float),
        terminated=rng.random(shape) < 0.15,
        events=(rng.random(shape) < 0.2).astype(np.uint32),
        start=start / start.sum(),
        step_limit=draw(st.integers(1, 30)),
        agents=("one", "two"),
        action_counts=(2, 2),
        event_names=("success",),
        success_events=("success",),
        penalty_below=-5.0,
    )


def a_policy(mdp, data):
    return np.array(
        data.draw(st.lists(st.integers(0, 3), min_size=mdp.states, max_size=mdp.states)), np.int32
    )


def played(mdp, policy, state):
    """Return success, time-out, length, penalties and both returns of the one episode from a state."""
    succeeded, penalties, returns, t, over = False, 0, np.zeros(2), 0, False
    while not over:
        at = state, policy[state], 0
        returns += mdp.rewards[at]
        succeeded |= bool(mdp.events[at])
        penalties += mdp.rewards[at].sum() < mdp.penalty_below
        state, t = mdp.next_state[at], t + 1
        over = mdp.terminated[at] or t == mdp.step_limit
    return np.array([succeeded, not mdp.terminated[at], t, penalties, *returns], float)


def expected(mdp, policy, state, t=0, succeeded=False):
    """Return the same for chances, by following every outcome: exact, and slow."""
    total = [Fraction(0)] * 6
    for k in range(mdp.probability.shape[-1]):
        at = state, policy[state], k
        p = Fraction(float(mdp.probability[at]))
        done, over = bool(mdp.terminated[at]), t + 1 == mdp.step_limit
        now = succeeded or bool(mdp.events[at])
        gains = [
            0,
            0,
            1,
            int(mdp.rewards[at].sum() < mdp.penalty_below),
            *mdp.rewards[at].astype(int).tolist(),
        ]
        if done or over:
            rest = [int(now), int(not done), 0, 0, 0, 0]
        else:
            rest = expected(mdp, policy, mdp.next_state[at], t + 1, now)
        total = [a + p * (b + c) for a, b, c in zip(total, gains, rest, strict=True)]
    return total


def said(outcome):
    return np.array(
        [
            outcome.finish_percent / 100,
            outcome.timeout_percent / 100,
            *(outcome.mean_length, outcome.mean_penalties, *outcome.mean_returns),
        ]
    )


def values_of(mdp, policy):
    """Return the discounted values [S, 2] of a policy by solving its linear equations."""
    rows = np.arange(mdp.states)
    goes_on = DISCOUNT * mdp.probability[rows, policy] * ~mdp.terminated[rows, policy]
    matrix = np.eye(mdp.states)
    for k in range(goes_on.shape[1]):
        np.subtract.at(matrix, (rows, mdp.next_state[rows, policy, k]), goes_on[:, k])
    rewards = (mdp.probability[rows, policy][..., None] * mdp.rewards[rows, policy]).sum(axis=1)
    return np.linalg.solve(matrix, rewards)


@settings(deadline=None)
@given(processes(), st.data())
def test_exact_evaluation_is_the_mean_of_an_episode_from_every_start(mdp, data):
    policy = a_policy(mdp, data)
    outcome = evaluate_policy(mdp, policy, 2, DISCOUNT)
    starts = np.flatnonzero(mdp.start)
    episodes = np.array([played(mdp, policy, state) for state in starts])
    assert outcome.starts == len(starts)
    np.testing.assert_allclose(said(outcome), mdp.start[starts] @ episodes, atol=1e-12)
    np.testing.assert_allclose(outcome.values, mdp.start @ values_of(mdp, policy), atol=1e-9)


@settings(deadline=None)
@given(processes(), st.data())
def test_every_cycle_is_one_and_they_hold_the_time_outs(mdp, data):
    policy = a_policy(mdp, data)
    outcome = evaluate_policy(mdp, policy, 2, DISCOUNT)
    for cycle in outcome.cycles:
        for state, after in itertools.pairwise((*cycle.states, cycle.states[0])):
            assert mdp.next_state[state, policy[state], 0] == after
            assert not mdp.terminated[state, policy[state], 0]
    stuck = sum(cycle.percent for cycle in outcome.cycles)
    if mdp.step_limit >= mdp.states:  # else a way may be cut off before its end
        assert stuck == pytest.approx(outcome.timeout_percent)


@settings(deadline=None, max_examples=40)
@given(processes(outcomes=2), st.data())
def test_chances_are_followed_exactly(mdp, data):
    policy = a_policy(mdp, data)
    mdp = type(mdp)(**{**vars(mdp), "step_limit": min(mdp.step_limit, 6)})
    outcome = evaluate_policy(mdp, policy, 2, DISCOUNT)
    starts = np.flatnonzero(mdp.start)
    episodes = np.array([[float(x) for x in expected(mdp, policy, state)] for state in starts])
    np.testing.assert_allclose(said(outcome), mdp.start[starts] @ episodes, atol=1e-9)
    np.testing.assert_allclose(outcome.values, mdp.start @ values_of(mdp, policy), atol=1e-8)


@settings(deadline=None, max_examples=40)
@given(st.integers(1, 2).flatmap(processes))
def test_the_optimum_is_the_best_of_all_policies(mdp):
    values = optimal_values(mdp, DISCOUNT)
    np.testing.assert_allclose(
        values_of(mdp, greedy_policy(mdp, DISCOUNT, values)).sum(axis=1), values, atol=1e-6
    )
    going_on = DISCOUNT * ~mdp.terminated * values[mdp.next_state]
    worth = (mdp.probability * (mdp.rewards.sum(axis=-1) + going_on)).sum(axis=-1)
    np.testing.assert_allclose(worth.max(axis=1), values, atol=1e-9)


@settings(deadline=None, max_examples=40)
@given(processes(), st.data())
def test_a_best_response_is_the_best_of_all_answers(mdp, data):
    policy = a_policy(mdp, data)
    for learner, stride in ((0, 2), (1, 1)):
        rest = policy - policy // stride % 2 * stride
        found = best_response(mdp, policy, learner, 2, DISCOUNT)
        answers = itertools.product((0, 1), repeat=min(mdp.states, 6))
        for answer in answers:
            own = np.resize(np.array(answer, np.int32), mdp.states)
            assert (found >= values_of(mdp, rest + own * stride)[:, learner] - 1e-8).all()
        joint = rest[:, None] + np.arange(2) * stride
        rows = np.arange(mdp.states)[:, None]
        going_on = DISCOUNT * ~mdp.terminated[rows, joint, 0] * found[mdp.next_state[rows, joint, 0]]
        np.testing.assert_allclose(
            (mdp.rewards[rows, joint, 0, learner] + going_on).max(axis=1), found, atol=1e-9
        )


def test_the_best_two_taxis_deliver_every_passenger():
    mdp = load_mdp("dualtaxi:DualTaxi-v1", {}, None)
    values = optimal_values(mdp, DISCOUNT)
    outcome = evaluate_policy(mdp, greedy_policy(mdp, DISCOUNT, values), 1, DISCOUNT)
    assert (outcome.starts, outcome.finish_percent, outcome.timeout_percent) == (2880, 100.0, 0.0)
    assert outcome.values[0] == pytest.approx(mdp.start @ values, abs=1e-9)


@pytest.mark.parametrize("discount", [1.0, -0.1])
def test_values_need_a_discount_below_one(discount):
    mdp = load_mdp("CliffWalking-v1", {}, None)
    with pytest.raises(EnvironmentNotUsable, match="expected one from 0 up to below 1"):
        optimal_values(mdp, discount)
