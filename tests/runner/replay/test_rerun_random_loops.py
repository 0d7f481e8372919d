"""Loops that reset, seed and evaluate at random moments come out again, whole and by single episodes."""

from __future__ import annotations

import random
from functools import partial

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import NormalizeObservation

import runner
from runner.recording.reader import open_recording
from tests.runner.replay.loops import rerun_steps

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # Box2D's module gives them

POLE = partial(gymnasium.make, "CartPole-v1")
VECTORS = {
    **{
        f"sync {mode.value}": partial(SyncVectorEnv, [POLE] * 3, autoreset_mode=mode)
        for mode in AutoresetMode
    },
    "async": partial(AsyncVectorEnv, [POLE] * 2, autoreset_mode=AutoresetMode.DISABLED),
    "of its own class": partial(gymnasium.make_vec, "CartPole-v1", 3),
    "with a wrapper": lambda: NormalizeObservation(SyncVectorEnv([POLE] * 3)),
    "of discrete spaces": partial(gymnasium.make_vec, "FrozenLake-v1", 3, vectorization_mode="sync"),
}


def check(path, generator):
    """Check that all steps come out again, and some single episodes."""
    with open_recording(path) as recording:
        taken = sum(len(rows) for phase in recording.phases for rows in phase.steps.taken())
        spans = {
            (phase, number): len(recording.phase(phase).episode(number))
            for phase in ("train", "eval")
            for number in range(recording.phase(phase).episodes.count())
        }
    assert rerun_steps(path) == (taken, None)
    for (phase, number), length in generator.sample(sorted(spans.items()), min(4, len(spans))):
        assert rerun_steps(path, phase, [number]) == (length, None)


@pytest.mark.parametrize("number", range(4))
@pytest.mark.parametrize("name", ["CartPole-v1", "FrozenLake-v1", "LunarLander-v3"])
def test_a_random_loop_over_an_environment(name, number, tmp_path):
    generator = random.Random(number)
    over = True

    def steps(env):
        nonlocal over
        for _ in range(generator.randrange(1, 60)):
            if over or generator.random() < 0.03:
                if generator.random() < 0.1:
                    env.reset(seed=generator.choice([None, 7]))
                env.reset(seed=generator.choice([None, None, None, generator.randrange(10**6)]))
            over = any(env.step(env.action_space.sample())[2:4])

    with runner.record(gymnasium.make(name), tmp_path) as env:
        env.action_space.seed(number)
        for _ in range(8):
            steps(env)
            if generator.random() < 0.5:
                with env.phase("eval"):
                    env.reset(seed=generator.choice([None, None, 3]))
                    over = False
                    steps(env)
                    if generator.random() < 0.3:
                        env.reset()
                env.reset(seed=generator.choice([None, None, 4]))
                over = False
    check(env.run.recording, generator)


@pytest.mark.parametrize("number", range(3))
@pytest.mark.parametrize("name", VECTORS)
def test_a_random_loop_over_a_vector(name, number, tmp_path):
    generator = random.Random(number)
    envs = VECTORS[name]()
    takes_lists = hasattr(envs.unwrapped, "env_fns")

    def seeds():
        some = [generator.choice([None, generator.randrange(99)]) for _ in range(envs.num_envs)]
        return generator.choice([None, None, generator.randrange(999), some if takes_lists else 5])

    def steps(envs):
        envs.reset(seed=seeds())
        for _ in range(generator.randrange(1, 100)):
            _, _, terminated, truncated, _ = envs.step(envs.action_space.sample())
            over = terminated | truncated
            if envs.metadata["autoreset_mode"] == AutoresetMode.DISABLED and over.any():
                others = np.array([generator.random() < 0.1 for _ in over])
                envs.reset(options={"reset_mask": over | others}, seed=generator.choice([None, 8]))
            if generator.random() < 0.02:
                envs.reset(seed=seeds())

    with runner.record_vector(envs, tmp_path) as recorded:
        recorded.action_space.seed(number)
        for _ in range(2):
            steps(recorded)
            if generator.random() < 0.5:
                with recorded.phase("eval"):
                    steps(recorded)
                recorded.reset()
    check(recorded.run.recording, generator)
