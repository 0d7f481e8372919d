"""Exactness of recorded values: what is rounded gives a warning, what does not fit is refused."""

from __future__ import annotations

import json
import math
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv

import runner
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.integrity import check_integrity
from runner.recording.reader import open_recording
from runner.util.jsonable import packed, unpacked
from tests.runner.loops.making import make


class Sensor(gymnasium.Env[Any, Any]):
    """An environment with given observations and infos."""

    observation_space: spaces.Space[Any] = spaces.Box(-1, 1, (2,), np.float32)
    action_space = spaces.Discrete(2)

    def __init__(self, observation: Any = (0.0, 0.0)) -> None:
        self.observation, self.info = observation, {}

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return np.zeros(2, np.float32), {}

    def step(self, action: Any) -> Any:
        return self.observation, 0.0, False, False, self.info


def steps_of(run: Any) -> Any:
    with open_recording(run.recording) as recording:
        return recording.train.steps.array()


def test_a_rounded_observation_gives_one_warning(tmp_path):
    env = Sensor(np.zeros(2, np.float32))
    with runner.record(env, tmp_path) as rec:
        rec.reset()
        for _ in range(5):
            rec.step(0)
        env.observation = np.array([0.5, 0.25])
        rec.step(0)
        env.observation = np.array([0.1, 0.2])
        with pytest.warns(RuntimeWarning, match="observation comes as float64") as warned:
            list(map(rec.step, [0, 0]))
    assert len(warned) == 1
    assert warned[0].filename == __file__


@pytest.mark.parametrize("observation", [0.5, np.float32(0.5), np.zeros((1, 2), np.float32), [1, 2, 3]])
def test_an_observation_of_another_shape_is_refused(tmp_path, observation):
    env = Sensor(np.zeros(2, np.float32))
    with runner.record(env, tmp_path) as rec:
        rec.reset()
        rec.step(0)
        env.observation = observation
        with pytest.raises(RecordingError, match=r"found observation of shape .*, expected \(2,\)"):
            rec.step(0)


NAN = np.array([0x7FA00001], np.uint32).view(np.float32)[0]
"""A signaling NaN with a payload, which a conversion to another float would change."""


@pytest.mark.parametrize("value", [NAN, np.array(NAN), np.float32(-0.0)])
def test_a_single_number_keeps_every_bit(tmp_path, value, monkeypatch):
    env = Sensor(value)
    env.observation_space = env.action_space = spaces.Box(-1, 1, (), np.float32)
    monkeypatch.setattr(env, "reset", lambda **_: (value, {}))
    with runner.record(env, tmp_path) as rec:
        rec.reset()
        rec.step(value)
    step = steps_of(rec.run)[0]
    assert step["action"].tobytes() == step["next_observation"].tobytes() == np.float32(value).tobytes()


@pytest.mark.parametrize("observation", [np.zeros(2, np.float32), [0.0, 0.0]])
def test_bytes_are_no_action_though_actions_are_kept_as_bytes(tmp_path, observation):
    env = Sensor(observation)
    env.action_space = spaces.Box(-1, 1, (2,), np.float32)
    with runner.record(env, tmp_path) as rec:
        rec.reset()
        for action in (bytes(8), np.ones(2, np.float32), bytes(8), np.bytes_(b"ab")):
            if isinstance(action, bytes):
                with pytest.raises(RecordingError, match=r"not of the environment's action space"):
                    rec.step(action)
            else:
                rec.step(action)
        rec.step(bytearray(b"\0\1"))  # an array of numbers
    assert steps_of(rec.run)["action"].tolist() == [[1.0, 1.0], [0.0, 1.0]]


def pendulum_actions(n: int) -> list[Any]:
    return list(np.random.default_rng(0).uniform(-2, 2, (n, 1)))


@pytest.mark.parametrize("frames", [0, 10])
def test_float64_actions_of_a_float32_space_are_recorded_exactly(tmp_path, frames):
    env = gymnasium.make("Pendulum-v1")
    actions = pendulum_actions(300)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with runner.record(env, tmp_path, config={"frames": frames}) as rec:
            rec.reset(seed=1)
            with rec.phase("eval"):
                rec.reset(seed=2)
            rec.log("before", 1.0)
            for action in actions:
                rec.step(action)
    assert np.array_equal(steps_of(rec.run)["action"], np.array(actions))
    check_integrity(rec.run.recording)


def test_float32_actions_are_recorded_as_before(tmp_path):
    with runner.record(gymnasium.make("Pendulum-v1"), tmp_path) as rec:
        rec.reset(seed=1)
        rec.step(np.array([0.1], np.float32))
    assert steps_of(rec.run)["action"].dtype == np.float32


def test_float64_actions_of_a_vector_are_recorded_exactly(tmp_path):
    envs = SyncVectorEnv([lambda: gymnasium.make("Pendulum-v1")] * 3)
    actions = np.random.default_rng(0).uniform(-2, 2, (20, 3, 1))
    with runner.record_vector(envs, tmp_path) as rec:
        rec.reset(seed=1)
        for action in actions:
            rec.step(action)
    assert np.array_equal(steps_of(rec.run)["action"].reshape(actions.shape), actions)
    check_integrity(rec.run.recording)


def test_a_recording_without_steps_is_complete(tmp_path):
    with runner.record(gymnasium.make("Pendulum-v1"), tmp_path) as rec:
        rec.reset(seed=1)
    check_integrity(rec.run.recording)
    assert rec.run.summary["messages"] == {"/train/reset": 1}


def infos(run: Any) -> list[Any]:
    with open_recording(run.recording) as recording:
        return [json.loads(one["json"]) for one in recording.train.infos.decoded()]


def test_all_fields_of_info_are_recorded_by_a_star(tmp_path):
    env = Sensor(np.zeros(2, np.float32))
    env.info = {"a": 1, "b": [np.float32(0.5)]}
    with runner.record(env, tmp_path, info=["*"]) as rec:
        rec.reset()
        rec.step(0)
    assert infos(rec.run) == [{"a": 1, "b": [0.5]}]


@pytest.mark.parametrize(
    "array",
    [
        np.random.default_rng(0).integers(0, 256, (84, 84, 4), dtype=np.uint8),
        np.array([-0.0, np.nan, np.inf, 5e-324] * 20),
        np.arange(100, dtype=">i4").reshape(4, 25)[:, ::-1],
        np.arange(100) % 3 == 0,
    ],
    ids=["picture", "floats", "views", "flags"],
)
def test_large_arrays_in_an_info_come_back_exactly(tmp_path, array):
    env = Sensor(np.zeros(2, np.float32))
    env.info = {"array": array, "inside": {"agent": [array]}, "small": np.arange(3)}
    with runner.record(env, tmp_path, info=["*"]) as rec:
        rec.reset()
        rec.step(0)
    (info,) = infos(rec.run)
    assert info["small"] == [0, 1, 2]
    for back in (unpacked(info)["array"], unpacked(info)["inside"]["agent"][0]):
        assert (back.dtype, back.shape) == (array.dtype, array.shape)
        assert back.tobytes() == array.tobytes()


@pytest.mark.parametrize(
    "part", [{"dtype": "O"}, {"shape": [9, 9]}, {"base64": "?"}, {"dtype": 3}, {"shape": "x"}]
)
def test_what_only_looks_like_a_packed_array_is_refused(part):
    with pytest.raises(ValueError, match=r"."):
        unpacked({"a": [packed(np.arange(100.0)) | part]})


def endless() -> Any:
    value: dict[str, Any] = {}
    value["self"] = [value, value]
    return value


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        ("x" * 80_000_000, "takes more than"),
        (np.zeros(10_000_000), "takes more than"),
        (endless(), "contains itself"),
        (10**5000, "integer string conversion"),
    ],
    ids=["text", "array", "cyclic", "integer"],
)
def test_an_info_that_cannot_be_recorded_is_replaced_by_the_reason(tmp_path, value, reason):
    env = Sensor(np.zeros(2, np.float32))
    env.info = {"large": value, "small": 1}
    with runner.record(env, tmp_path, info=["*"]) as rec:
        rec.reset()
        with pytest.warns(
            RuntimeWarning, match=rf"info\['large'\] is not recorded where .*{reason}"
        ) as warned:
            list(map(rec.step, [0, 0]))
    assert len(warned) == 1
    check_integrity(rec.run.recording)
    assert [info["small"] for info in infos(rec.run)] == [1, 1]
    assert reason in infos(rec.run)[0]["large"]


def test_reset_gets_only_the_arguments_of_the_loop(tmp_path):
    class Old(Sensor):
        def reset(self, seed=None):  # type: ignore[no-untyped-def,override]
            return np.zeros(2, np.float32), {}

    with runner.record(Old(np.zeros(2, np.float32)), tmp_path) as rec:
        rec.reset(seed=3)
        rec.reset()


def test_a_log_of_zeros_is_encoded_as_protobuf_does(tmp_path):
    values = [0.0, -0.0, 1.5, float("nan"), -2.0]
    with runner.record(make("FrozenLake-v1"), tmp_path) as rec:
        rec.reset(seed=1)
        for value in values:
            rec.log("x", value)
        rec.step(0)
        rec.log("x", 3)
    with open_recording(rec.run.recording) as recording:
        found = list(recording.table(schema.SCALAR_TOPIC).decoded())
    assert np.array_equal([one["value"] for one in found], [*values, 3.0], equal_nan=True)
    assert [one["step"] for one in found] == [0, 0, 0, 0, 0, 1]


def test_numbers_of_ten_thousand_names_are_recorded_in_order(tmp_path):
    with runner.record(Sensor(), tmp_path) as rec:
        rec.reset()
        for value in (1.5, 2.5):
            for k in range(10_000):
                rec.log(f"weight/{k}", value * k)
            rec.step(0)
    with open_recording(rec.run.recording) as recording:
        found = [
            (one["name"], one["value"], one["step"]) for one in recording.table(schema.SCALAR_TOPIC).decoded()
        ]
    expected = [
        (f"weight/{k}", value * k, step) for step, value in enumerate((1.5, 2.5)) for k in range(10_000)
    ]
    assert found == expected
    assert rec.run.summary["logged"]["weight/7"] == 17.5


def test_a_scalar_is_encoded_as_protobuf_does():
    from runner.recording.messages import encode, scalar_encoder

    quick = scalar_encoder("loss/π", "eval")
    for value in (0.0, -0.0, 1e-300, -5.0):
        for step in (0, 1, 2**40):
            for episode in (0, 7):
                fields = {"name": "loss/π", "value": value, "phase": "eval", "step": step, "episode": episode}
                assert quick(value, step, episode) == encode(schema.SCALAR, fields)


def test_many_scalars_are_decoded_as_one_by_one():
    from runner.recording.messages import decode, decode_scalars, encode

    numbers = [0.0, -0.0, math.nan, math.inf, 1e-300, -5.0]
    messages = [
        {"name": name, "value": value, "phase": phase, "step": step, "episode": episode}
        for step in (0, 1, -1, 2**40)
        for episode in (0, 7)
        for name in ("", "loss/π", "b" * 200, *(f"w{k:02}" for k in range(20)))
        for phase in ("eval", "train", "")
        for value in numbers
    ]
    payloads = [encode(schema.SCALAR, message) for message in messages]
    payloads += [payloads[-1][-9:] + payloads[-1][:-9], b"", b"\x32\x01x" + payloads[0]]  # of other writers
    times = [2**64 - 1 - k for k in range(len(payloads))]
    series, rows = decode_scalars(list(zip(times, payloads, strict=True)))
    expected = [decode(schema.SCALAR, payload) for payload in payloads]
    assert series == list(dict.fromkeys((one["name"], one["phase"]) for one in expected))
    assert [series[k] for k in rows["series"].tolist()] == [(one["name"], one["phase"]) for one in expected]
    for name in ("step", "episode"):
        assert rows[name].tolist() == [one[name] for one in expected]
    assert rows["value"].tobytes() == np.array([one["value"] for one in expected]).tobytes()
    assert rows["log_time"].tolist() == times
