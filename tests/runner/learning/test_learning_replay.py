"""Replay: recorded steps, applied to a table before them, give the table after them, bit for bit."""

from __future__ import annotations

import numpy as np
import pytest

from runner.learning.learner import Learner
from tests.runner.learning.harness import (
    ALGORITHMS,
    GAMES,
    RULES,
    SMALL,
    Played,
    experiment,
    recall,
    replay,
    train,
)


def replayed(config, mdp, seed, steps, tables=None, before=None):
    """Return the tables after these steps; `before` are those of the first episode before them."""
    learner = Learner(config, mdp, seed, tables)
    if learner.algorithm.remember and before is not None:
        recall(learner, before)
    replay(learner, steps)
    return learner.tables


def same(left, right):
    """Compare all that two learners' tables hold, bit for bit."""
    for name in ("q", "greedy", "value", "extra", "visits"):
        assert getattr(left, name).tobytes() == getattr(right, name).tobytes(), name


@pytest.mark.parametrize("rules", RULES | ALGORITHMS)
def test_all_steps_replayed_give_the_tables(rules):
    config, mdp = experiment(SMALL, {"epsilon": 0.4, "step_size": 0.3}, (RULES | ALGORITHMS)[rules])
    learner = Learner(config, mdp, 2)
    steps = train(learner, 10**6, 3000, block=1000).steps
    same(replayed(config, mdp, 2, steps), learner.tables)


@pytest.mark.parametrize("rules", ALGORITHMS)
def test_steps_after_any_moment_give_the_tables_from_what_was_held_then(rules):
    config, mdp = experiment(SMALL, {"epsilon": 0.4, "step_size": 0.3}, ALGORITHMS[rules])
    learner = Learner(config, mdp, 2)
    for stop in (7, 33, 34, 1777):  # also within an episode
        train(learner, 10**6, stop, block=1000)
        held = [
            {name: array.copy() for name, array in learner.named_tables(i).items()}
            for i in range(len(learner.agents))
        ]
        other = Learner(config, mdp, 2)
        before = train(other, 10**6, stop, block=1000).steps
        steps = train(other, 10**6, stop + 500, block=77).steps
        before = before[before["episode"] == steps["episode"][0]]
        same(replayed(config, mdp, 2, steps, held, before), other.tables)


@pytest.mark.parametrize("game", GAMES)
def test_steps_after_a_snapshot_give_the_tables_from_it(game):
    config, mdp = experiment(GAMES[game], {"epsilon": 0.6, "step_size": 0.3, "initial_q": "random"})
    learner = Learner(config, mdp, 11)
    before: Played = train(learner, 10**6, 1777, block=1000)
    snapshot = [{"q": learner.table(i).copy()} for i in range(len(learner.agents))]
    after = train(learner, 10**6, 4000, block=1000)
    assert (
        replayed(config, mdp, 11, before.steps).q.tobytes()
        == np.concatenate([held["q"] for held in snapshot], axis=None).tobytes()
    )
    assert replayed(config, mdp, 11, after.steps, snapshot).q.tobytes() == learner.tables.q.tobytes()


def test_the_cached_greedy_action_and_value_always_match_the_table():
    config, mdp = experiment(SMALL, {"mode": "competitive"}, epsilon=0.7, step_size=0.5)
    learner = Learner(config, mdp, 5)
    for step in range(50, 2000, 50):
        train(learner, 10**6, step, block=1000)
        for i in range(2):
            table = learner.table(i)
            assert np.array_equal(learner.tables.greedy[i], table.argmax(axis=1))
            assert np.array_equal(learner.tables.value[i], table.max(axis=1))


@pytest.mark.parametrize("learners", [{}, {"mode": "competitive"}])
@pytest.mark.parametrize(
    ("simple", "general"),
    [
        ("sarsa", {"algorithm": "sarsa_lambda", "sarsa_lambda": {"trace_decay": 0.0}}),
        ("q_learning", {"algorithm": "n_step_q_learning", "n_step": {"n": 1}}),
    ],
)
def test_the_simplest_case_of_a_general_algorithm_is_the_simple_one(simple, general, learners):
    tables = []
    for values in ({"algorithm": simple}, general):
        config, mdp = experiment(SMALL, learners, {"epsilon": 0.4, "step_size": 0.3}, values)
        learner = Learner(config, mdp, 2)
        train(learner, 10**6, 3000, block=1000)
        tables.append(learner.tables)
    same(*tables)
