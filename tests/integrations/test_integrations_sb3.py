"""Stable-Baselines3 and sb3-contrib, recorded by a callback and by `runner.record`."""

from __future__ import annotations

import ale_py
import gymnasium
import numpy as np
import pytest
import sb3_contrib
import torch
from stable_baselines3 import A2C, DQN, PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_atari_env, make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)

import runner
from runner.integrations.sb3 import Recording
from tests.integrations.sb3_models import SMALL, assert_equal_weights, logged, verified, weights


@pytest.mark.parametrize(
    ("env_id", "vec_env", "seed"),
    [
        ("CartPole-v1", DummyVecEnv, 5),
        ("CartPole-v1", DummyVecEnv, None),
        ("CartPole-v1", SubprocVecEnv, 5),
        ("Pendulum-v1", DummyVecEnv, 5),
        ("Pendulum-v1", SubprocVecEnv, None),
        ("LunarLander-v3", DummyVecEnv, None),
    ],
)
def test_ppo_is_recorded_and_its_environments_are_reproduced(recordings, env_id, vec_env, seed):
    envs = make_vec_env(env_id, n_envs=3, vec_env_cls=vec_env)
    model = PPO("MlpPolicy", VecNormalize(envs), seed=seed, **SMALL)
    callback = Recording(name="ppo")
    model.learn(700, callback=callback)
    envs.close()
    run = callback.run
    assert run.facts["status"] == "finished"
    assert run.summary["train_steps"] == model.num_timesteps
    assert verified(run).startswith("0 ")
    assert "verdict       reproduced" in verified(run)


def test_weights_are_the_same_with_and_without(recordings):
    def trained(callback=None, record=False):
        envs = make_vec_env("Pendulum-v1", n_envs=2, seed=1)
        envs = runner.record(envs) if record else envs
        model = PPO("MlpPolicy", VecNormalize(envs), seed=1, **SMALL)
        model.learn(600, callback=callback)
        envs.close()
        return weights(model)

    plain = trained()
    assert_equal_weights(plain, trained(Recording(checkpoint_every=200)))
    assert_equal_weights(plain, trained(record=True))


def test_the_learning_curves_are_those_of_the_monitor(recordings):
    envs = make_vec_env("CartPole-v1", n_envs=2, seed=0)
    callback = Recording()
    PPO("MlpPolicy", envs, **SMALL).learn(1_000, callback=callback)
    with runner.open_recording(callback.run.recording) as recording:
        episodes = recording.train.episodes.array()
    monitored = [value for env in envs.envs for value in env.get_episode_rewards()]
    assert len(monitored) > 10
    assert sorted(episodes["returns"][:, 0]) == sorted(monitored)


class Halving(gymnasium.ActionWrapper):
    """Changes its action in place, as some environments do."""

    def action(self, action):
        action *= 0.5
        return action


def make_halving():
    return Halving(gymnasium.make("Pendulum-v1"))


@pytest.mark.parametrize("vec_env", [DummyVecEnv, SubprocVecEnv])
def test_actions_that_environments_change_in_place_are_recorded_as_given(recordings, vec_env):
    envs = runner.record(vec_env([make_halving] * 2), name="halving", make=make_halving)
    envs.reset()
    for _ in range(5):
        envs.step(np.full((2, 1), 0.8, np.float32))
    envs.close()
    with runner.open_recording(envs.run.recording) as recording:
        rows = recording.train.steps.array()
    assert np.array_equal(rows["action"], np.full((10, 1), 0.8, np.float32))


class Watch(BaseCallback):
    """Keeps what the algorithm itself sees."""

    def _init_callback(self):
        self.rewards, self.dones, self.terminal = [], [], []

    def _on_step(self):
        env = self.model.get_vec_normalize_env()
        self.rewards.append(env.get_original_reward())
        self.dones.append(self.locals["dones"].copy())
        return True


def test_rewards_and_observations_are_those_before_normalisation(recordings):
    model = PPO("MlpPolicy", VecNormalize(make_vec_env("CartPole-v1", n_envs=2, seed=3)), **SMALL)
    watch, callback = Watch(), Recording()
    model.learn(500, callback=[watch, callback])
    with runner.open_recording(callback.run.recording) as recording:
        rows = recording.train.steps.array()
    assert rows["rewards"][:, 0].tolist() == np.ravel(watch.rewards).tolist()
    assert (rows["terminated"] | rows["truncated"]).tolist() == np.ravel(watch.dones).tolist()
    ended = rows["next_observation"][rows["terminated"]]
    assert len(ended) > 5  # a pole that fell, and not the first observation of the next episode
    assert (abs(ended[:, 2]) > 0.2).all() or (abs(ended[:, 0]) > 2.4).any()


def test_the_logger_and_the_settings_are_recorded(recordings):
    model = PPO("MlpPolicy", "CartPole-v1", learning_rate=lambda left: 1e-3 * left, seed=4, **SMALL)
    callback = Recording(config={"note": "mine"})
    model.learn(300, callback=callback)
    names = [name for name, _ in logged(callback.run)]
    assert {"train/loss", "train/entropy_loss", "rollout/ep_rew_mean", "time/iterations"} <= set(names)
    assert "time/fps" not in names
    assert names.count("train/loss") == names.count("time/iterations") == 5  # also of the last update
    with runner.open_recording(callback.run.recording) as recording:
        config = recording.config["config"]
    assert config["algorithm"] == "PPO"
    assert config["policy"] == "ActorCriticPolicy"
    assert (config["n_steps"], config["gamma"], config["seed"], config["note"]) == (64, 0.99, 4, "mine")
    assert config["learning_rate"] == {"first": 1e-3, "last": 0.0}
    assert config["clip_range"] == 0.2
    assert callback.run.facts["seed"] == 4


def test_a_logger_that_is_set_meanwhile_costs_no_run(recordings):
    class OtherLogger(BaseCallback):
        def _on_step(self):
            self.model.set_logger(configure(format_strings=[]))
            return True

    callback = Recording(recordings)
    PPO("MlpPolicy", "CartPole-v1", **SMALL).learn(64, callback=[callback, OtherLogger()])
    assert (callback.run.status, callback.run.summary.train_steps) == ("finished", 64)


@pytest.mark.parametrize(
    ("algorithm", "env_id", "total", "stops_at", "settings"),
    [
        (PPO, "CartPole-v1", 256, None, SMALL),
        (A2C, "CartPole-v1", 100, 52, {"device": "cpu"}),
        (DQN, "CartPole-v1", 700, None, {"learning_starts": 100}),
        (DQN, "CartPole-v1", 701, 402, {"learning_starts": 100, "train_freq": (1, "episode")}),
        (SAC, "Pendulum-v1", 450, None, {"learning_starts": 100, "gradient_steps": 2}),
    ],
)
@pytest.mark.parametrize("log_interval", [1, 2])
def test_the_numbers_of_an_update_stand_at_its_step_once(
    recordings, algorithm, env_id, total, stops_at, settings, log_interval
):
    model = algorithm("MlpPolicy", env_id, seed=4, **settings)
    updates: dict[int, dict[str, float]] = {}
    train = model.train

    def watched(*arguments, **named):
        train(*arguments, **named)
        numbers = model.logger.name_to_value.items()
        updates[model.num_timesteps] = {name: value for name, value in numbers if name.startswith("train/")}

    class Stop(BaseCallback):
        def _on_step(self):
            return self.num_timesteps != stops_at

    model.train = watched
    callback = Recording()
    model.learn(total, callback=[Stop(), callback], log_interval=log_interval)
    found: dict[int, dict[str, float]] = {}
    with runner.open_recording(callback.run.recording) as recording:
        for one in recording.table("/scalar").decoded():
            if one["name"].startswith("train/"):
                own = found.setdefault(one["step"], {})
                assert one["name"] not in own
                own[one["name"]] = one["value"]
    assert len(found) > 1
    assert all(updates[step] == pytest.approx(numbers) for step, numbers in found.items())
    if stops_at is None:
        assert max(found) == max(updates)  # the library itself writes nothing of the last update
    if algorithm is PPO:
        assert list(found) == [*range(64 * log_interval, 257, 64 * log_interval)]


def test_the_last_checkpoint_is_the_only_one_of_its_step(recordings):
    callback = Recording(checkpoint_every=64)
    PPO("MlpPolicy", "CartPole-v1", seed=4, **SMALL).learn(128, callback=callback)
    assert [one.step for one in callback.run.checkpoints()] == [64, 128]


def test_checkpoints_are_the_policy(recordings):
    model = PPO("MlpPolicy", "CartPole-v1", seed=4, **SMALL)
    callback = Recording(checkpoint_every=100)
    model.learn(256, callback=callback)
    found = callback.run.checkpoints()
    assert [one.step for one in found] == [100, 200, 256]
    kept = {name: torch.from_numpy(value) for name, value in found[-1].load().items()}
    assert_equal_weights(kept, weights(model))


@pytest.mark.parametrize(
    ("algorithm", "options"),
    [
        (A2C, {"device": "cpu"}),
        (DQN, {"learning_starts": 50}),
        (sb3_contrib.QRDQN, {"learning_starts": 50}),
        (sb3_contrib.TRPO, {"n_steps": 128, "batch_size": 64}),
    ],
)
def test_other_algorithms_are_recorded_and_unchanged(recordings, algorithm, options):
    def trained(callback):
        model = algorithm("MlpPolicy", "CartPole-v1", seed=2, **options)
        return weights(model.learn(300, callback=callback, log_interval=1))

    callback = Recording(name=algorithm.__name__)
    assert_equal_weights(trained(None), trained(callback))
    assert callback.run.summary["train_steps"] >= 300
    assert "reproduced" in verified(callback.run)


def test_continuous_actions_of_an_off_policy_algorithm(recordings):
    callback = Recording()
    model = SAC("MlpPolicy", "Pendulum-v1", seed=2, learning_starts=100, policy_kwargs={"net_arch": [32]})
    model.learn(250, callback=callback)
    assert callback.run.summary["train_steps"] == 250
    assert "reproduced" in verified(callback.run)


def test_a_recurrent_policy(recordings):
    callback = Recording()
    sb3_contrib.RecurrentPPO("MlpLstmPolicy", "CartPole-v1", n_steps=64, n_epochs=1).learn(128, callback)
    assert "reproduced" in verified(callback.run)


def test_masked_actions(recordings):
    from sb3_contrib.common.wrappers import ActionMasker

    env = ActionMasker(gymnasium.make("CartPole-v1"), lambda env: np.array([True, True]))
    callback = Recording()
    sb3_contrib.MaskablePPO("MlpPolicy", env, n_steps=64, n_epochs=1).learn(128, callback)
    assert callback.run.summary["train_steps"] == 128
    assert "reproduced" in verified(callback.run)


def test_frames_are_stacked_outside_of_what_is_recorded(recordings):
    envs = VecMonitor(VecFrameStack(make_vec_env("CartPole-v1", n_envs=2), 4))
    callback = Recording()
    PPO("MlpPolicy", envs, **SMALL).learn(128, callback=callback)
    with runner.open_recording(callback.run.recording) as recording:
        assert recording.spaces["observation"]["shape"] == [4]
    assert "reproduced" in verified(callback.run)


@pytest.mark.parametrize("seed", [None, 1])
def test_atari_with_the_usual_wrappers_is_reproduced(recordings, seed):
    gymnasium.register_envs(ale_py)
    wrapped = make_atari_env("ALE/Pong-v5", n_envs=2, seed=seed, wrapper_kwargs={"frame_skip": 3})
    callback = Recording()
    A2C("CnnPolicy", VecFrameStack(wrapped, 4), device="cpu").learn(300, callback=callback)
    with runner.open_recording(callback.run.recording) as recording:
        assert recording.spaces["observation"]["shape"] == [84, 84, 1]
    assert "reproduced" in verified(callback.run)
