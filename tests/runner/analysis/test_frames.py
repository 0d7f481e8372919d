"""A run's measures as records and as pandas frames."""

import math
import sys

import gymnasium
import numpy as np
import pytest

import runner
from runner.analysis import frames
from runner.analysis.evaluations import evaluation_records
from runner.errors import MissingExtra, RecordingError
from tests.runner.loops.making import recorded

CONFIG = {
    "name": "framed",
    "mode": "competitive",
    "env": {"id": "dualtaxi:DualTaxi-v1", "kwargs": {"max_episode_steps": 40}},
    "algorithm": "random",
    "episodes": 30,
    "evaluation": {"every": 10, "trials": 50},
    "log": {"every_steps": 200, "window": 100},
}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return runner.run(CONFIG, recordings=tmp_path_factory.mktemp("framed"))


@pytest.fixture(scope="module")
def corridor_run(tmp_path_factory):
    """A run of an environment that declares no events, agents or success."""
    config = CONFIG | {"env": {"id": "tests.runner.corridor:Corridor-v0"}, "mode": "cooperative"}
    return runner.run(config, recordings=tmp_path_factory.mktemp("corridor"))


def test_evaluations(run):
    frame = frames.evaluations(run)
    assert frame["episode"].tolist() == [0, 10, 20, 30]
    assert frame["success_percent"].iloc[-1] == run.summary["last_evaluation"]["success_percent"]
    assert frame["mean_length"].iloc[-1] == run.summary["last_evaluation"]["mean_length"]
    assert {"taxi_1.drop_off", "collision", "mean_return.taxi_2", "training.percent_filled.taxi_1"} <= set(
        frame
    )
    assert math.isnan(frame["training.mean_length"].iloc[0])


def test_evaluations_are_what_their_trials_say(run):
    evaluations, trials = frames.evaluations(run), frames.episodes(run, "eval")
    grouped = trials.groupby(trials["episode"] // 50)
    assert grouped["length"].mean().tolist() == evaluations["mean_length"].tolist()
    assert grouped["collision"].sum().tolist() == evaluations["collision"].tolist()
    assert (100 * grouped["success"].mean()).tolist() == evaluations["success_percent"].tolist()
    assert evaluations["success_percent"].any()
    assert (
        evaluations["taxi_1.drop_off"].sum() + evaluations["taxi_2.drop_off"].sum() == trials["success"].sum()
    )


def test_training(run):
    frame = frames.training(run)
    assert frame["step"].tolist() == list(range(200, run.summary["train_steps"] + 1, 200))
    assert sum(part["steps"] for part in frame["reward_counts"].iloc[-1]) == 100
    assert frame["percent_filled.taxi_1"].eq(0).all()  # random actions learn nothing


def test_episodes_and_steps_agree(run):
    episodes, steps = frames.episodes(run), frames.steps(run)
    assert len(episodes) == 30
    assert len(steps) == run.summary["train_steps"] == episodes["length"].sum()
    returns = steps.groupby("episode")["reward.taxi_1"].sum()
    assert returns.tolist() == episodes["return.taxi_1"].tolist()
    assert steps["step"].tolist() == list(range(len(steps)))


def test_parts_are_read_alone(run):
    every = frames.steps(run, "eval")
    assert frames.steps(run, "eval", start=7, stop=19)["step"].tolist() == list(range(7, 19))
    assert frames.steps(run, "eval", episode=6).equals(every[every["episode"] == 6].reset_index(drop=True))
    assert frames.episodes(run, "train", 3, 5)["episode"].tolist() == [3, 4]
    with pytest.raises(RecordingError, match="no evaluation episode 200"):
        frames.steps(run, "eval", episode=200)


@pytest.mark.parametrize(
    ("name", "column", "part"),
    [("CartPole-v1", "next_observation", ()), ("Rooms", "next_observation.position", ("position",))],
)
def test_steps_have_arrays_in_their_cells_where_values_are_several_numbers(name, column, part, tmp_path):
    path, seen = recorded(tmp_path, name, 20)
    observations = [each[2] for each in seen if each[0] == "step"]
    expected = [observation[part[0]] if part else observation for observation in observations]
    frame = frames.steps(path)
    assert np.array_equal(np.stack(frame[column]), np.stack(expected))


def test_a_run_may_be_a_path_or_open(run):
    expected = frames.evaluations(run)
    assert frames.evaluations(run.recording).equals(expected)
    assert frames.evaluations(str(run.recording)).equals(expected)
    assert frames.evaluations(run.folder).equals(expected)
    with runner.open_recording(run.recording) as recording:
        assert frames.evaluations(recording).equals(expected)
        assert recording.file.finished  # and still open


def test_where_success_is_unknown(corridor_run):
    assert frames.evaluations(corridor_run)["success_percent"].isna().all()
    assert {"return.agent"} <= set(frames.episodes(corridor_run))
    with runner.open_recording(corridor_run.recording) as recording:
        (first, *_) = evaluation_records(recording)
    assert (first.value("success_percent"), first.successes, first.events) == (None, None, {})


def test_the_transition_table():
    frame = frames.transition_table()
    assert len(frame) == 221_184
    assert list(frame) == ["state", "action", "probability", "next_state", "reward", "is_over"]
    assert frame.groupby(["state", "action"])["probability"].sum().eq(1).all()
    own = frames.transition_table(rewards="individual")
    assert np.array_equal(own["reward"], own["reward.taxi_1"] + own["reward.taxi_2"])


def test_only_what_can_happen_is_in_the_table():
    frame = frames.transition_table("FrozenLake-v1", {"is_slippery": False})
    assert len(frame) == 16 * 4
    assert (frame["probability"] > 0).all()


def test_without_pandas_the_error_names_the_extra(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    for make in (frames.evaluations, frames.training, frames.episodes, frames.steps):
        with pytest.raises(MissingExtra, match=r"pip install .*\[frames\]"):
            make(run)
    with runner.open_recording(run.recording) as recording:
        assert len(evaluation_records(recording)) == 4


def test_logged_values_are_rows_in_their_order(tmp_path):
    with runner.record(gymnasium.make("CartPole-v1"), tmp_path, seed=1) as env:
        env.reset(seed=1)
        for number in range(3):
            env.step(0)
            env.log({"loss": 1 / (number + 1), "updates": number})
    frame = frames.logged(env.run)
    assert list(frame) == ["phase", "step", "episode", "name", "value"]
    wide = frame.pivot_table(index="step", columns="name", values="value")
    assert wide["loss"].to_dict() == {1: 1.0, 2: 1 / 2, 3: 1 / 3}


def test_a_job_logs_nothing(run):
    assert frames.logged(run).empty
