"""What a run's environment consists of is stated in the same way everywhere."""

from __future__ import annotations

import json
from typing import Any

import gymnasium
import pytest
from gymnasium import wrappers
from gymnasium.vector import SyncVectorEnv
from starlette.testclient import TestClient

import runner
from dualtaxi.parallel import DualTaxiParallelEnv
from runner.export.reports.report import render_report
from runner.integrations.tensorboard import SummaryWriter
from runner.recording.environment import composition_of
from runner.recording.maker import EnvironmentMaker
from runner.recording.reader import open_recording
from runner.service.app import create_app
from runner.service.settings import ServiceSettings
from tests.runner.loops.making import dualtaxi


def clipped() -> Any:
    return wrappers.ClipReward(gymnasium.make("CartPole-v1", max_episode_steps=1000), 100, 100)


def words_of(rec: Any) -> str:
    rec.close()
    with open_recording(rec.run.recording) as recording:
        return str(composition_of(recording))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: gymnasium.make("CartPole-v1"), "CartPole-v1, at most 500 steps"),
        (
            clipped,
            "CartPole-v1, at most 1,000 steps (registered: 500), wrapped by ClipReward(min_reward=100, "
            "max_reward=100)",
        ),
        (
            lambda: wrappers.RecordEpisodeStatistics(gymnasium.make("Pendulum-v1", g=3.0)).env,
            "Pendulum-v1(g=3.0), at most 200 steps",
        ),
        (
            lambda: gymnasium.make("FrozenLake8x8-v1", is_slippery=False, max_episode_steps=-1),
            "FrozenLake8x8-v1(is_slippery=false), no step limit (registered: 200)",
        ),
        (
            lambda: wrappers.TransformReward(gymnasium.make("CartPole-v1"), abs),
            "CartPole-v1, at most 500 steps, wrapped by TimeLimit(…), TransformReward(…)",
        ),
    ],
)
def test_an_environment_in_words(make, words, tmp_path):
    assert words_of(runner.record(make(), tmp_path)) == words


def test_vectors_games_and_functions_in_words(tmp_path):
    envs = wrappers.vector.NormalizeReward(SyncVectorEnv([clipped] * 2), gamma=0.5)
    assert words_of(runner.record_vector(envs, tmp_path)).endswith(
        "wrapped by ClipReward(min_reward=100, max_reward=100), NormalizeReward(gamma=0.5, epsilon=1e-08)"
    )
    game = words_of(runner.record_parallel(DualTaxiParallelEnv(max_steps=30), tmp_path))
    assert game.startswith("dualtaxi_v1(max_steps=30, ")
    made = words_of(runner.record(gymnasium.make("CartPole-v1"), tmp_path, make=clipped))
    assert made.endswith(f"made by {__name__}:clipped")


def test_every_view_of_a_run_states_it(tmp_path):
    with runner.record(clipped(), tmp_path) as rec:
        rec.reset(seed=0)
        while not rec.step(1)[2]:
            pass
    words = words_of(rec)
    assert words in " ".join(dualtaxi(tmp_path, "show", rec.run.run_id).output.split())
    shown = json.loads(dualtaxi(tmp_path, "show", rec.run.run_id, "--json").output)
    assert shown["environment"]["registered_step_limit"] == 500
    arguments = {"min_reward": 100, "max_reward": 100}
    assert shown["environment"]["wrappers"] == [{"name": "ClipReward", "arguments": arguments}]
    assert words in " ".join(dualtaxi(tmp_path, "verify", rec.run.run_id).output.split())
    verified = json.loads(dualtaxi(tmp_path, "verify", rec.run.run_id, "--json").output)
    assert (verified["verdict"], verified["environment"]) == ("reproduced", shown["environment"])
    assert words in render_report([rec.run.recording])[0]
    settings = ServiceSettings(recordings=(tmp_path,), tokens=tmp_path / "tokens.json")
    with TestClient(create_app(settings), base_url="http://localhost") as client:
        assert words in client.get(f"/runs/{rec.run.run_id}").text


def test_logged_values_alone_have_no_environment(tmp_path):
    with SummaryWriter(recordings=tmp_path) as writer:
        writer.add_scalar("loss", 1.0, 0)
    (run,) = runner.list_runs(tmp_path)
    assert json.loads(dualtaxi(tmp_path, "show", run.run_id, "--json").output)["environment"] is None


def test_a_specification_of_another_form_is_shown_as_far_as_possible(tmp_path):
    with (
        runner.record(gymnasium.make("CartPole-v1"), tmp_path) as rec,
        open_recording(rec.run.recording) as found,
    ):
        spec = {"kwargs": [3], "additional_wrappers": [3, {"name": "x"}], "max_episode_steps": "many"}
        found.__dict__["maker"] = EnvironmentMaker("gymnasium", spec=json.dumps(spec))
        assert str(composition_of(found)) == "CartPole-v1, wrapped by None(…)"
