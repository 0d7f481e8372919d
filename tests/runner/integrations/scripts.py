"""Scripts as CleanRL writes them, and what of them is in a recording."""

from __future__ import annotations

import gymnasium
import numpy as np

import runner
from runner.recording.schema import SCALAR_TOPIC

SETTINGS = {"env_id": "CartPole-v1", "seed": 3, "learning_rate": 2.5e-4, "target_kl": None, "exp_name": "ppo"}
TABLE = "|param|value|\n|-|-|\n" + "\n".join(f"|{key}|{value}|" for key, value in SETTINGS.items())


def make():
    return gymnasium.wrappers.RecordEpisodeStatistics(gymnasium.make("CartPole-v1"))


def learn(envs, log, steps=50):
    """Step environments in the way of CleanRL's scripts; log the script's own step, and a value."""
    envs.action_space.seed(0)
    envs.reset(seed=SETTINGS["seed"])
    for step in range(1, steps + 1):
        over = np.any(envs.step(envs.action_space.sample())[2:4])
        if over and not isinstance(envs, gymnasium.vector.VectorEnv):
            envs.reset()
        if step % 10 == 0:
            log(step * getattr(envs, "num_envs", 1), 1 / step)
    envs.close()


def the_run():
    (run,) = runner.list_runs()
    return run


def scalars(run):
    with runner.open_recording(run.recording) as recording:
        return [
            (each["name"], each["value"], each["step"]) for each in recording.table(SCALAR_TOPIC).decoded()
        ]


def texts(run):
    with runner.open_recording(run.recording) as recording:
        return {each["name"]: each["message"] for each in recording.table("/log").decoded()}


def arrays(run):
    with runner.open_recording(run.recording) as recording:
        return {each.name: each.values for each in recording.arrays()}


def images(run):
    with runner.open_recording(run.recording) as recording:
        topic = recording.table("/image").topic
        return [(each["frame_id"], each["format"], each["data"]) for each in recording.table(topic).decoded()]
