"""Mistakes with the wrappers: a clear error, and no run left behind."""

from __future__ import annotations

import errno
import os
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.vector import SyncVectorEnv

import runner
from runner.config import from_mapping
from runner.errors import ConfigError, RunnerError, StorageError
from runner.execution.verify import verify
from runner.recording.reader import open_recording
from runner.recording.writer import RecordingFile
from runner.runs.run import list_runs
from tests.runner.loops.making import Rooms, make


def pole() -> gymnasium.Env[Any, Any]:
    return make("CartPole-v1")


def poles() -> SyncVectorEnv:
    return SyncVectorEnv([pole] * 2)


def game() -> Any:
    from dualtaxi.parallel import DualTaxiParallelEnv

    return DualTaxiParallelEnv()


class Named(Rooms):
    """A part whose name cannot be printed."""

    def __init__(self) -> None:
        super().__init__(with_text=True)
        self.observation_space = spaces.Dict({"a\nb": spaces.Text(3)})


@pytest.mark.parametrize(
    ("begin", "message"),
    [
        (lambda there: runner.record("CartPole-v1", there), "found str, expected a Gymnasium environment"),
        (lambda there: runner.record(poles(), there), "record_vector is for vector environments"),
        (lambda there: runner.record(game(), there), "record_parallel for PettingZoo's"),
        (lambda there: runner.record_vector(pole(), there), "expected a vector environment"),
        (lambda there: runner.record_parallel(pole(), there), "expected a PettingZoo ParallelEnv"),
        (lambda there: runner.record(pole(), there, phase="test"), "found 'test', expected one of train"),
        (lambda there: runner.record(pole(), there, name=3), "name: found 3, expected text"),
        (lambda there: runner.record(pole(), into=pole(), phase="eval"), "found TimeLimit, expected what"),
        (lambda there: runner.record(pole(), there, into=pole()), "found more arguments than phase"),
        (lambda there: runner.record(Named(), there), r"found a part called 'a\\nb'"),
    ],
)
def test_a_refused_environment_leaves_no_run(begin, message, tmp_path):
    with pytest.raises(RunnerError, match=message):
        begin(tmp_path / "loops")
    assert not (tmp_path / "loops").exists()


@pytest.mark.parametrize(("part", "left"), [("_append", []), ("add_metadata", ["failed"])])
def test_a_recording_that_cannot_start_leaves_no_running_run(part, left, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(RecordingFile, part, full)
    with pytest.raises(StorageError, match="No space left on device"):
        runner.record(pole(), tmp_path)
    assert [run.status for run in list_runs(tmp_path)] == left


@pytest.mark.parametrize(
    ("do", "message"),
    [
        (lambda rec: rec.log("a", "\ud800"), "valid Unicode"),
        (lambda rec: rec.log("\ud800", 1), "valid Unicode"),
        (lambda rec: rec.log("", 1), "a name that is not empty"),
        (lambda rec: rec.log("a", 10**400), "a number that a float64 holds"),
        (lambda rec: rec.snapshot("a", [[1], [1, 2]]), "no array of numbers for 'a'"),
        (lambda rec: rec.snapshot("\ud800", [1.0]), "expected an array of numbers and a name"),
    ],
)
def test_a_refused_log_does_not_stop_the_loop(do, message, tmp_path):
    with runner.record(pole(), tmp_path) as rec:
        rec.reset(seed=1)
        with pytest.raises(RunnerError, match=message):
            do(rec)
        rec.step(0)
        rec.log("seed", np.float32(0.5))
    assert rec.run.summary["messages"]["/scalar"] == rec.run.summary["train_steps"] == 1


class Paid(gymnasium.Env[Any, Any]):
    """Rewards, observations and actions of unusual types, as in users' environments."""

    observation_space = spaces.Box(0, 255, (2,), np.uint8)
    action_space = spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, reward: Any, observation: Any = (1, 2)) -> None:
        self.reward, self.observation = reward, observation

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return np.zeros(2, np.uint8), {}

    def step(self, action: Any) -> Any:
        return self.observation, self.reward, False, False, {}


@pytest.mark.parametrize("reward", [1, 1.0, np.float32(1), np.array(1.0), np.array([1.0]), np.array([[1]])])
def test_a_reward_may_stand_in_an_array_of_one(reward, tmp_path):
    with runner.record(Paid(reward), tmp_path) as rec:
        rec.reset()
        rec.step(np.zeros(2, np.float32))
    with open_recording(rec.run.recording) as recording:
        assert next(recording.train.transitions())["rewards"] == 1


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (lambda: Paid(None), "found the reward None, expected a number"),
        (lambda: Paid(np.ones(2)), "found the reward"),
        (lambda: Paid(1.0, [300, 1]), "found an observation that is not of"),
    ],
)
def test_invalid_results_of_an_environment_are_refused(env, message, tmp_path):
    rec = runner.record(env(), tmp_path)
    rec.reset()
    with pytest.raises(RunnerError, match=message):
        rec.step(np.zeros(2, np.float32))
    rec.close()


def test_a_rounded_action_gives_one_warning(tmp_path):
    env = Paid(1.0)
    with runner.record(env, tmp_path) as rec:
        rec.reset()
        rec.step(np.zeros(2, np.float32))
        rec.step(np.array([0.5, 0.25]))
        with pytest.warns(RuntimeWarning, match="action comes as float64") as warned:
            rec.step(np.array([0.1, 0.2]))
        rec.step(np.array([0.3, 0.7]))
    assert len(warned) == 1
    assert warned[0].filename == __file__


def test_a_seed_of_numpy_is_a_number(tmp_path):
    runner.record(pole(), tmp_path, seed=np.int64(7), name="seven").close()
    assert runner.find_run("seven", tmp_path).facts["seed"] == 7


def test_a_forked_process_leaves_the_recording_alone(tmp_path):
    """A child that closes the environment leaves the parent's recording open."""
    with runner.record(pole(), tmp_path) as rec:
        rec.reset(seed=1)
        rec.step(0)
        child = os.fork()
        if not child:
            rec.close()
            os._exit(0)
        os.waitpid(child, 0)
        rec.step(1)
    assert rec.run.summary["train_steps"] == 2
    with open_recording(rec.run.recording) as recording:
        assert len(list(recording.train.transitions())) == 2


def test_a_second_environment_without_pictures_is_refused(tmp_path):
    blind = Rooms()
    blind.render_mode = None
    with (
        runner.record(Rooms(), tmp_path, frames_every=4) as rec,
        pytest.raises(RunnerError, match="frames_every: found an environment with render_mode=None"),
    ):
        runner.record(blind, into=rec, phase="eval")


@pytest.mark.parametrize(
    "picture",
    [None, np.ones((4, 4, 3)), np.zeros((4, 4), np.uint8), np.zeros((0, 4, 3), np.uint8)],
    ids=["nothing", "floats", "flat", "empty"],
)
def test_a_frame_that_is_not_a_picture_is_refused(tmp_path, monkeypatch, picture):
    monkeypatch.setattr(Rooms, "render", lambda _: picture)
    with (
        runner.record(Rooms(), tmp_path, frames_every=4) as rec,
        pytest.raises(RunnerError, match=r"expected uint8 of \[height, width, 3\]"),
    ):
        rec.reset(seed=0)


@pytest.mark.parametrize("value", [1.5, np.float32(1.5), np.array(1.5), np.array([[1.5]])], ids=repr)
def test_a_single_number_of_any_type_is_logged(tmp_path, value):
    with runner.record(pole(), tmp_path) as rec:
        rec.log("loss", value)
    with open_recording(rec.run.recording) as recording:
        (scalar,) = recording.table("/scalar").decoded()
    assert scalar["value"] == 1.5


@pytest.mark.parametrize("kind", ["itself", "surrogate"])
def test_settings_that_json_cannot_hold_leave_no_run(tmp_path, kind):
    settings: dict[str, Any] = {"text": "\ud800"} if kind == "surrogate" else {}
    if kind == "itself":
        settings["itself"] = settings
    with pytest.raises(RunnerError, match="config: found what JSON cannot hold"):
        runner.record(pole(), tmp_path, config=settings)
    assert not list(tmp_path.iterdir())


def test_settings_in_a_set_have_one_order_in_all_processes(tmp_path):
    with runner.record(pole(), tmp_path, config={"policies": {"shared", "first", "second"}}) as rec:
        rec.reset(seed=0)
    assert rec.run.file.config["config"] == {"policies": ["first", "second", "shared"]}


@pytest.mark.parametrize(
    "packing",
    [
        *({"level": level} for level in (-8, -7, 0, 1, 19, 20, None, "x")),
        *({"compression": name, "level": 3} for name in ("lz4", "none", "zstd")),
        *({"compression": name} for name in ("lz4", "none", "brotli")),
        *({"chunk_steps": steps} for steps in (255, 256, 65_536, 65_537)),
        *({"index": index} for index in ("message", "chunk", "none")),
    ],
    ids=str,
)
def test_packing_has_the_bounds_of_a_configuration(packing, tmp_path):
    def outcome(work):
        try:
            return work()
        except ConfigError as error:
            return str(error).rpartition("recording.")[2].splitlines()[0]

    def record():
        with runner.record(make("CartPole-v1"), tmp_path, **packing) as env:
            env.reset(seed=0)
        with open_recording(env.run.recording) as recording:
            return recording.config["recording"]

    config = {"episodes": 1, "recording": packing}
    expected = outcome(lambda: from_mapping(config).to_mapping()["recording"])
    assert outcome(record) == expected


@pytest.mark.parametrize(
    ("record", "make_env"),
    [
        (runner.record, pole),
        (runner.record, lambda: Rooms(with_text=True)),
        (runner.record_vector, poles),
        (runner.record_parallel, game),
    ],
)
def test_a_phase_needs_a_reset(tmp_path, record, make_env):
    with record(make_env(), tmp_path) as rec:
        if record is runner.record_parallel:
            action = {agent: rec.action_space(agent).sample() for agent in rec.possible_agents}
        else:
            action = rec.action_space.sample()
        rec.reset(seed=1)
        rec.step(action)
        with rec.phase("eval"):
            with pytest.raises(ResetNeeded, match="'eval'"):
                rec.step(action)
            rec.reset(seed=2)
            rec.step(action)
    assert verify(rec.run.recording).sound


def test_an_episode_that_ends_in_another_phase_leaves_a_sound_recording(tmp_path):
    envs = SyncVectorEnv([lambda: gymnasium.make("CartPole-v1", max_episode_steps=5)] * 2)
    action = np.zeros(2, np.int64)
    with runner.record_vector(envs, tmp_path) as rec:
        rec.reset(seed=1)
        for _ in range(3):
            rec.step(action)
        with rec.phase("eval"):
            rec.reset(seed=2)
            for _ in range(5):
                rec.step(action)  # with the last, both episodes are over
        for _ in range(3):
            rec.step(action)
    assert verify(rec.run.recording).sound


class Losing(gymnasium.Env[Any, Any]):
    """Its second reset returns what is no observation."""

    def __init__(self, space: spaces.Space[Any]) -> None:
        self.observation_space, self.action_space = space, spaces.Discrete(2)
        self._resets = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self._resets += 1
        return None if self._resets == 2 else self.observation_space.sample(), {}

    def step(self, action: Any) -> Any:
        return self.observation_space.sample(), 1.0, False, False, {}


@pytest.mark.parametrize("space", [spaces.Discrete(4), spaces.Box(0, 1, (2,)), spaces.Text(5)])
def test_what_follows_a_reset_that_failed_is_recorded_consistently(space, tmp_path):
    env = runner.record(Losing(space), tmp_path)
    env.reset(seed=1)
    env.step(0)
    with pytest.raises(RunnerError, match="found"):
        env.reset()
    env.step(1)
    env.reset()
    env.step(0)
    env.close()
    assert verify(env.run.recording).finding == ""
