"""SuperSuit's vectors of a game's agents, which state no autoreset mode."""

from __future__ import annotations

import numpy as np
import pytest

import runner
from runner.errors import EnvironmentNotUsable
from runner.execution.redo import verify_by_redoing
from runner.execution.verify import check_integrity
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
        episodes = recording.episodes("train")
        steps = np.concatenate(list(recording.blocks(recording.topic("/train/step"))))
    assert len(episodes) == len(last) == 12
    assert (episodes["length"] == 20).all()
    np.testing.assert_array_equal(steps["next_observation"][episodes["last_step"]], last)
    found = verify_by_redoing(rec.run.recording, trust=True)
    assert (found.verdict, found.steps) == ("reproduced", 300)


def test_the_error_without_a_mode_names_the_argument():
    with pytest.raises(EnvironmentNotUsable, match=r'"SameStep" \(SuperSuit\)'):
        runner.record_vector(spread())
