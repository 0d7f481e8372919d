"""What is measured of training while it goes on, against a count over all its steps."""

from __future__ import annotations

import math

import numpy as np
import pytest

from runner.learning.learner import Learner
from runner.recording.metrics import TABLE_METRICS
from tests.runner.learning.harness import SMALL, evaluate, experiment, train
from tests.runner.learning.twin import Twin

CASES = {
    "cooperative": {},
    "competitive": {"mode": "competitive", "initial_q": {"random": {"low": -1.0, "high": 1.0}}},
    "team of learners": {"tables": "per_agent", "rewards": "team"},
    "one agent": {"env": {"id": "Taxi-v4", "kwargs": {"is_rainy": True}}},
    "random": {"algorithm": "random", "initial_q": 2.0},
    "changing": {
        "epsilon": {"schedule": "linear", "start": 1.0, "end": 0.0, "over": 30},
        "step_size": {"schedule": "exponential", "start": 0.9, "factor": 0.99, "by": "step"},
        "discount": {"schedule": "piecewise", "points": [[0, 0.5], [20, 0.9]]},
        "quirks": {"epsilon_exploits": True},
    },
}
OF_TABLES = {metric.field: metric.of_table for metric in TABLE_METRICS}
LOGS = [{"window": 1, "episodes": 1}, {"window": 70, "episodes": 3}, {"window": 10**5, "episodes": 10**4}]


@pytest.mark.parametrize("log", LOGS, ids=lambda log: f"last {log['window']}")
@pytest.mark.parametrize("case", CASES)
def test_measures_count_the_last_steps_and_episodes(case, log):
    config, mdp = experiment(SMALL, {"epsilon": 0.5}, CASES[case], log=log)
    learner, twin = Learner(config, mdp, 4), Twin(config, mdp, 4)
    for step in (1, 69, 70, 71, 500, 1400):
        train(learner, 10**6, step, block=100)
        twin.train(10**6, step)
        found, expected = learner.training_metrics(OF_TABLES), twin.training_metrics()
        if expected["mean_length"] is None:
            assert math.isnan(found.pop("mean_length"))
            del expected["mean_length"]
        assert found == expected


def test_before_the_first_step_there_is_nothing_to_count():
    config, mdp = experiment(SMALL, epsilon=0.25, step_size=0.5, discount=0.75)
    measures = Learner(config, mdp, 0).training_metrics(OF_TABLES)
    assert math.isnan(measures.pop("mean_length"))
    assert measures == {
        "step": 0,
        "episode": 0,
        "rewards": [],
        "reward_counts": [],
        "zero_cells": [128 * 36],
        "percent_filled": [0.0],
        "epsilon": 0.25,
        "step_size": 0.5,
        "discount": 0.75,
    }


@pytest.mark.parametrize("case", ["cooperative", "competitive", "random"])
def test_evaluating_and_measuring_leave_training_alone(case):
    config, mdp = experiment(SMALL, {"epsilon": 0.5}, CASES[case])
    plain, watched = Learner(config, mdp, 4), Learner(config, mdp, 4)
    expected = train(plain, 10**6, 1000, block=1000).steps
    pieces = []
    for n, step in enumerate((130, 131, 700, 1000)):
        pieces.append(train(watched, 10**6, step, block=1000).steps)
        evaluate(watched, n * 3, 3, block=50)
        watched.training_metrics(OF_TABLES)
    assert np.array_equal(np.concatenate(pieces), expected)
    assert watched.tables.q.tobytes() == plain.tables.q.tobytes()
    assert watched.training_metrics(OF_TABLES) == plain.training_metrics(OF_TABLES)


def test_greedy_trials_do_not_depend_on_when_training_stopped_within_an_episode():
    config, mdp = experiment(SMALL, epsilon=0.5)
    learner = Learner(config, mdp, 4)
    train(learner, 10**6, 333, block=1000)
    table = learner.table(0).copy()
    played = evaluate(learner, 0, 5, block=1000)
    assert (played.steps["action"] == table.argmax(axis=1)[played.steps["state"]]).all()
    assert not played.steps["explored"].any()
    assert played.episodes["episode"].tolist() == [0, 1, 2, 3, 4]
    assert np.array_equal(learner.table(0), table)


def test_random_agents_are_evaluated_acting_at_random():
    config, mdp = experiment(SMALL, {"mode": "competitive", "algorithm": "random"})
    played = evaluate(Learner(config, mdp, 4), 0, 40, block=1000)
    assert (played.steps["explored"] == 3).all()
    assert set(np.unique(played.steps["action"])) == set(range(36))
