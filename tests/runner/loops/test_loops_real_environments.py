"""Real environments: recording changes nothing, and what is recorded makes and resets them again."""

from __future__ import annotations

import warnings
from functools import partial
from typing import Any

import ale_py
import gymnasium
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

import runner
from runner.loops import generators
from runner.recording.reader import open_recording
from tests.runner.loops.making import Rooms, drive, parallel, play

gymnasium.register_envs(ale_py)

pytestmark = [
    pytest.mark.usefixtures("own_folder"),
    # Of MuJoCo's, pygame's and the environments' own makers, not of what is tested.
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore::UserWarning"),
]


def preprocessed() -> Any:
    pong = gymnasium.make("ALE/Pong-v5", frameskip=1, max_num_frames_per_episode=600)
    atari = wrappers.AtariPreprocessing(pong, frame_skip=4)
    return wrappers.FrameStackObservation(atari, 4)


def minigrid(**kwargs: Any) -> Any:
    import minigrid.wrappers

    env = gymnasium.make("MiniGrid-DoorKey-5x5-v0", **kwargs)
    return minigrid.wrappers.ImgObsWrapper(minigrid.wrappers.FullyObsWrapper(env))


ENVIRONMENTS = {
    "Taxi": partial(gymnasium.make, "Taxi-v4"),
    "FrozenLake": partial(gymnasium.make, "FrozenLake-v1", is_slippery=True),
    "Blackjack": partial(gymnasium.make, "Blackjack-v1"),
    "CartPole": partial(gymnasium.make, "CartPole-v1"),
    "LunarLander": partial(gymnasium.make, "LunarLander-v3", enable_wind=True),
    "HalfCheetah": partial(gymnasium.make, "HalfCheetah-v5", max_episode_steps=150),
    "Pong": preprocessed,
    "MiniGrid": minigrid,
    "sticky": lambda: wrappers.StickyAction(gymnasium.make("FrozenLake-v1"), 0.3),
    "scaled": lambda: wrappers.NormalizeObservation(
        wrappers.RescaleAction(gymnasium.make("Pendulum-v1", g=np.float64(9.5)), -1, 1)
    ),
}
BETWEEN, STEPS = 250, 600
"""Steps from one recorded state to the next, and more than twice as many."""


@pytest.fixture(autouse=True)
def often(monkeypatch):
    """Record states of generators more often than usual."""
    monkeypatch.setattr(generators, "STEPS_BETWEEN", BETWEEN)


def same(one: Any, other: Any) -> bool:
    """Return whether two values are equal to the last bit, and of the same types."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()
    return type(one) is type(other) and (one == other or bool(np.isnan(one) and np.isnan(other)))


def stack(env: Any) -> list[str]:
    """Return the classes of an environment, from the outermost in."""
    names = []
    while isinstance(env, gymnasium.Wrapper):
        names.append(type(env).__name__)
        env = env.env
    return [*names, type(env).__name__]


def without_info(entries: Any) -> list[Any]:
    return [entry[:6] for entry in entries]


@pytest.mark.parametrize("name", [*ENVIRONMENTS, "Dict"])
def test_an_environment_does_the_same_recorded(name, tmp_path):
    make = ENVIRONMENTS.get(name, Rooms)
    alone = make()
    expected = without_info(play(alone, STEPS))
    alone.close()
    with runner.record(make(), tmp_path) as env:
        found = without_info(play(env, STEPS))
    assert same(found, expected)


@pytest.mark.parametrize("mode", AutoresetMode)
@pytest.mark.parametrize("kind", [SyncVectorEnv, AsyncVectorEnv])
def test_a_vector_does_the_same_recorded(kind, mode, tmp_path):
    def vector() -> Any:
        return kind([ENVIRONMENTS["CartPole"]] * 2, autoreset_mode=mode)

    alone = vector()
    expected = drive(alone, STEPS)
    alone.close()
    with runner.record_vector(vector(), tmp_path) as envs:
        found = drive(envs, STEPS)
    assert same(found, expected)


def test_a_game_does_the_same_recorded(tmp_path):
    from mpe2 import simple_spread_v3

    expected = parallel(simple_spread_v3.parallel_env(max_cycles=9), 3)
    with runner.record_parallel(simple_spread_v3.parallel_env(max_cycles=9), tmp_path) as env:
        assert same(parallel(env, 3), expected)


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_the_recorded_specification_makes_the_same_environment(name, tmp_path):
    env = ENVIRONMENTS[name]()
    expected = stack(env)
    with runner.record(env, tmp_path) as recorded:
        pass
    with open_recording(recorded.run.recording) as recording:
        maker = recording.maker
    assert maker is not None
    assert not maker.reason
    assert not maker.assumed or name == "MiniGrid"
    assert maker.registered_by == {"Pong": "ale_py", "MiniGrid": "minigrid"}.get(name, "")
    assert maker.packages["gymnasium"] == gymnasium.__version__
    if name == "Pong":
        assert maker.action_names == ("NOOP", "FIRE", "RIGHT", "LEFT", "RIGHTFIRE", "LEFTFIRE")
    if name == "MiniGrid":
        assert maker.action_names[:3] == ("left", "right", "forward")
    with gymnasium.make(EnvSpec.from_json(maker.spec)) as made:
        assert stack(made) == expected
        assert len(maker.wrappers) == len(expected) - 1


def unseeded(env: Any, steps: int) -> list[list[Any]]:
    """Play at random, all resets without a seed; return the episodes: first observation, then steps."""
    episodes, over = [], True
    for _ in range(steps):
        if over:
            episodes.append([env.reset()[0]])
        action = env.action_space.sample()
        *result, _ = env.step(action)
        episodes[-1].append((action, result))
        over = result[2] or result[3]
    return episodes


@pytest.mark.parametrize("name", [name for name in ENVIRONMENTS if name != "scaled"])
def test_an_episode_follows_from_the_state_before_its_reset(name, tmp_path):
    """That of `scaled` also depends on the means of all observations before."""
    with runner.record(ENVIRONMENTS[name](), tmp_path) as env:
        episodes = unseeded(env, STEPS)
    with open_recording(env.run.recording) as recording:
        states = list(recording.train.reset_states())
        assert 2 <= len(states) <= 4
    for state in states:
        with ENVIRONMENTS[name]() as fresh:
            base = fresh.unwrapped
            if state.bit_generator is not None:
                base.np_random.bit_generator.state = state.bit_generator
            if state.ale_state:
                base.ale.restoreState(ale_py.ALEState(state.ale_state))
            first, *steps = episodes[state.reset]
            assert same(fresh.reset(seed=state.np_random_seed)[0], first)
            for action, result in steps:
                assert same(list(fresh.step(action)[:4]), result)


@pytest.mark.parametrize("mode", AutoresetMode)
@pytest.mark.parametrize("kind", [SyncVectorEnv, AsyncVectorEnv])
def test_the_seeds_that_a_vector_draws_are_recorded(kind, mode, tmp_path):
    envs = kind([ENVIRONMENTS["CartPole"]] * 3, autoreset_mode=mode)
    with runner.record_vector(envs, tmp_path) as rec:
        rec.action_space.seed(1)
        first = rec.reset()[0]
        for _ in range(STEPS):
            result = rec.step(rec.action_space.sample())
            over = result[2] | result[3]
            if mode == AutoresetMode.DISABLED and over.any():
                rec.reset(options={"reset_mask": over})
    with open_recording(rec.run.recording) as recording:
        states = list(recording.train.reset_states())
        resets = {int(one["reset"]): one for one in recording.train.reset_values()}
        assert recording.maker is not None
        assert recording.maker.vector is not None
        assert recording.maker.vector.number == 3
    for i, state in enumerate(states[:3]):
        assert (state.reset, state.environment) == (i, i)
        with ENVIRONMENTS["CartPole"]() as env:
            assert same(env.reset(seed=state.np_random_seed)[0], first[i])
    later = states[3:]
    # The state of an environment that resets itself within a step, or in another process, cannot be read.
    assert bool(later) == (kind is SyncVectorEnv and mode != AutoresetMode.SAME_STEP)
    for state in later:
        reset = resets[state.reset]
        assert int(reset["environment"]) == state.environment
        with ENVIRONMENTS["CartPole"]() as env:
            env.unwrapped.np_random.bit_generator.state = state.bit_generator
            assert same(env.reset()[0], np.array(reset["observation"]))


def test_an_environment_that_never_draws_has_no_state_and_gets_no_generator(tmp_path):
    class Still(gymnasium.Env[Any, Any]):
        observation_space = action_space = gymnasium.spaces.Discrete(2)

        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            return 0, {}

        def step(self, action: Any) -> Any:
            return 0, 0.0, True, False, {}

    env = Still()
    with runner.record(env, tmp_path) as rec:
        for _ in range(5):
            rec.reset()
            rec.step(0)
    assert env._np_random is None
    with open_recording(rec.run.recording) as recording:
        assert list(recording.train.reset_states()) == []


def test_each_phase_begins_with_a_state(tmp_path):
    with runner.record(ENVIRONMENTS["CartPole"](), tmp_path) as rec:
        rec.reset()
        with rec.phase("eval"):
            rec.reset()
            rec.step(0)
        rec.reset()
        rec.step(0)
    with open_recording(rec.run.recording) as recording:
        train, evaluation = (list(recording.phase(phase).reset_states()) for phase in ("train", "eval"))
    assert [state.reset for state in train] == [0, 1]
    assert [state.reset for state in evaluation] == [0]
    assert train[0].np_random_seed is not None
    assert train[1].bit_generator is not None


def test_mujoco_is_drawn_without_a_display():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with gymnasium.make("HalfCheetah-v5", render_mode="rgb_array") as env:
            env.reset(seed=1)
            assert env.render().std() > 10
