"""Stable-Baselines3 and sb3-contrib, recorded by a callback and by `runner.record`."""

from __future__ import annotations

import warnings

import ale_py
import gymnasium
import numpy as np
import pytest
import sb3_contrib
import torch
from click.testing import CliRunner
from stable_baselines3 import A2C, DQN, PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback
from stable_baselines3.common.env_util import make_atari_env, make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnv,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)

import runner
from runner.cli import cli
from runner.errors import ConfigError
from runner.integrations.sb3 import Recording

SMALL = {"n_steps": 64, "batch_size": 32, "n_epochs": 2, "device": "cpu"}


def verified(run) -> str:
    """Return what `dualtaxi verify` prints of a run."""
    done = CliRunner().invoke(cli, ["verify", str(run.recording)])
    return f"{done.exit_code} {done.output}"


def logged(run) -> list[tuple[str, float]]:
    """Return the names and values of logged numbers, in their order."""
    with runner.open_recording(run.recording) as recording:
        return [(one["name"], one["value"]) for one in recording.decoded(recording.topic("/scalar"))]


def weights(model) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in model.policy.state_dict().items()}


def assert_equal_weights(one, other) -> None:
    assert one.keys() == other.keys()
    assert all(torch.equal(one[name], other[name]) for name in one)


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
        episodes = np.concatenate(list(recording.blocks(recording.topic("/train/episode"))))
    monitored = [value for env in envs.envs for value in env.get_episode_rewards()]
    assert len(monitored) > 10
    assert sorted(episodes["returns"][:, 0]) == sorted(monitored)


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
        rows = np.concatenate(list(recording.blocks(recording.topic("/train/step"))))
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
        for one in recording.decoded(recording.topic("/scalar")):
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


def test_several_learns_are_one_run_in_a_with(recordings):
    model = PPO("MlpPolicy", "CartPole-v1", seed=1, **SMALL)
    with Recording(name="parts") as callback:
        for _ in range(3):
            model.learn(64, callback=callback, reset_num_timesteps=False)
        callback.recorded.log("mine", 1.5)
    (run,) = runner.list_runs(recordings)
    assert (run.facts["status"], run.summary["train_steps"]) == ("finished", 192)
    assert "reproduced" in verified(run)
    model.learn(64, reset_num_timesteps=False)  # not recorded any more, and not disturbed
    assert len(runner.list_runs(recordings)) == 1


def test_each_learn_is_a_run_otherwise(recordings):
    model = PPO("MlpPolicy", "CartPole-v1", seed=1, **SMALL)
    model.learn(64, callback=Recording())
    with pytest.warns(RuntimeWarning, match="continues episodes"):
        model.learn(64, callback=Recording(), reset_num_timesteps=False)
    model.learn(64, callback=Recording())
    assert [run.summary["train_steps"] for run in runner.list_runs(recordings)] == [64] * 3


def test_an_error_in_a_callback_leaves_environments_that_can_be_recorded_again(recordings):
    class Fails(BaseCallback):
        def _on_step(self):
            raise ValueError("mine")

    model = PPO("MlpPolicy", "CartPole-v1", seed=1, **SMALL)
    with pytest.raises(ValueError, match="mine"):
        model.learn(64, callback=CallbackList([Recording(name="first"), Fails()]))
    model.learn(64, callback=Recording(name="second"))
    runs = {run.facts["name"]: run for run in runner.list_runs(recordings)}
    assert runs["first"].facts["status"] == "interrupted"
    assert runs["second"].facts["status"] == "finished"
    assert runs["second"].summary["train_steps"] == 64


@pytest.mark.parametrize("number", [1, 3])
def test_evaluations_are_the_evaluation_phase_of_the_run(recordings, number):
    def trained(*callbacks):
        envs = VecNormalize(make_vec_env("CartPole-v1", n_envs=2, seed=1))
        evaluated = VecNormalize(make_vec_env("CartPole-v1", n_envs=number, seed=9))
        evaluation = EvalCallback(evaluated, eval_freq=64, n_eval_episodes=4, verbose=0)
        model = PPO("MlpPolicy", envs, seed=1, **SMALL)
        model.learn(256, callback=[evaluation, *callbacks])
        return evaluation, weights(model)

    callback = Recording()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        evaluation, recorded = trained(callback)
    assert_equal_weights(recorded, trained()[1])
    assert dict(logged(callback.run))["eval/mean_reward"] == pytest.approx(evaluation.last_mean_reward)
    assert callback.run.summary["train_steps"] == 256
    with runner.open_recording(callback.run.recording) as recording:
        episodes = recording.episodes("eval")["returns"][:, 0]
    assert len(episodes) >= 2 * 4
    if number == 1:
        assert episodes[-4:].mean() == pytest.approx(evaluation.last_mean_reward)
    assert "reproduced" in verified(callback.run)


def test_an_evaluation_in_an_environment_of_other_spaces_is_left_out_with_a_warning(recordings):
    evaluation = EvalCallback(make_vec_env("Acrobot-v1"), eval_freq=10_000)
    with pytest.warns(RuntimeWarning, match="evaluations of EvalCallback are not recorded"):
        PPO("MlpPolicy", "CartPole-v1", **SMALL).learn(64, callback=[evaluation, Recording()])
    (run,) = runner.list_runs(recordings)
    assert (run.facts["status"], run.summary["train_steps"]) == ("finished", 64)


def test_record_returns_a_vec_env(recordings):
    envs = runner.record(make_vec_env("CartPole-v1", n_envs=4, seed=0), name="mine", config={"a": 1})
    assert isinstance(envs, VecEnv)
    callback = Recording(checkpoint_every=100)
    PPO("MlpPolicy", envs, **SMALL).learn(256, callback=callback)
    envs.log("extra", 2.0)
    envs.close()
    assert envs.run.summary["train_steps"] == 256
    assert {"train/loss", "extra"} <= set(dict(logged(envs.run)))
    assert len(envs.run.checkpoints()) == 3
    assert "reproduced" in verified(envs.run)


def test_record_keeps_the_wrappers_outside(recordings):
    envs = runner.record(VecNormalize(make_vec_env("Pendulum-v1", n_envs=2)), name="inner")
    model = PPO("MlpPolicy", envs, **SMALL)
    assert model.get_vec_normalize_env() is envs
    model.learn(128)
    envs.close()
    assert "reproduced" in verified(envs.run)


def test_mistakes(recordings):
    with pytest.raises(ConfigError, match="checkpoint_every"):
        Recording(checkpoint_every=-1)
    with pytest.raises(ConfigError, match="'walk'"):
        Recording(walk=3)
    model = PPO("MlpPolicy", "CartPole-v1", **SMALL)
    with pytest.raises(ConfigError, match="2 callbacks"):
        model.learn(64, callback=[Recording(), Recording()])
    with pytest.raises(runner.RunnerError, match="no run yet"):
        Recording().run  # noqa: B018
    with pytest.raises(ConfigError, match="recorded already"):
        runner.record(runner.record(make_vec_env("CartPole-v1")))


class StopLater(BaseCallback):
    """Requests after a hundred steps that a recorded training stops."""

    def __init__(self, recording: Recording) -> None:
        super().__init__()
        self.recording = recording

    def _on_step(self) -> bool:
        if self.num_timesteps == 100:
            self.recording.run.request_stop()
        return True


def test_a_training_that_is_requested_to_stop_ends_and_is_finished(recordings):
    model = PPO("MlpPolicy", "CartPole-v1", seed=0, **SMALL)
    recording = Recording(name="stopped")
    model.learn(1_000_000, callback=[recording, StopLater(recording)])
    assert 100 < model.num_timesteps < 1_000_000
    assert recording.run.status == "finished"
    assert recording.run.summary["train_steps"] == model.num_timesteps
