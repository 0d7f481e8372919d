"""Planning against what anybody would write: episodes played out, equations solved."""

from __future__ import annotations

import itertools
from collections import OrderedDict
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runner.environments.loading import load_mdp
from runner.environments.mdp import Mdp
from runner.errors import EnvironmentNotUsable
from runner.planning import baseline, exact
from runner.planning.baseline import random_baseline
from runner.planning.exact import (
    best_response,
    best_response_to_stochastic,
    evaluate_policy,
    evaluate_stochastic_policy,
    greedy_policy,
    optimal_values,
    random_policy,
)

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


def as_array(outcome):
    return np.array(
        [
            outcome.success_percent / 100,
            outcome.timeout_percent / 100,
            *(outcome.mean_length, outcome.mean_penalties, *outcome.mean_returns),
        ]
    )


def values_of(mdp, policy):
    """Return the discounted values [S, 2] of a policy by solving its linear equations."""
    rows = np.arange(mdp.states)
    continuation = DISCOUNT * mdp.probability[rows, policy] * ~mdp.terminated[rows, policy]
    matrix = np.eye(mdp.states)
    for k in range(continuation.shape[1]):
        np.subtract.at(matrix, (rows, mdp.next_state[rows, policy, k]), continuation[:, k])
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
    np.testing.assert_allclose(as_array(outcome), mdp.start[starts] @ episodes, atol=1e-12)
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
    np.testing.assert_allclose(as_array(outcome), mdp.start[starts] @ episodes, atol=1e-9)
    np.testing.assert_allclose(outcome.values, mdp.start @ values_of(mdp, policy), atol=1e-8)


def two_policies(mdp, data):
    """Return a stochastic policy of each agent, [S, 2], with zeros among its probabilities."""
    chances = st.sampled_from([0.0, 0.25, 0.5, 1.0])
    own = st.lists(chances, min_size=mdp.states, max_size=mdp.states)
    return [np.array([[1 - p, p] for p in data.draw(own)]) for _ in mdp.agents]


def folded(mdp, policies):
    """Return the process whose only action is to draw from the policies: its outcomes are all [S, 4 K]."""
    joint = (policies[0][:, :, None] * policies[1][:, None, :]).reshape(mdp.states, 4)
    shape = mdp.states, 1, -1
    return type(mdp)(
        **vars(mdp)
        | {
            "next_state": mdp.next_state.reshape(shape),
            "probability": (joint[..., None] * mdp.probability).reshape(shape),
            "rewards": mdp.rewards.reshape(*shape, 2),
            "terminated": mdp.terminated.reshape(shape),
            "events": mdp.events.reshape(shape),
        }
    )


@settings(deadline=None, max_examples=40)
@given(st.integers(1, 2).flatmap(processes), st.data())
def test_policies_that_draw_are_evaluated_exactly(mdp, data):
    policies = two_policies(mdp, data)
    mdp = type(mdp)(**{**vars(mdp), "step_limit": min(mdp.step_limit, 3)})
    outcome = evaluate_stochastic_policy(mdp, policies, 2, DISCOUNT)
    drawing, only = folded(mdp, policies), np.zeros(mdp.states, np.int32)
    starts = np.flatnonzero(mdp.start)
    episodes = np.array([[float(x) for x in expected(drawing, only, state)] for state in starts])
    np.testing.assert_allclose(as_array(outcome), mdp.start[starts] @ episodes, atol=1e-9)
    np.testing.assert_allclose(outcome.values, mdp.start @ values_of(drawing, only), atol=1e-8)


@settings(deadline=None, max_examples=40)
@given(processes(), st.data())
def test_a_policy_that_draws_with_certainty_is_the_deterministic_one(mdp, data):
    policy = a_policy(mdp, data)
    certain = [np.eye(2)[policy // 2], np.eye(2)[policy % 2]]
    assert evaluate_stochastic_policy(mdp, certain, 2, DISCOUNT) == evaluate_policy(mdp, policy, 2, DISCOUNT)
    for learner in (0, 1):
        np.testing.assert_allclose(
            best_response_to_stochastic(mdp, certain, learner, DISCOUNT),
            best_response(mdp, policy, learner, 2, DISCOUNT),
            atol=1e-9,
        )


@settings(deadline=None, max_examples=40)
@given(st.integers(1, 2).flatmap(processes), st.data())
def test_a_best_response_to_policies_that_draw_solves_its_optimality_equation(mdp, data):
    policies = two_policies(mdp, data)
    shape = mdp.states, 2, 2, -1
    for learner in (0, 1):
        found = best_response_to_stochastic(mdp, policies, learner, DISCOUNT)
        future = DISCOUNT * ~mdp.terminated * found[mdp.next_state]
        value = (mdp.probability * (mdp.rewards[..., learner] + future)).reshape(shape).sum(axis=-1)
        other = policies[1 - learner]
        own = np.einsum("sab,sb->sa" if learner == 0 else "sab,sa->sb", value, other)
        np.testing.assert_allclose(own.max(axis=1), found, atol=1e-9)


def test_matching_pennies_the_even_policy_cannot_be_exploited_and_any_other_can():
    """One state, one step: the row player wins 1 where both choose the same side, else loses 1."""
    pays = np.array([1.0, -1.0, -1.0, 1.0])
    game = Mdp(
        env_id="Pennies-v0",
        kwargs={},
        next_state=np.zeros((1, 4, 1), np.int32),
        probability=np.ones((1, 4, 1)),
        rewards=np.stack([pays, -pays], axis=-1).reshape(1, 4, 1, 2),
        terminated=np.ones((1, 4, 1), np.bool_),
        events=np.zeros((1, 4, 1), np.uint32),
        start=np.ones(1),
        step_limit=1,
        agents=("row", "column"),
        action_counts=(2, 2),
        event_names=(),
        success_events=(),
        penalty_below=-5.0,
    )
    even, leaning = np.array([[0.5, 0.5]]), np.array([[0.8, 0.2]])
    assert best_response_to_stochastic(game, [even, even], 0, DISCOUNT) == pytest.approx([0.0])
    assert best_response_to_stochastic(game, [leaning, even], 1, DISCOUNT) == pytest.approx([0.6])
    outcome = evaluate_stochastic_policy(game, [leaning, leaning], 2, DISCOUNT)
    assert outcome.values == pytest.approx((0.36, -0.36))


def test_random_taxis_deliver_in_five_of_six_episodes():
    mdp = load_mdp("dualtaxi:DualTaxi-v1", {}, None)
    outcome = evaluate_stochastic_policy(mdp, random_policy(mdp), 1, DISCOUNT)
    assert outcome.success_percent == pytest.approx(83.3386, abs=1e-4)
    assert outcome.mean_length == pytest.approx(687.396, abs=1e-3)


@pytest.mark.parametrize("rewards", ["team", "individual"])
def test_the_random_baseline_is_the_same_however_rewards_are_paid(rewards):
    small = {"map": ["+---+", "|A: |", "| |B|", "+---+"], "max_episode_steps": 90}
    baseline = random_baseline(load_mdp("dualtaxi:DualTaxi-v1", small, rewards))
    assert baseline.sentence.startswith("A random policy succeeds in 38.1 %")
    assert baseline.mean_return == pytest.approx(-784.8587, abs=1e-3)


def test_a_baseline_that_would_take_minutes_is_left_out():
    endless = load_mdp("CliffWalking-v1", {"max_episode_steps": 200_000_000}, None)
    assert random_baseline(endless) is None


@settings(deadline=None, max_examples=40)
@given(st.integers(1, 2).flatmap(processes))
def test_the_optimum_is_the_best_of_all_policies(mdp):
    values = optimal_values(mdp, DISCOUNT)
    np.testing.assert_allclose(
        values_of(mdp, greedy_policy(mdp, DISCOUNT, values)).sum(axis=1), values, atol=1e-6
    )
    future = DISCOUNT * ~mdp.terminated * values[mdp.next_state]
    value = (mdp.probability * (mdp.rewards.sum(axis=-1) + future)).sum(axis=-1)
    np.testing.assert_allclose(value.max(axis=1), values, atol=1e-9)


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
        future = DISCOUNT * ~mdp.terminated[rows, joint, 0] * found[mdp.next_state[rows, joint, 0]]
        np.testing.assert_allclose(
            (mdp.rewards[rows, joint, 0, learner] + future).max(axis=1), found, atol=1e-9
        )


def test_the_best_two_taxis_deliver_every_passenger():
    mdp = load_mdp("dualtaxi:DualTaxi-v1", {}, None)
    values = optimal_values(mdp, DISCOUNT)
    outcome = evaluate_policy(mdp, greedy_policy(mdp, DISCOUNT, values), 1, DISCOUNT)
    assert (outcome.starts, outcome.success_percent, outcome.timeout_percent) == (2880, 100.0, 0.0)
    assert outcome.values[0] == pytest.approx(mdp.start @ values, abs=1e-9)


@pytest.mark.parametrize("discount", [1.0, -0.1])
def test_values_need_a_discount_below_one(discount):
    mdp = load_mdp("CliffWalking-v1", {}, None)
    with pytest.raises(EnvironmentNotUsable, match="expected one from 0 up to below 1"):
        optimal_values(mdp, discount)


def test_the_random_baseline_is_computed_once_and_a_damaged_cache_is_not_believed(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    mdp = load_mdp("FrozenLake-v1", {}, "team")
    monkeypatch.setattr(baseline, "_remembered", OrderedDict())
    computed = baseline.random_baseline(mdp)
    (file,) = tmp_path.rglob("*.json")
    for damage in ("", "{}", '{"mean_length": "1", "mean_return": 1.0, "success_percent": 1.0}'):
        file.write_text(damage)
        baseline._remembered.clear()
        assert baseline.random_baseline(mdp) == computed
    baseline._remembered.clear()
    monkeypatch.setattr(exact, "evaluate_stochastic_policy", None)
    assert baseline.random_baseline(mdp) == computed
