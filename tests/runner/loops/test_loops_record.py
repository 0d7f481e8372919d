"""Recording a loop over a Gymnasium environment: it is not changed, and recorded completely."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import textwrap
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import NormalizeReward, RecordEpisodeStatistics
from matplotlib.figure import Figure

import runner
from runner.errors import ConfigError, EnvironmentNotUsable, RecordingError, RunnerError
from runner.loops.media import Histogram, Image
from runner.recording import schema
from runner.recording.integrity import check_integrity
from runner.recording.reader import open_recording
from runner.runs.resolve import find_run
from runner.runs.run import list_runs
from tests.runner.loops.making import NAMES, Rooms, make, play, recorded

STEPS = 700


def same(left: Any, right: Any) -> bool:
    """Return whether two values of a space are equal."""
    if isinstance(left, dict):
        return left.keys() == right.keys() and all(same(left[key], right[key]) for key in left)
    if isinstance(left, tuple):
        return len(left) == len(right) and all(map(same, left, right))
    return type(left) is type(right) and bool(np.array_equal(left, right))


@pytest.fixture(scope="session", params=NAMES)
def loop(request, tmp_path_factory):
    """Return the environment, its recording, and the values that the loop got."""
    name = request.param
    return name, *recorded(tmp_path_factory.mktemp("loops"), name, STEPS, chunk_steps=256)


def test_recording_changes_nothing_for_the_loop(loop):
    name, _, seen = loop
    alone = list(play(make(name), STEPS))
    assert len(seen) == len(alone)
    assert all(same(left, right) for left, right in zip(seen, alone, strict=True))


def test_the_bytes_of_the_recording_are_those_of_protobuf(loop):
    check_integrity(loop[1])


def flat(value: Any) -> list[Any]:
    """Return the leaves of a value of the loop or of the recording."""
    if isinstance(value, dict):
        return [leaf for part in value.values() for leaf in flat(part)]
    if isinstance(value, np.void):
        return [leaf for name in value.dtype.names for leaf in flat(value[name])]
    if isinstance(value, tuple):
        return [leaf for part in value for leaf in flat(part)]
    return [value]


def agree(found: Any, expected: Any) -> bool:
    left, right = flat(found), flat(expected)
    return len(left) == len(right) and all(map(np.array_equal, left, right))


def test_steps_have_the_values_of_the_loop(loop):
    _, path, seen = loop
    steps = [entry for entry in seen if entry[0] == "step"]
    with open_recording(path) as recording:
        found = list(recording.train.transitions())
        after = "next_state" if recording.has_states else "next_observation"
    assert len(found) == len(steps) == STEPS
    for one, (_, action, observation, reward, terminated, truncated, _) in zip(found, steps, strict=True):
        assert agree(one["action"], action)
        assert agree(one[after], observation)
        assert (one["rewards"].tolist(), bool(one["terminated"])) == ([reward], terminated)
        assert bool(one["truncated"]) == truncated


def test_resets_have_seed_and_observation(loop):
    _, path, seen = loop
    resets = [entry for entry in seen if entry[0] == "reset"]
    with open_recording(path) as recording:
        found = list(recording.train.reset_values())
    assert len(found) == len(resets) >= 1
    assert [bool(one["seeded"]) for one in found] == [True] + [False] * (len(resets) - 1)
    assert found[0]["seed"] == 5
    assert all(agree(one["observation"], entry[2]) for one, entry in zip(found, resets, strict=True))


def test_steps_and_episodes_are_numbered_as_they_come(loop):
    _, path, seen = loop
    episodes, t, lengths, returns, total = [], [], [], [], 0.0
    for entry in seen:
        if entry[0] == "reset":
            length = 0
            continue
        episodes.append(len(lengths))
        t.append(length)
        length += 1
        total += entry[3]
        if entry[4] or entry[5]:
            lengths.append(length)
            returns.append(total)
            total = 0.0
    with open_recording(path) as recording:
        found = list(recording.train.transitions())
        ended = recording.train.episodes.array()
        first = list(recording.train.reset_values())
    assert [int(one["step"]) for one in found] == list(range(STEPS))
    assert [int(one["episode"]) for one in found] == episodes
    assert [int(one["t"]) for one in found] == t
    assert ended["length"].tolist() == lengths
    assert ended["returns"][:, 0].tolist() == returns
    assert [int(one["episode"]) for one in first] == list(range(len(first)))
    assert all(int(one["step"]) == episodes.index(int(one["episode"])) for one in first[:-1])


def test_times_follow_the_steps(loop):
    with open_recording(loop[1]) as recording:
        times = [int(one["log_time"]) for one in recording.train.transitions()]
    assert times == [schema.STEP_NANOSECONDS * (k + 1) for k in range(STEPS)]


def test_a_tabular_environment_is_attached_and_its_events_are_counted(tmp_path):
    path, seen = recorded(tmp_path, "CliffWalking-v1", 400)
    falls = sum(entry[3] == -100 for entry in seen if entry[0] == "step")
    with open_recording(path) as recording:
        assert recording.mdp.states == 48
        state, action = 36, 1
        ends = recording.train.episodes.array()
        steps = next(recording.train.steps.blocks())
        assert (recording.mdp.next_state[state, action] == 36).any()
    assert steps["state"][1:].tolist() == [
        int(b) if not over else int(s)
        for b, over, s in zip(
            steps["next_state"][:-1],
            (steps["terminated"] | steps["truncated"])[:-1],
            steps["state"][1:],
            strict=True,
        )
    ]
    assert falls > 0
    assert int(ends["penalties"].sum()) <= falls


def test_scalars_texts_and_arrays_are_recorded_with_their_step(tmp_path):
    q = np.arange(6, dtype=np.float32).reshape(2, 3)
    with runner.record(make("FrozenLake-v1"), tmp_path) as env:
        for k, entry in enumerate(play(env, 50)):
            if entry[0] == "step":
                env.log("loss", 1 / (k + 1))
        env.log("note", "half way")
        env.snapshot("q", q)
    with open_recording(env.run.recording) as recording:
        scalars = list(recording.table(schema.SCALAR_TOPIC).decoded())
        (text,) = recording.table(schema.LOG_TOPIC).decoded()
        (array,) = recording.arrays()
    assert [one["step"] for one in scalars] == list(range(1, 51))
    assert {one["name"] for one in scalars} == {"loss"}
    assert (text["name"], text["message"]) == ("note", "half way")
    assert (array.name, array.step, array.values.dtype) == ("q", 50, np.float32)
    assert np.array_equal(array.values, q)


def test_phases_have_steps_and_episodes_of_their_own(tmp_path):
    with runner.record(make("FrozenLake-v1"), tmp_path) as env:
        for _ in range(3):
            list(play(env, 40))
            with env.phase("eval"):
                list(play(env, 30))
    with open_recording(env.run.recording) as recording:
        trained, evaluated = (
            recording.table(topic).array() for topic in (schema.TRAIN_STEP, schema.EVAL_STEP)
        )
        assert recording.result["train_steps"] == 120
        assert recording.result["eval_steps"] == 90
    times = np.sort(np.concatenate([trained["log_time"], evaluated["log_time"]]))
    assert times.tolist() == [schema.STEP_NANOSECONDS * (k + 1) for k in range(210)]
    assert (trained["log_time"][40] - trained["log_time"][39]) == 31 * schema.STEP_NANOSECONDS


def test_a_second_environment_is_recorded_into_the_same_run(tmp_path):
    with runner.record(make("FrozenLake-v1"), tmp_path) as env:
        other = runner.record(make("FrozenLake-v1"), into=env, phase="eval")
        for _ in zip(play(env, 40), play(other, 40), strict=False):
            pass
        other.close()
        list(play(env, 40))  # the recording is the first environment's to close
    with open_recording(env.run.recording) as recording:
        assert recording.eval.steps.count() > 20
        assert recording.train.steps.count() > 60
    with pytest.raises(ConfigError, match="other spaces"):
        runner.record(make("Taxi-v4"), into=env, phase="eval")


def test_chosen_fields_of_info_are_recorded_where_they_occur(tmp_path):
    options = {"level": 3}
    with runner.record(Rooms(), tmp_path, info=["luck", "first", "never"]) as env:
        env.reset(seed=1, options=options)
        for _ in range(6):
            env.step(env.action_space.sample())
    with open_recording(env.run.recording) as recording:
        infos = list(recording.train.infos.decoded())
        (given,) = recording.train.reset_options()
    records = [(one["step"], one["reset"], json.loads(one["json"])) for one in infos]
    assert records[0] == (0, True, {"first": True})
    assert records[1:] == [(step, False, {"luck": 0.5}) for step in (0, 2, 4)]
    assert (given.reset, given.options, given.large_seed) == (0, options, None)


def test_a_reset_ends_an_episode_in_progress(tmp_path):
    with runner.record(make("CartPole-v1"), tmp_path) as env:
        for length in (3, 5):
            env.reset()
            for _ in range(length):
                env.step(0)
        env.reset()
        env.reset()
    with open_recording(env.run.recording) as recording:
        ended = recording.train.episodes.array()
        assert ended["length"].tolist() == [3, 5]
        assert not (ended["terminated"] | ended["truncated"]).any()
        assert [int(one["episode"]) for one in recording.train.reset_values()] == [0, 1, 2, 2]


def test_an_error_in_the_loop_is_in_the_complete_recording(tmp_path):
    def broken() -> None:
        with runner.record(make("CartPole-v1"), tmp_path) as env:
            env.reset(seed=0)
            env.step(0)
            raise ZeroDivisionError("by nothing")

    with pytest.raises(ZeroDivisionError):
        broken()
    (run,) = list_runs(tmp_path)
    check_integrity(run.recording)
    assert (run.status, run.summary["error"]) == ("failed", "ZeroDivisionError: by nothing")
    assert run.summary["train_steps"] == 1


@pytest.mark.parametrize(("code", "status"), [(None, "interrupted"), (0, "interrupted"), (3, "failed")])
def test_a_loop_that_exits_failed_only_with_an_error_code(tmp_path, code, status):
    def leave() -> None:
        with runner.record(make("CartPole-v1"), tmp_path) as env:
            env.reset(seed=0)
            sys.exit(code)

    with pytest.raises(SystemExit):
        leave()
    (run,) = list_runs(tmp_path)
    assert run.status == status


KILLED = """
import os, signal, sys, time, gymnasium, runner
env = runner.record(gymnasium.make("CartPole-v1"), sys.argv[1], chunk_steps=256)
env.reset(seed=0)
for k in range(3000):
    if any(env.step(k % 2)[2:4]):
        env.reset()
    env.log("k", k)
time.sleep(1.6)  # the loop does something else: what it did before is put on disk meanwhile
env.step(0)
{end}
"""


@pytest.mark.parametrize(
    ("end", "status"),
    [
        ("os.kill(os.getpid(), signal.SIGKILL)", "interrupted"),
        ("sys.exit(0)", "interrupted"),
        ("env.close()", "finished"),
    ],
)
def test_a_killed_loop_leaves_its_steps(tmp_path, end, status):
    script = textwrap.dedent(KILLED.format(end=end))
    subprocess.run([sys.executable, "-c", script, str(tmp_path)], timeout=60, check=False)
    (run,) = list_runs(tmp_path)
    assert run.status == status
    killed = "KILL" in end
    with open_recording(run.recording) as recording:
        steps = list(recording.train.transitions())
        assert len(steps) == (3000 if killed else 3001)
        assert [int(one["step"]) for one in steps] == list(range(len(steps)))
        assert sum(1 for _ in recording.table(schema.SCALAR_TOPIC).decoded()) == 3000
        assert recording.file.finished != killed
    if killed:
        from runner.recording.repair import repair

        assert repair(run.recording).lossless
    check_integrity(run.recording)


def test_invalid_calls_are_refused_with_valid_ones(tmp_path):
    class Odd(Rooms):
        def __init__(self) -> None:
            super().__init__()
            self.action_space = gymnasium.spaces.Box(-1, 1, (2,), np.longdouble)

    with pytest.raises(EnvironmentNotUsable, match=r"the action space: found Box.*at most 64 bits"):
        runner.record(Odd(), tmp_path)
    with pytest.raises(ConfigError, match="frames_every: found an environment"):
        runner.record(make("CartPole-v1"), tmp_path, frames_every=3)
    with pytest.raises(ConfigError, match="info: found 'lives'"):
        runner.record(make("CartPole-v1"), tmp_path, info="lives")
    with pytest.raises(ConfigError, match="argument 'frame_every'"):
        runner.record(make("CartPole-v1"), tmp_path, frame_every=3)
    assert list_runs(tmp_path) == []


def test_values_outside_of_their_space_are_refused(tmp_path):
    class Liar(gymnasium.Env[Any, Any]):
        observation_space = gymnasium.spaces.Box(0, 1, (3,), np.float32)
        action_space = gymnasium.spaces.Discrete(2)
        answer: Any = np.zeros(4, np.float32)

        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            return self.answer, {}

    env = runner.record(Liar(), tmp_path)
    with pytest.raises(RecordingError, match=r"shape \(4,\), expected \(3,\)"):
        env.reset()
    env.unwrapped.answer = np.full(3, 0.1)
    with pytest.warns(RuntimeWarning, match="comes as float64 and is recorded, rounded, as the float32"):
        env.reset()
    env.close()


def test_steps_need_a_reset_that_was_seen(tmp_path):
    env = make("FrozenLake-v1")
    env.reset()
    with runner.record(env, tmp_path) as recorded_env, pytest.raises(ResetNeeded):
        recorded_env.step(0)


def test_nothing_is_recorded_after_the_end(tmp_path):
    env = runner.record(make("FrozenLake-v1"), tmp_path)
    env.close()
    env.close()
    with pytest.raises(RunnerError, match="is closed"):
        env.reset()
    with pytest.raises(RunnerError, match="is closed"):
        env.log("x", 1)


def test_a_run_names_its_origin(tmp_path):
    env = make("FrozenLake-v1")
    with runner.record(env, tmp_path, name="mine", seed=4, config={"lr": 0.1, "net": [8, 8]}) as rec:
        list(play(rec, 5))
    run = find_run("mine", tmp_path)
    config = run.facts["config"]
    assert config["made_by"] == "runner.record"
    assert config["config"] == {"lr": 0.1, "net": [8, 8]}
    assert config["env"]["id"] == "FrozenLake-v1"
    assert (run.seed, run.status) == (4, "finished")
    with open_recording(run.recording) as recording:
        assert recording.config == config
        assert recording.spaces["action"] == {
            "type": "Discrete",
            "dtype": "<i8",
            "shape": [],
            "n": 4,
            "start": 0,
        }


def test_equal_loops_have_equal_digests(tmp_path):
    runs = []
    for chunk_steps in (256, 1024):
        with runner.record(make("CartPole-v1"), tmp_path, chunk_steps=chunk_steps) as env:
            list(play(env, 1500))
        runs.append(env.run)
    assert runs[0].summary["content_digest"] == runs[1].summary["content_digest"]


def test_forked_children_and_pids_do_not_matter(tmp_path):
    """A child that exits does not end its parent's recording."""
    with runner.record(make("FrozenLake-v1"), tmp_path) as env:
        list(play(env, 20))
        child = os.fork() if hasattr(os, "fork") else None
        if child == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        if child:
            os.waitpid(child, 0)
        list(play(env, 20))
    check_integrity(env.run.recording)


@pytest.mark.parametrize("mode", ["alone", "next_step", "same_step"])
def test_returns_before_a_wrapper_changed_the_rewards_are_logged(tmp_path, mode):
    def make_env():
        return NormalizeReward(RecordEpisodeStatistics(gymnasium.make("Pendulum-v1", max_episode_steps=20)))

    returns = []
    if mode == "alone":
        with runner.record(make_env(), tmp_path) as env:
            env.action_space.seed(0)
            env.reset(seed=0)
            for _ in range(60):
                *_, truncated, info = env.step(env.action_space.sample())
                if truncated:
                    returns.append(float(info["episode"]["r"]))
                    env.reset()
    else:
        autoreset = AutoresetMode[mode.upper()]
        envs = SyncVectorEnv([make_env] * 2, autoreset_mode=autoreset)
        with runner.record_vector(envs, tmp_path) as env:
            env.action_space.seed(0)
            env.reset(seed=0)
            for _ in range(60):
                *_, truncated, infos = env.step(env.action_space.sample())
                if truncated.any():
                    statistics = infos.get("final_info", infos)["episode"]
                    returns.append(float(np.mean(statistics["r"])))
    with open_recording(env.run.recording) as recording:
        logged = [(each["name"], each["value"]) for each in recording.table(schema.SCALAR_TOPIC).decoded()]
    assert len(returns) > 1
    assert logged == [("return before NormalizeReward", value) for value in returns]


def test_arrays_pictures_and_histograms_are_logged_as_such(tmp_path):
    figure = Figure(figsize=(1, 1), dpi=50)
    with runner.record(gymnasium.make("CartPole-v1"), tmp_path) as rec:
        rec.reset(seed=1)
        rec.step(0)
        rec.log({"q": np.arange(3.0), "counts": [1, 2], "one": [0.5], "nested": {"figure": figure}})
        rec.log("view", Image(np.zeros((4, 6, 3), np.uint8)))
        rec.log("weights", Histogram(np.arange(128.0)))
        with pytest.raises(ConfigError, match="an array of numbers or a picture"):
            rec.log("thing", object())
        with pytest.raises(ConfigError, match="found 1 arrays, expected counts and edges"):
            rec.log("thing", Histogram(np_histogram=([1],)))
    with runner.open_recording(rec.run.recording) as recording:
        arrays = {each.name: (each.step, each.values.tolist()) for each in recording.arrays()}
        pictures = [each["frame_id"] for each in recording.table("/image").decoded()]
    assert (arrays["q"], arrays["counts"]) == ((1, [0, 1, 2]), (1, [1, 2]))
    assert sum(arrays["weights/counts"][1]) == 128
    assert pictures == ["nested/figure", "view"]
    assert rec.run.summary["logged"] == {"one": 0.5}


def test_secrets_among_the_settings_are_not_recorded(tmp_path):
    settings = {
        "api_key": "sk-not-long",
        "db": {"password": "hunter2", "url": "postgres://user:hunter2@host/db", "PASSWD": "hunter2"},
        "callbacks": [{"auth_token": "hunter2"}],
        "passwords": ["hunter2", "$hunter2", "%hunter2", "{hunter2"],
        "access_keys": {"production": "hunter2", "others": [{"staging": "hunter2"}], "pin": 86753090001},
        "password": 4711,
    }
    harmless = {
        "key_dim": 64,
        "max_tokens": 100_000,
        "tokenizer": "gpt2",
        "pad_token": "<pad>",
        "special_tokens": ["[PAD]", "<s>"],
        "hf_token": "${HF_TOKEN}",
        "monkey": "see",
        "keys": {"left": "a", "count": 1_000_000},
        "secret_key_bits": 4096,
        "cookies": {"enabled": True, "weight": 0.123456789, "none": None},
    }
    given = json.loads(json.dumps(settings | harmless))
    path, _ = recorded(tmp_path, "CartPole-v1", 3, config=given)
    assert given == settings | harmless
    assert b"hunter2" not in path.read_bytes()
    assert b"86753090001" not in path.read_bytes()
    assert "hunter2" not in path.with_name("run.json").read_text()
    with open_recording(path) as recording:
        kept = recording.config["config"]
    assert kept["api_key"] == kept["db"]["password"] == kept["callbacks"][0]["auth_token"] == "[redacted]"
    assert kept["passwords"] == ["[redacted]"] * 4
    assert kept["access_keys"]["others"] == [{"staging": "[redacted]"}]
    assert kept["access_keys"]["pin"] == kept["password"] == "[redacted]"
    assert kept["db"]["url"] == "postgres://[redacted]@host/db"
    assert {name: kept[name] for name in harmless} == harmless
