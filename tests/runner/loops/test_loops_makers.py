"""How an environment was made is recorded, with the reason where it cannot be made again."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces, wrappers
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import runner
from runner.analysis.episodes import EpisodeRef
from runner.cli.episode import ShownEpisode
from runner.environments.interfaces import name_of
from runner.errors import ConfigError, RecordingError
from runner.execution.verify import verify
from runner.export.pictures import describer
from runner.recording.maker import EnvironmentMaker, VectorMaker, parse_maker
from runner.recording.messages import ResetState, decode_reset_state
from runner.recording.metadata import json_object
from runner.recording.reader import open_recording
from runner.replay.environment import rerun
from tests.runner.loops.making import Leaving


class Doubled(gymnasium.RewardWrapper):
    """Takes the environment alone."""

    def reward(self, reward: Any) -> Any:
        return reward * 2


class Scaled(gymnasium.RewardWrapper):
    """Keeps its argument, as it is, in an attribute of another name."""

    def __init__(self, env: Any, by: float = 2.0) -> None:
        super().__init__(env)
        self.factor = by

    def reward(self, reward: Any) -> Any:
        return reward * self.factor


class Shifted(Scaled):
    """Does not record its argument, which has no default."""

    def __init__(self, env: Any, by: float) -> None:
        super().__init__(env, by)


class Rounded(Doubled):
    """Does not keep its argument as it is."""

    def __init__(self, env: Any, digits: int = 2) -> None:
        super().__init__(env)
        self.digits = max(digits, 1)


class Padded(gymnasium.RewardWrapper):
    """Keeps no argument."""

    def __init__(self, env: Any, by: float = 2.0) -> None:
        super().__init__(env)
        self.reward = lambda reward: reward + by


class Counted(Doubled):
    """Changes what it keeps of its arguments, all but the first."""

    def __init__(self, env: Any, seeds: Sequence[int] = (0,), index: int = 0) -> None:
        super().__init__(env)
        self.seeds = list(seeds)
        self.index = index

    def reset(self, **kwargs: Any) -> Any:
        self.index += 1
        return super().reset(**kwargs)


class Halved(wrappers.TransformReward):
    """Inherits from one that records its arguments, and has others."""

    def __init__(self, env: Any) -> None:
        super().__init__(env, lambda reward: reward / 2)


def make_pole() -> Any:
    return gymnasium.make("CartPole-v1")


def maker_of(rec: Any, phase: str = "train") -> EnvironmentMaker:
    rec.close()
    with open_recording(rec.run.recording) as recording:
        found = recording.phase(phase).maker_of()
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("wrap", "reason"),
    [
        (lambda env: wrappers.TransformReward(env, lambda reward: reward), "the argument func, of .*JSON"),
        (lambda env: Shifted(env, 1.0), "Shifted does not record its arguments"),
        (
            type("Local", (Doubled,), {"__qualname__": "f.<locals>.Local"}),
            "imported by name",
        ),
    ],
)
def test_the_reason_is_recorded_where_wrappers_cannot_be_made_again(wrap, reason, tmp_path):
    env = wrap(make_pole())
    maker = maker_of(runner.record(env, tmp_path))
    assert maker.spec == ""
    assert re.search(reason, maker.reason)
    assert 'make="module:function"' in maker.reason
    assert maker.wrappers[0].endswith(type(env).__qualname__)


@pytest.mark.parametrize(
    ("wrap", "is_assumed", "kwargs"),
    [
        (Doubled, False, {}),
        (Halved, False, {}),
        (Scaled, False, {"by": 2.0}),
        (lambda env: Scaled(env, 3), False, {"by": 3}),
        (lambda env: Rounded(env, 0), True, {"digits": 1}),
        (lambda env: Counted(env, seeds=(3, 4)), True, {"seeds": [3, 4], "index": 0}),
    ],
)
def test_the_arguments_of_wrappers_are_read_from_their_attributes(wrap, is_assumed, kwargs, tmp_path):
    env = wrap(make_pole())
    maker = maker_of(runner.record(env, tmp_path))
    assert not maker.reason
    name = type(env).__name__
    assert maker.assumed == ((f"{__name__}:{name}",) if is_assumed else ())
    spec = json.loads(maker.spec)
    wrapper = {"name": name, "entry_point": f"{type(env).__module__}:{name}", "kwargs": kwargs}
    assert spec["additional_wrappers"] == [wrapper]


class Walk(gymnasium.Env[Any, Any]):
    """An own class with arguments."""

    observation_space = spaces.Discrete(50)
    action_space = spaces.Discrete(2)

    def __init__(self, length: int, *, reward: float = 1.0) -> None:
        self._length = length
        self.reward = reward

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.place = 0
        return self.place, {}

    def step(self, action: Any) -> Any:
        self.place += int(action)
        return self.place, self.reward, self.place >= self._length, False, {}


def record_steps(env: Any, steps: int = 60) -> Any:
    """Return what records some random steps, closed."""
    env.action_space.seed(1)
    with env:
        env.reset(seed=1)
        for _ in range(steps):
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            if terminated or truncated:
                env.reset()
    return env


@pytest.mark.parametrize("wrap", [lambda env: env, lambda env: wrappers.TimeLimit(Scaled(env, 3), 5)])
def test_an_environment_of_an_own_class_is_made_with_its_arguments(wrap, tmp_path):
    rec = record_steps(runner.record(wrap(Walk(7, reward=0.5)), tmp_path))
    maker = maker_of(rec)
    assert (maker.reason, maker.assumed) == ("", ())
    assert json.loads(maker.spec)["kwargs"] == {"length": 7, "reward": 0.5}
    assert verify(rec.run.recording).verdict == "reproduced"
    copied = shutil.copy(rec.run.recording, tmp_path / "copied.mcap")
    assert verify(copied, trust=True).verdict == "reproduced"
    untrusted = verify(copied)
    assert untrusted.verdict == "consistent"
    assert "--trust" in untrusted.reason


def make_clipped(high: float = 0.5) -> Any:
    return Rounded(wrappers.ClipReward(make_pole().unwrapped, 0, high), 3)


@pytest.mark.parametrize(
    "entry_point", [make_clipped, partial(make_clipped), lambda high: make_clipped(high * 1)]
)
def test_wrappers_that_a_registered_function_adds_are_not_added_again(entry_point, tmp_path, monkeypatch):
    monkeypatch.setattr(gymnasium.envs.registration, "registry", gymnasium.registry.copy())
    monkeypatch.setattr(gymnasium, "registry", gymnasium.envs.registration.registry)
    gymnasium.register("Clipped-v0", entry_point=entry_point, max_episode_steps=9)
    env = Scaled(gymnasium.make("Clipped-v0", high=0.25), 3)
    rec = record_steps(runner.record(env, tmp_path))
    maker = maker_of(rec)
    assert (maker.reason, maker.assumed, maker.inner_wrappers) == ("", (), 2)
    assert [one["name"] for one in json.loads(maker.spec)["additional_wrappers"]] == ["Scaled"]
    with open_recording(rec.run.recording) as recording:
        assert not any(steps.difference for steps in rerun(recording, trust=True))
    bare = maker_of(record_steps(runner.record(gymnasium.make("Clipped-v0", high=1).unwrapped, tmp_path)))
    assert bare.assumed == (name_of(entry_point),)  # whether the wrappers were left out is not known


def test_no_reason_holds_an_address_of_memory(tmp_path):
    env = make_pole()
    env.unwrapped.spec = replace(env.unwrapped.spec, entry_point=lambda: None)
    assert re.search(
        r"test_no_.*lambda> cannot be imported by name", maker_of(runner.record(env, tmp_path)).reason
    )


def test_assumed_arguments_never_make_a_difference(tmp_path):
    same = record_steps(runner.record(Rounded(make_pole(), 3), tmp_path))
    assert verify(same.run.recording, trust=True).verdict == "reproduced"
    other = record_steps(runner.record(Padded(make_pole(), 3), tmp_path))
    outcome = verify(other.run.recording, trust=True)
    assert (outcome.verdict, outcome.difference is None) == ("consistent", False)
    assert "Padded could not be recorded" in outcome.reason
    assert 'make="module:function"' in outcome.reason


def test_videos_are_not_made_again(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "moviepy", ModuleType("moviepy"))  # no video is made
    env = gymnasium.make("CartPole-v1", render_mode="rgb_array")
    env = wrappers.RecordVideo(env, str(tmp_path / "videos"), episode_trigger=lambda _: False)
    maker = maker_of(runner.record(env, tmp_path / "recordings"))
    assert not maker.reason
    assert json.loads(maker.spec)["additional_wrappers"] == []
    assert maker.wrappers[0].endswith("RecordVideo")


def test_environments_of_a_vector_that_differ_are_named(tmp_path):
    envs = SyncVectorEnv(
        [lambda g=g: gymnasium.make("Pendulum-v1", g=g) for g in (9.0, 9.0, 3.0)],
        autoreset_mode=AutoresetMode.NEXT_STEP,
    )
    envs = wrappers.vector.NormalizeObservation(wrappers.vector.RecordEpisodeStatistics(envs))
    maker = maker_of(runner.record_vector(envs, tmp_path))
    assert "not all made in the same way" in maker.reason
    assert maker.vector is not None
    assert (maker.vector.number, maker.vector.mode, maker.vector.autoreset) == (3, "sync", "NextStep")
    specs = json.loads(maker.vector.wrapper_specs)
    assert [spec["name"] for spec in specs] == ["RecordEpisodeStatistics", "NormalizeObservation"]
    assert specs[1]["kwargs"] == {"epsilon": 1e-8}
    assert maker.assumed == ()


def test_a_vector_of_its_own_class_is_made_by_make_vec(tmp_path):
    envs = gymnasium.make_vec("CartPole-v1", 3, vectorization_mode="vector_entry_point")
    maker = maker_of(runner.record_vector(envs, tmp_path))
    assert maker.vector is not None
    assert (maker.reason, maker.vector.mode) == ("", "custom")
    made = gymnasium.make_vec(gymnasium.envs.registration.EnvSpec.from_json(maker.spec))
    assert (type(made), made.num_envs) == (type(envs), 3)


def test_a_game_is_made_by_the_function_of_its_module(tmp_path):
    from mpe2 import simple_spread_v3

    maker = maker_of(runner.record_parallel(simple_spread_v3.parallel_env(N=2), tmp_path))
    spec = json.loads(maker.spec)
    assert (maker.kind, maker.reason, maker.registered_by) == ("pettingzoo", "", "mpe2")
    assert spec["entry_point"] == "mpe2.simple_spread.simple_spread:parallel_env"
    assert spec["kwargs"]["N"] == 2
    assert maker.assumed == ()
    own = maker_of(runner.record_parallel(Leaving(), tmp_path))
    assert json.loads(own.spec) == {"entry_point": "tests.runner.loops.making:Leaving", "kwargs": {}}


def test_an_environment_for_evaluation_has_a_maker_of_its_own(tmp_path):
    train = runner.record(Doubled(make_pole()), tmp_path)
    runner.record(make_pole(), into=train, phase="eval")
    assert maker_of(train).wrappers != maker_of(train, "eval").wrappers
    same = runner.record(make_pole(), tmp_path)
    runner.record(make_pole(), into=same, phase="eval")
    assert maker_of(same) == maker_of(same, "eval")


# --- the user's own function --------------------------------------------------------------------------


@pytest.mark.parametrize("make", [make_pole, f"{__name__}:make_pole"])
def test_a_function_that_makes_the_environment_is_recorded_by_name(make, tmp_path):
    maker = maker_of(runner.record(Shifted(make_pole(), 1.0), tmp_path, make=make))
    assert maker.make == f"{__name__}:make_pole"
    assert maker.reason


@pytest.mark.parametrize(
    "make", [lambda: None, "train", "no_such_module:make", f"{__name__}:nothing", f"{__name__}:__doc__", 3]
)
def test_a_function_that_cannot_be_imported_is_refused(make, tmp_path):
    with pytest.raises(ConfigError, match="make: "):
        runner.record(make_pole(), tmp_path, make=make)
    assert not any(tmp_path.iterdir())


def test_a_function_of_the_script_is_recorded_by_the_name_of_the_script(tmp_path):
    script = tmp_path / "train.py"
    script.write_text(
        "import gymnasium, runner\n"
        "def make_env(): return gymnasium.make('CartPole-v1')\n"
        "if __name__ == '__main__':\n"
        "    with runner.record(make_env(), 'recordings', make=make_env) as env:\n"
        "        print(env.run.recording)\n"
    )
    done = subprocess.run(
        [sys.executable, script.name], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=True
    )
    with open_recording(tmp_path / done.stdout.strip()) as recording:
        assert recording.maker is not None
        assert recording.maker.make == "train:make_env"


class Swapped(gymnasium.ActionWrapper):
    """Takes 1 for left and 0 for right."""

    def action(self, action: Any) -> Any:
        return 1 - action


@pytest.mark.parametrize(
    ("env", "names"),
    [
        (make_pole, ("left", "right")),
        (lambda: wrappers.StickyAction(make_pole(), 0.1), ("left", "right")),
        (lambda: Swapped(make_pole()), ()),
        (lambda: gymnasium.make("MountainCarContinuous-v0"), ()),
    ],
)
def test_actions_are_named_as_long_as_they_are_the_environments_own(env, names, tmp_path):
    with runner.record(env(), tmp_path) as rec:
        pass
    with open_recording(rec.run.recording) as recording:
        assert recording.train.action_names() == names


def test_the_environments_of_a_vector_have_names_of_actions(tmp_path):
    envs = SyncVectorEnv([make_pole] * 2)
    assert maker_of(runner.record_vector(envs, tmp_path)).action_names == ("left", "right")
    swapped = wrappers.vector.TransformAction(SyncVectorEnv([make_pole] * 2), lambda actions: 1 - actions)
    assert maker_of(runner.record_vector(swapped, tmp_path)).action_names == ()


def test_the_agents_of_a_game_have_names_of_actions(tmp_path):
    simple_spread_v3 = pytest.importorskip("mpe2.simple_spread_v3")
    with runner.record_parallel(simple_spread_v3.parallel_env(max_cycles=3), tmp_path, name="spread") as rec:
        rec.reset(seed=0)
        while rec.agents:
            rec.step(dict(zip(rec.agents, (0, 2, 4), strict=True)))
    with open_recording(rec.run.recording) as recording:
        assert recording.train.action_names("agent_1") == ("no action", "left", "right", "down", "up")
        assert recording.train.action_names() == ()
        described, _ = describer(recording, "train")(next(recording.train.transitions()))
        (first, *_) = ShownEpisode(recording, EpisodeRef(0), "").steps()
    assert described == "agent 0 no action, agent 1 right, agent 2 up"
    assert first["action_in_words"] == {"agent_0": "no action", "agent_1": "right", "agent_2": "up"}


# --- what comes in ------------------------------------------------------------------------------------

GOOD = EnvironmentMaker(
    "vector",
    spec="{}",
    registered_by="ale_py",
    vector=VectorMaker(2, "sync", "Disabled"),
    packages={"a": "1"},
    action_names=("left", "right"),
    agent_action_names={"a": ("left", "right")},
)


def test_a_maker_comes_back():
    assert parse_maker(json_object(GOOD.to_metadata()["json"], "it"), "it") == GOOD


def test_a_recording_made_before_actions_had_names_is_read():
    values = json_object(GOOD.to_metadata()["json"], "it")
    del values["action_names"]
    assert parse_maker(values, "it") == replace(GOOD, action_names=())


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("kind", "gym"), ("kind", None), ("spec", 3), ("spec", "{"), ("spec", "[]"), ("spec", "x" * 2**21)),
        ("spec", "[" * 10_000 + "]" * 10_000),
        *(("registered_by", "os; x"), ("make", "os.system"), ("make", "a:b:c"), ("reason", "x" * 3_000)),
        *(("wrappers", "abc"), ("wrappers", ["x"] * 200), ("wrappers", [3]), ("assumed", {})),
        *(("vector", 3), ("vector", {"number": 0}), ("packages", {"a": 1}), ("machine", "x" * 300)),
        *(("action_names", "left"), ("action_names", ["x"] * 101), ("action_names", ["x" * 201])),
        *(("agent_action_names", [["x"]]), ("agent_action_names", {"a": "left"})),
        *(("action_names", [""]), ("action_names", ["\x1b[2J"]), ("action_names", [3])),
    ],
)
def test_a_maker_with_an_impossible_value_is_refused(key, value):
    values = json_object(GOOD.to_metadata()["json"], "it") | {key: value}
    with pytest.raises(RecordingError, match=r"it: .* is damaged"):
        parse_maker(values, "it")


def test_a_state_comes_back_and_damaged_ones_are_refused():
    generator = np.random.default_rng(3)
    generator.integers(5, dtype=np.int32)
    state = ResetState(5, 2, None, generator.bit_generator.state, b"emulator")
    assert decode_reset_state(state.to_payload()) == state
    seeded = ResetState(0, 0, 2**128 - 1)
    assert decode_reset_state(seeded.to_payload()) == seeded
    for payload in (b"\x1a\x03abc", b"\x22\x02ab", b"\x22\x28" + bytes(40), b"\xff"):
        with pytest.raises(RecordingError):
            decode_reset_state(payload)
