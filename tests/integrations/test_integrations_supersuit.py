"""SuperSuit's vectors of a game's agents, which state no autoreset mode."""

from __future__ import annotations

import numpy as np
import pytest
import supersuit
from mpe2 import simple_spread_v3

import runner
from runner.errors import EnvironmentNotUsable
from runner.execution.verify import check_integrity, verify
from runner.recording.reader import open_recording
from tests.integrations.supersuit_games import spread


def test_agents_of_games_are_recorded_with_their_last_observations_and_come_out_again(recordings):
    envs, rng, last = spread(), np.random.default_rng(0), []
    with runner.record_vector(envs, autoreset_mode="SameStep", make=spread, info=["*"]) as rec:
        rec.reset(seed=0)
        for _ in range(50):
            infos = rec.step(rng.integers(0, 5, envs.num_envs))[4]
            last += [info["terminal_observation"] for info in infos if "terminal_observation" in info]
    check_integrity(rec.run.recording)
    with open_recording(rec.run.recording) as recording:
        episodes = recording.train.episodes.array()
        steps = recording.train.steps.array()
    assert len(episodes) == len(last) == 12
    assert (episodes["length"] == 20).all()
    np.testing.assert_array_equal(steps["next_observation"][episodes["last_step"]], last)
    found = verify(rec.run.recording, trust=True)
    assert (found.verdict, found.steps) == ("reproduced", 300)


@pytest.mark.parametrize(
    "wrap",
    [
        lambda game: supersuit.frame_stack_v1(game, 3),
        lambda game: supersuit.clip_reward_v0(game, -0.5, 0.5),
        lambda game: supersuit.max_observation_v0(supersuit.black_death_v3(game), 2),
    ],
)
def test_a_wrapped_game_comes_out_again(wrap, recordings):
    with runner.record_parallel(wrap(simple_spread_v3.parallel_env(N=2, max_cycles=7))) as rec:
        for seed in range(3):
            rec.reset(seed=seed)
            while rec.agents:
                rec.step(dict.fromkeys(rec.agents, seed))
    found = verify(rec.run.recording, trust=True)
    assert (found.verdict, found.assumed) == ("reproduced", ())
    assert found.steps >= 21


def test_a_wrapper_whose_arguments_are_unknown_is_named(recordings):
    game = supersuit.dtype_v0(simple_spread_v3.parallel_env(), "float64")
    with runner.record_parallel(game) as rec, open_recording(rec.run.recording) as recording:
        assert "basic_obs_wrapper has the argument module" in recording.maker.reason


def test_the_error_without_a_mode_names_the_argument():
    with pytest.raises(EnvironmentNotUsable, match=r'"SameStep" \(SuperSuit\)'):
        runner.record_vector(spread())
