"""The compiled kernel against its plain-Python twin: same trajectory, same tables, to the last bit."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from runner.config import from_mapping
from runner.config.model import Algorithm
from runner.environments.mdp import Mdp
from runner.errors import EnvironmentNotUsable
from runner.learning.learner import Learner
from tests.runner.learning.harness import (
    ALGORITHMS,
    COMPETITIVE,
    GAMES,
    RULES,
    SMALL,
    assert_same_records,
    assert_same_tables,
    evaluate,
    experiment,
    train,
)
from tests.runner.learning.twin import Episode, Step, Twin


def assert_kernel_is_twin(config, mdp, seed, blocks, until=(10**6, 1200), trials=2) -> Twin:
    """Train, evaluate, train on and evaluate again, in blocks of each size; return the twin."""
    half = until[0] // 2, until[1] // 2
    twin = Twin(config, mdp, seed)
    for goal in (half, until):
        twin.train(*goal)
        twin.evaluate(trials)
    for block in blocks:
        learner = Learner(config, mdp, seed)
        trained, played = [], []
        for n, goal in enumerate((half, until)):
            trained.append(train(learner, *goal, block))
            played.append(evaluate(learner, n * trials, trials, block))
        for phase, runs in ((twin.training, trained), (twin.evaluation, played)):
            assert_same_records(np.concatenate([run.steps for run in runs]), phase.steps, Step)
            assert_same_records(np.concatenate([run.episodes for run in runs]), phase.episodes, Episode)
        assert_same_tables(learner, twin)
    return twin


@pytest.mark.parametrize("game", GAMES)
def test_trajectories_and_tables_are_the_twins_in_every_game(game):
    config, mdp = experiment(GAMES[game], {"epsilon": 0.6, "step_size": 0.3})
    twin = assert_kernel_is_twin(config, mdp, seed=11, blocks=[1000], until=(10**6, 3500))
    assert twin.training.episodes, "the case must see episodes end"


@pytest.mark.parametrize("rules", RULES)
def test_trajectories_and_tables_are_the_twins_by_every_rule(rules):
    config, mdp = experiment(SMALL, {"epsilon": 0.4, "step_size": 0.3}, RULES[rules])
    twin = assert_kernel_is_twin(config, mdp, seed=2, blocks=[1, 7, 1000])
    ends = {(episode.terminated, episode.truncated) for episode in twin.training.episodes}
    assert {(True, False), (False, True)} <= ends, "the case must see episodes end both ways"


@pytest.mark.parametrize("rules", ALGORITHMS)
def test_trajectories_and_tables_are_the_twins_by_every_algorithm(rules):
    config, mdp = experiment(SMALL, {"epsilon": 0.4, "step_size": 0.3}, ALGORITHMS[rules])
    twin = assert_kernel_is_twin(config, mdp, seed=2, blocks=[1, 7, 1000])
    assert any(episode.truncated for episode in twin.training.episodes), "the case must see episodes cut off"


@pytest.mark.parametrize("game", ["slipping", "frozen lake", "taxi in the rain"])
@pytest.mark.parametrize("algorithm", ["sarsa", "expected_sarsa", "double_q_learning", "wolf_phc"])
def test_every_algorithm_plays_games_of_chance_as_its_twin(algorithm, game):
    config, mdp = experiment(GAMES[game], {"epsilon": 0.6, "step_size": 0.3, "algorithm": algorithm})
    assert_kernel_is_twin(config, mdp, seed=11, blocks=[1000], until=(10**6, 1500))


@pytest.mark.parametrize("seed", [0, 1, 2**32 + 5, 2**63, 2**64 - 1])
def test_trajectories_and_tables_are_the_twins_for_every_seed(seed):
    config, mdp = experiment(SMALL, COMPETITIVE)
    assert_kernel_is_twin(config, mdp, seed, blocks=[100])


@st.composite
def random_mdps(draw, agents):
    """Any small game: several outcomes, rewards of one or of each agent, some that never end."""
    actions = tuple(draw(st.lists(st.integers(1, 3), min_size=agents, max_size=agents)))
    shape = draw(st.integers(1, 5)), math.prod(actions), draw(st.integers(1, 3))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    weights = rng.integers(0, 3, shape) + np.eye(shape[2], dtype=int)[rng.integers(0, shape[2], shape[:2])]
    starts = rng.integers(0, 2, shape[0]) + np.eye(shape[0], dtype=int)[0]
    scale = draw(st.sampled_from([1.0, 0.1, 1e300, 1e-300]))
    names = ("bell", "goal")
    return Mdp(
        env_id="random",
        kwargs={},
        next_state=rng.integers(0, shape[0], shape).astype(np.int32),
        probability=weights / weights.sum(axis=2, keepdims=True),
        rewards=rng.integers(-3, 4, (*shape, draw(st.sampled_from([1, agents])))) * scale,
        terminated=rng.random(shape) < draw(st.sampled_from([0.0, 0.2, 1.0])),
        events=rng.integers(0, 4, shape).astype(np.uint32),
        start=starts / starts.sum(),
        step_limit=draw(st.integers(1, 9)),
        agents=("a", "b", "c")[:agents],
        action_counts=actions,
        event_names=names,
        success_events=draw(st.sampled_from([(), ("goal",), names])),
        penalty_below=draw(st.sampled_from([-np.inf, 0.0, 1.0])),
    )


fractions = st.floats(0.0, 1.0)
points = st.lists(fractions, min_size=1, max_size=4).map(lambda ys: [[9 * k, y] for k, y in enumerate(ys)])
schedules = st.one_of(
    st.fixed_dictionaries(
        {"schedule": st.just(kind), "by": st.sampled_from(["episode", "step"]), "floor": fractions}
        | parameters
    )
    for kind, parameters in {
        "linear": {"start": fractions, "end": fractions, "over": st.integers(1, 60)},
        "exponential": {"start": fractions, "factor": st.floats(0.5, 1.0)},
        "piecewise": {"points": points},
    }.items()
)
settings_of_learners = st.fixed_dictionaries(
    {
        "epsilon": fractions | schedules,
        "discount": fractions | schedules,
        "step_size": st.floats(0.01, 1.0),
        "exploration": st.sampled_from(["shared", "independent"]),
        "algorithm": st.sampled_from(get_args(Algorithm)),
        "initial_q": st.floats(-2.0, 2.0) | st.just("random"),
        "quirks": st.fixed_dictionaries(
            {
                "epsilon_exploits": st.booleans(),
                "second_table_uses_first_action": st.booleans(),
                "bootstrap_after_termination": st.booleans(),
            }
        ),
    }
)


@pytest.mark.long
@settings(deadline=None, max_examples=30)
@given(random_mdps(agents=2), settings_of_learners, st.integers(0, 2**64 - 1), st.integers(1, 40))
def test_any_game_by_any_rule_is_learned_as_the_twin_does(mdp, values, seed, block):
    assert_any_game_is_learned(mdp, values, seed, block)


@settings(deadline=None, max_examples=10)
@given(random_mdps(agents=3), settings_of_learners, st.integers(0, 2**64 - 1), st.integers(1, 40))
def test_any_game_of_three_is_learned_as_the_twin_does(mdp, values, seed, block):
    values |= {"algorithm": "q_learning"}  # the others would be compiled for three learners for this alone
    assert_any_game_is_learned(mdp, values, seed, block)


def assert_any_game_is_learned(mdp, values, seed, block):
    if values["algorithm"] not in ("q_learning", "random"):
        values["quirks"]["second_table_uses_first_action"] = False
    config = from_mapping({"episodes": 100, "mode": "competitive"} | values)
    assume(len(set(mdp.action_counts)) == 1 or not config.quirks.second_table_uses_first_action)
    assert_kernel_is_twin(config, mdp, seed, [block], until=(40, 120))


def test_an_episode_may_be_ended_by_both_termination_and_the_step_limit():
    config, mdp = experiment(
        {"env": {"id": "FrozenLake-v1", "kwargs": {"max_episode_steps": 4}}}, epsilon=1.0
    )
    twin = assert_kernel_is_twin(config, mdp, seed=0, blocks=[100])
    assert any(episode.terminated and episode.truncated for episode in twin.training.episodes)


def test_rewards_of_several_agents_need_several_tables():
    _, mdp = experiment(SMALL, COMPETITIVE)
    with pytest.raises(EnvironmentNotUsable, match=r"rewards: team.*tables: per_agent"):
        Learner(experiment(SMALL)[0], mdp, 0)


def test_the_second_table_takes_the_first_action_only_where_it_has_one():
    config, mdp = experiment(SMALL, COMPETITIVE, {"quirks": {"second_table_uses_first_action": True}})
    uneven = replace(mdp, action_counts=(9, 4))
    with pytest.raises(EnvironmentNotUsable, match=r"second_table_uses_first_action.*9 and 4"):
        Learner(config, uneven, 0)


@pytest.mark.parametrize("start", ["each", 77, "random"])
def test_trials_start_in_the_given_states(start):
    config, mdp = experiment(SMALL, evaluation={"every": 1, "trials": 1, "start": start})
    twin = assert_kernel_is_twin(config, mdp, seed=3, blocks=[1000], trials=30)
    begun = [step.state for step in twin.evaluation.steps if step.t == 0]
    possible = np.flatnonzero(mdp.start).tolist()
    expected = {"each": (possible * 9)[:60], 77: [77] * 60}
    assert begun == expected.get(start, begun)
    assert set(begun) <= {77, *possible}


def test_where_nothing_ends_an_episode_there_is_no_evaluation():
    endless = {"env": {"id": "CliffWalking-v1"}}
    with pytest.raises(EnvironmentNotUsable, match=r"no step limit.*max_episode_steps.*evaluation: null"):
        Learner(*experiment(endless), 0)
    config, mdp = experiment(endless, evaluation=None, epsilon=0.5)
    twin, learner = Twin(config, mdp, 6), Learner(config, mdp, 6)
    twin.train(10**6, 2500)
    played = train(learner, 10**6, 2500, block=100)
    assert_same_records(played.steps, twin.training.steps, Step)
    assert not played.steps["truncated"].any()
