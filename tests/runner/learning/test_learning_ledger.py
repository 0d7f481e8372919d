"""The ledger: the weights of rewards and initial values in a Q-value, against plain Python's.

The kernel finds the weights backwards, from the last step to the first. Here they are followed forwards, by
numbers that know what they were made of.
"""

from __future__ import annotations

import numpy as np
import pytest

from runner.learning import ledger
from runner.learning.learner import Learner
from tests.runner.learning.harness import FOLLOWED, RULES, SMALL, experiment, replay, train
from tests.runner.learning.linear import LinearTwin

STEPS = 500
LEARNING = {name: rules for name, rules in (RULES | FOLLOWED).items() if rules.get("algorithm") != "random"}


def updates_of(config, mdp, steps, i):
    """Return what decides the weights of learner i's updates."""
    learner = Learner(config, mdp, 2)
    updates = np.zeros(len(steps), ledger.UPDATE)
    replay(learner, steps, updates, i)
    return learner, updates


def spread(learner, updates, i, state, action, block):
    """Return the shares of all steps in a Q-value, and the ledger before the first step."""
    cells = learner.table(i).size
    tables = 2 if "q_2" in learner.kinds else 1
    found = ledger.Ledger(
        np.zeros((tables, cells)),
        np.zeros((tables, cells)),
        np.zeros(len(learner.model.next_state)),
        np.zeros((len(updates), 2)),
    )
    found.weights[:, state * learner.model.width[i] + action] = 1 / tables
    shares = np.zeros(len(updates), ledger.SHARE)
    part = np.zeros(block, ledger.SHARE)
    for first in reversed(range(0, len(updates), block)):
        own = updates[first : first + block]
        filled = ledger.spread(learner.model, learner.rules, i, first, own, found, 1, part)
        shares[part["step"][:filled]] = part[:filled]
    return shares, found


@pytest.mark.parametrize("rules", LEARNING)
def test_the_weights_are_those_that_plain_python_follows_forwards(rules):
    config, mdp = experiment(SMALL, {"epsilon": 0.4, "step_size": 0.3}, LEARNING[rules])
    twin = LinearTwin(config, mdp, 2)
    twin.train(10**6, STEPS)
    steps = train(Learner(config, mdp, 2), 10**6, STEPS, block=1000).steps
    for i in range(twin.learners):
        learner, updates = updates_of(config, mdp, steps, i)
        for state, action in {(step.state, twin._own(step.action)[i]) for step in twin.training.steps[-9:]}:
            expected = twin.tables[i][state][action]
            assert learner.table(i)[state, action] == expected.value
            shares, found = spread(learner, updates, i, state, action, block=77)
            named = {("step", number): weight for number, weight in enumerate(shares["weight"])}
            width = learner.model.width[i]
            for table, cells in enumerate(found.weights):
                named |= {("initial", table, *divmod(k, width)): weight for k, weight in enumerate(cells)}
            assert named.keys() >= expected.weights.keys()
            known = [expected.weights.get(name, 0.0) for name in named]
            np.testing.assert_allclose(list(named.values()), known, rtol=1e-9, atol=1e-15)


def test_the_weights_by_outcome_and_by_episode_are_sums_over_the_steps():
    config, mdp = experiment(SMALL, {"epsilon": 0.4, "step_size": 0.3})
    steps = train(Learner(config, mdp, 2), 10**6, STEPS, block=1000).steps
    learner, updates = updates_of(config, mdp, steps, 0)
    last = steps[-1]
    shares, found = spread(learner, updates, 0, int(last["state"]), int(last["action"]), block=1000)
    weights, contributions = shares["weight"], shares["contribution"]
    assert contributions == pytest.approx(weights * steps["rewards"][:, 0])
    for episode in np.unique(steps["episode"]):
        own = steps["episode"] == episode
        expected = weights[own].sum(), contributions[own].sum()
        assert found.episodes[episode] == pytest.approx(expected)
    for outcome in np.unique(updates["outcome"]):
        assert found.outcomes[outcome] == pytest.approx(weights[updates["outcome"] == outcome].sum())
    assert found.outcomes.sum() == pytest.approx(weights.sum())


def test_distances_count_the_steps_between():
    """The first episode of a corridor, learned once with full steps: each reward is one step farther."""
    corridor = {"env": {"id": "tests.runner.corridor:Corridor-v0"}, "step_size": 1.0, "epsilon": 1.0}
    config, mdp = experiment(corridor)
    steps = train(Learner(config, mdp, 3), 10**6, 300, block=1000).steps
    learner, updates = updates_of(config, mdp, steps, 0)
    shares, _ = spread(learner, updates, 0, 0, 1, block=1000)
    counted = shares[shares["weight"] > 0]
    assert len(counted)
    # With full steps a value is one chain of bootstraps, whose discounted weights have their distances.
    assert counted["weight"] == pytest.approx(0.95 ** counted["distance"])


def test_a_step_that_the_environment_cannot_have_is_marked():
    config, mdp = experiment(SMALL)
    steps = train(Learner(config, mdp, 2), 10**6, 50, block=1000).steps.copy()
    steps["rewards"][7] = 12345.0
    _, updates = updates_of(config, mdp, steps, 0)
    assert np.flatnonzero(updates["outcome"] == ledger.UNKNOWN_OUTCOME).tolist() == [7]
