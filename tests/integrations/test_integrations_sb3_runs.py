"""Runs that trainings with Stable-Baselines3 make: one or several, evaluated, stopped, failed, misused."""

from __future__ import annotations

import warnings

import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import (
    VecEnv,
    VecNormalize,
)

import runner
from runner.errors import ConfigError
from runner.integrations import wandb
from runner.integrations.sb3 import Recording
from runner.integrations.wandb.integration.sb3 import WandbCallback
from runner.recording.schema import SCALAR_TOPIC
from tests.integrations.sb3_models import SMALL, assert_equal_weights, logged, verified, weights


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
        episodes = recording.eval.episodes.array()["returns"][:, 0]
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


@pytest.mark.parametrize("has_environment", [True, False])
def test_the_callback_of_wandb_records_into_its_run(recordings, has_environment):
    run = wandb.init(
        project="sb3", config={"env": "CartPole-v1"}, sync_tensorboard=True, monitor_gym=has_environment
    )
    model = PPO("MlpPolicy", "CartPole-v1", seed=1, tensorboard_log=f"runs/{run.id}", **SMALL)
    with pytest.warns(RuntimeWarning, match="gradients are not recorded"):
        callback = WandbCallback(gradient_save_freq=100, model_save_path=f"models/{run.id}", verbose=2)
    model.learn(128, callback=callback)
    wandb.log({"after": 1.0})
    run.finish()
    (found,) = runner.list_runs(recordings)
    assert (found.run_id, found.status, found.name) == (run.id, "finished", "sb3")
    assert found.facts["config"]["config"]["env"] == "CartPole-v1"
    assert found.summary["train_steps"] == (128 if has_environment else 0)
    assert (recordings.parent / "models" / run.id / "model.zip").is_file()
    with runner.open_recording(found.recording) as recording:
        names = [scalar["name"] for scalar in recording.table(SCALAR_TOPIC).decoded()]
    assert names.count("train/loss") == 128 // SMALL["n_steps"]
    assert names[-1] == "after"
    if has_environment:
        assert "reproduced" in verified(found)
