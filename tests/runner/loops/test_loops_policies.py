"""Checkpoints at work: played in the recorded environment, and along recorded episodes."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import runner
from runner.errors import CannotRedo, ConfigError, RunnerError
from runner.execution.verify import verify
from runner.loops.policies import play_checkpoint, values_along
from runner.runs.resolve import find_run
from tests.runner.loops.making import Rooms, dualtaxi, make, play

pytest.importorskip("safetensors")

AGENT = """
import numpy as np

def policy(weights, observation_space, action_space):
    assert action_space.contains(1) and observation_space.shape == (4,)
    return lambda observation: int((observation @ weights["w"]).argmax())

def values(weights, observation_space, action_space):
    def think(observation):
        q = observation @ weights["w"]
        return {"q": q, "best": q.max()}
    return think

def number(content, *spaces):
    return lambda observation: float(len(content))

def of_rooms(content, observation_space, action_space):
    def think(observation):
        assert observation_space.contains(observation), observation
        return observation["position"]
    return think

def failing(content, *spaces):
    return lambda observation: 1 / 0

def ragged(content, *spaces):
    sizes = iter(range(1, 1000))
    return lambda observation: np.zeros(next(sizes))

def wordy(content, *spaces):
    return lambda observation: "left"

not_a_function = 5
"""
BALANCING = np.array([[-1, 1], [-1, 1], [-5, 5], [-2, 2]], np.float32)


@pytest.fixture(autouse=True)
def agent(tmp_path, monkeypatch):
    (tmp_path / "agent_of_test.py").write_text(AGENT)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(__import__("sys").modules, "agent_of_test", raising=False)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a recordings folder with a loop whose second checkpoint balances the pole."""
    made = tmp_path_factory.mktemp("policies")
    with runner.record(gymnasium.make("CartPole-v1"), made, name="pole") as rec:
        rec.checkpoint("policy", {"w": BALANCING * 0})
        for k, _ in enumerate(play(rec, 200)):
            if k == 100:
                rec.checkpoint("policy", {"w": BALANCING})
    with runner.record(make("Rooms"), made, name="rooms") as rec:
        list(play(rec, 60))
        rec.checkpoint("policy", b"four")
    return made


def test_a_checkpoint_is_played_in_the_recorded_environment(folder):
    origin = find_run("pole", folder)
    steps = {each.step for each in origin.checkpoints()}
    words = ["--checkpoint", "@latest", "--policy", "agent_of_test:policy", "--trials", "3", "--seed", "7"]
    done = dualtaxi(folder, "evaluate", origin.run_id, *words, "--json")
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    assert found["last_evaluation"]["mean_return"] == 500
    assert found["last_evaluation"]["trials"] == 3
    assert found["spread"]["return"] == {"standard_deviation": 0.0, "lowest": 500.0, "highest": 500.0}
    shown = dualtaxi(folder, "evaluate", origin.run_id, *words)
    assert re.search(r"mean return +500\.0, standard deviation 0\.0, 500\.0 to 500\.0", shown.output)
    checkpoint = origin.checkpoints()[-1]
    expected = {"run": origin.run_id, "checkpoint": "policy", "step": max(steps), "digest": checkpoint.digest}
    assert found["origin"] == expected
    assert found["run_id"] not in dualtaxi(folder, "show", origin.run_id).output  # it is no branch
    assert "branch" not in dualtaxi(folder, "show", found["run_id"]).output
    run = find_run(found["run_id"], folder)
    assert run.name == "pole.evaluated"
    assert verify(run.recording).finding == ""
    with runner.open_recording(run.recording) as recording:
        assert [int(reset["seed"]) for reset in recording.eval.reset_values()] == [7, 8, 9]
        assert recording.config["config"] == {"origin": expected, "policy": "agent_of_test:policy"}
    again = play_checkpoint(origin, checkpoint, "agent_of_test:policy", folder, 3, 7)
    assert again.summary.content_digest == run.summary.content_digest
    assert dualtaxi(folder, "evaluate", origin.run_id, *words[:1], "@0", *words[2:]).exit_code == 0


def test_values_along_an_episode_are_those_of_its_observations(folder):
    run = find_run("pole", folder)
    words = ["--episode", "2", "--checkpoint", "@latest", "--policy", "agent_of_test:values"]
    shown = json.loads(dualtaxi(folder, "values", run.run_id, *words, "--json").stdout)["steps"]
    with runner.open_recording(run.recording) as recording:
        steps = recording.train.episode_steps(2)
        first = [r["observation"] for r in recording.train.reset_values() if r["episode"] == 2]
        observed = np.concatenate([first, steps["next_observation"][:-1]])
        q = np.stack([observation @ BALANCING for observation in observed])
        along = values_along(recording, "train", 2, run.checkpoints()[-1], "agent_of_test:values")
    assert [[step["q[0]"], step["q[1]"]] for step in shown] == q.tolist()
    assert [step["best"] for step in shown] == q.max(axis=1).tolist()
    assert [step["action"] for step in shown] == steps["action"].tolist()
    np.testing.assert_array_equal(along.values["q"], q)
    done = dualtaxi(folder, "values", run.run_id, *words, "-o", "values.csv")
    assert done.exit_code == 0, done.output
    with Path("values.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["best"]) for row in rows] == q.max(axis=1).tolist()
    assert "best" in dualtaxi(folder, "values", run.run_id, *words).output


def test_observations_come_nested_as_their_space(folder):
    run = find_run("rooms", folder)
    with runner.open_recording(run.recording) as recording:
        (checkpoint,) = run.checkpoints()
        along = values_along(recording, "train", 1, checkpoint, "agent_of_test:of_rooms")
        assert along.values["value"].shape == (len(recording.train.episode_steps(1)), 2)
        along = values_along(recording, "train", 1, checkpoint, "agent_of_test:number")
        assert set(along.values["value"].tolist()) == {4.0}


@pytest.mark.parametrize(
    ("policy", "kind", "message"),
    [
        ("agent_of_test", ConfigError, "expected module:function"),
        ("agent_of_test:missing", ConfigError, "cannot be imported"),
        ("no_such_module:policy", ConfigError, "cannot be imported"),
        ("agent_of_test:not_a_function", ConfigError, "expected a function"),
        ("agent_of_test:failing", RunnerError, r"agent_of_test.py:\d+: ZeroDivisionError"),
        ("agent_of_test:ragged", ConfigError, "different shapes"),
        ("agent_of_test:wordy", ConfigError, "found <U4 of shape"),
    ],
)
def test_a_policy_that_does_not_work_is_named(folder, policy, kind, message):
    run = find_run("pole", folder)
    with runner.open_recording(run.recording) as recording, pytest.raises(kind, match=message):
        values_along(recording, "train", 0, run.checkpoints()[0], policy)


def test_what_cannot_be_evaluated_says_why(folder):
    class Hidden(Rooms):
        """Has no name by which it could be imported."""

    with runner.record(Hidden(), folder / "hidden") as rec:
        rec.checkpoint("policy", {"w": BALANCING})
    hidden, pole = rec.run, find_run("pole", folder)
    with pytest.raises(CannotRedo, match="cannot be imported"):
        play_checkpoint(hidden, hidden.checkpoints()[0], "agent_of_test:policy", folder, 1)
    before = len(runner.list_runs(folder))
    with pytest.raises(RunnerError, match="ZeroDivisionError"):
        play_checkpoint(pole, pole.checkpoints()[0], "agent_of_test:failing", folder, 1)
    assert runner.list_runs(folder)[0].status == "failed"
    assert len(runner.list_runs(folder)) == before + 1
    done = dualtaxi(folder, "evaluate", pole.run_id)
    assert done.exit_code == 2
    assert "--checkpoint" in done.output
    words = ["--checkpoint", "@0", "--policy", "agent_of_test:policy", "--step", "5"]
    assert "--step and --start are for" in dualtaxi(folder, "evaluate", pole.run_id, *words).output
    for words, message in (
        (["--episode", "0"], "found no --checkpoint, no --policy;"),
        (["--checkpoint", "@0", "--policy", "a:b"], "found no --episode or --eval;"),
        (["--episode", "0", "--eval", "0:0"], "--episode and --eval exclude each other"),
    ):
        done = dualtaxi(folder, "values", pole.run_id, *words)
        assert done.exit_code == 2
        assert message in done.output
    words = ["--episode", "9999", "--checkpoint", "@0", "--policy", "agent_of_test:values"]
    assert "no training episode 9,999" in dualtaxi(folder, "values", pole.run_id, *words).output


def test_a_vector_of_a_class_of_its_own_is_played_by_one_environment(tmp_path):
    envs = gymnasium.make_vec("CartPole-v1", 2, vectorization_mode="vector_entry_point")
    with runner.record_vector(envs, tmp_path) as rec:
        rec.checkpoint("policy", {"w": BALANCING})
    (checkpoint,) = rec.run.checkpoints()
    played = play_checkpoint(rec.run, checkpoint, "agent_of_test:policy", tmp_path, 2, 5)
    assert played.summary["last_evaluation"]["mean_return"] == 500
