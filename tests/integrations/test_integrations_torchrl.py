"""TorchRL: environments, collectors and the logger."""

from __future__ import annotations

import gc
import json

import gymnasium
import pytest
import torch
from click.testing import CliRunner
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import (
    Compose,
    DoubleToFloat,
    GymEnv,
    ObservationNorm,
    ParallelEnv,
    RewardSum,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)
from torchrl.modules import MLP, EGreedyModule, QValueModule

import runner
from runner.cli import cli
from runner.errors import ConfigError
from runner.integrations import torchrl
from runner.integrations.tensorboard import SummaryWriter


def policy(env):
    """Return a policy of random weights that explores, as the tutorial on DQN has it."""
    torch.manual_seed(0)
    value = TensorDictModule(MLP(out_features=2, num_cells=[16]), ["observation"], ["action_value"])
    greedy = TensorDictSequential(value, QValueModule(spec=env.action_spec_unbatched))
    return TensorDictSequential(
        greedy, EGreedyModule(env.action_spec_unbatched, eps_init=0.5, annealing_num_steps=1_000)
    )


def collector(env, frames=90, batches=4):
    return Collector(
        env, policy(env), frames_per_batch=frames, total_frames=frames * batches, init_random_frames=0
    )


def steps_of(run):
    with runner.open_recording(run.recording) as recording:
        steps = recording.train.steps.array()
        resets = recording.train.resets.array()
        return steps, resets, json.loads(recording.run["spaces"])


def verified(run) -> str:
    done = CliRunner().invoke(cli, ["verify", str(run.recording)])
    return f"{done.output}{done.exception!r}"


def test_the_environment_inside_is_recorded_and_reproduced(recordings):
    env = TransformedEnv(
        GymEnv("CartPole-v1"),
        Compose(ObservationNorm(loc=1.0, scale=2.0, in_keys=["observation"]), DoubleToFloat(), StepCounter()),
    )
    env = torchrl.record(env, name="dqn", config={"eps": 0.5})
    env.set_seed(3)
    collecting = collector(env)
    rewards = [data["next", "reward"].clone() for data in collecting]
    collecting.shutdown()
    (run,) = runner.list_runs(recordings)
    assert (run.facts["status"], run.facts["name"]) == ("finished", "dqn")
    steps, _, spaces = steps_of(run)
    assert len(steps) >= 360
    assert spaces["observation"]["shape"] == [4]
    assert sum(map(len, rewards)) == 360
    assert "reproduced" in verified(run)


def test_a_collector_is_the_same_with_and_without(recordings):
    def collected(record):
        env = TransformedEnv(GymEnv("CartPole-v1"), StepCounter())
        env.set_seed(5)
        torch.manual_seed(1)
        plain = collector(env)
        return [data.clone() for data in (torchrl.recorded(plain, name="x") if record else plain)]

    for one, other in zip(collected(False), collected(True), strict=True):
        assert (one == other).all()


@pytest.mark.parametrize("number", [0, 3])
def test_what_a_collector_yields_is_recorded(recordings, number):
    def make():
        return TransformedEnv(GymEnv("CartPole-v1"), RewardSum())

    env = SerialEnv(number, make) if number else make()
    env.set_seed(5)
    batches = [data.clone() for data in torchrl.recorded(collector(env), name="x")]
    (run,) = runner.list_runs(recordings)
    steps, resets, spaces = steps_of(run)
    n = number or 1
    data = torch.cat(batches, -1).reshape(n, -1)
    steps = steps.reshape(-1, n)
    assert run.facts["status"] == "finished"
    assert run.file.config["env"]["id"] == "CartPole-v1"
    assert "torchrl.record(env)" in verified(run)
    assert spaces["action"]["type"] == "Discrete"
    assert (steps["action"] == data["action"].argmax(-1).numpy().T).all()
    assert (steps["rewards"][..., 0] == data["next", "reward"][..., 0].numpy().T).all()
    assert (steps["terminated"] == data["next", "terminated"][..., 0].numpy().T).all()
    found = steps["next_observation"]["observation"]
    assert (found == data["next", "observation"].numpy().swapaxes(0, 1)).all()
    # The first observations of episodes are those that the policy saw, also at the edges of batches.
    for reset in resets:
        time, own = int(reset["step"]) // n, int(reset["environment"])
        if time < len(steps):
            assert (reset["observation"]["observation"] == data["observation"][own, time].numpy()).all()
    assert len(resets) > 5
    assert run.summary["episodes"] == int(data["next", "done"].sum())


def test_the_logger_logs_into_the_recording(recordings):
    env = torchrl.record(TransformedEnv(GymEnv("CartPole-v1"), StepCounter()))
    logger = torchrl.Logger("mine")
    collecting = collector(env)
    for i, data in enumerate(collecting):
        logger.log_scalar("reward", data["next", "reward"].mean(), step=i)
        logger.log_metrics({"loss": torch.tensor(0.5), "count": i}, step=i)
        logger.log_histogram("actions", data["action"].float(), step=i, bins="auto")
        logger.log_str("note", "text", step=i)
    logger.log_hparams({"lr": 1e-3})
    logger.close()
    collecting.shutdown()
    (run,) = runner.list_runs(recordings)
    with runner.open_recording(run.recording) as recording:
        names = [one["name"] for one in recording.table("/scalar").decoded()]
    assert names.count("reward") == names.count("loss") == names.count("count") == 4


def test_a_loop_that_is_left_early_is_finished(recordings):
    for _ in torchrl.recorded(collector(GymEnv("CartPole-v1")), name="x"):
        break
    (run,) = runner.list_runs(recordings)
    assert (run.facts["status"], run.summary["train_steps"]) == ("finished", 90)


def test_an_error_in_the_environment_is_that_of_the_run(recordings):
    class Breaks(gymnasium.Wrapper):
        def step(self, action):
            raise ValueError("mine")

    from torchrl.envs import GymWrapper

    env = torchrl.record(GymWrapper(Breaks(gymnasium.make("CartPole-v1"))), name="x")
    with pytest.raises(ValueError, match="mine"):
        env.rollout(3)
    env.close()
    (run,) = runner.list_runs(recordings)
    assert run.summary["train_steps"] == 0


def test_mistakes(recordings):
    from torchrl.envs import PendulumEnv

    with pytest.raises(ConfigError, match=r"PendulumEnv.*recorded\(collector\)"):
        torchrl.record(PendulumEnv())
    env = torchrl.record(GymEnv("CartPole-v1"))
    with pytest.raises(ConfigError, match="recorded already"):
        torchrl.record(env)
    with pytest.raises(ConfigError, match="found list"):
        torchrl.recorded([])
    with pytest.raises(ConfigError, match=r'expected "all".*torchrl\.record\(env, steps="actions"\)'):
        torchrl.recorded(collector(GymEnv("CartPole-v1")), steps="actions")


def test_an_environment_of_torchrl_itself(recordings):
    from torchrl.envs import PendulumEnv

    env = TransformedEnv(PendulumEnv(), StepCounter(max_steps=20))
    act = TensorDictModule(nn.Linear(1, 1), ["th"], ["action"])
    lift = TensorDictModule(lambda th: th.reshape(*th.shape, 1), ["th"], ["th_"])
    act = TensorDictSequential(lift, TensorDictModule(nn.Linear(1, 1), ["th_"], ["action"]))
    collecting = Collector(env, act, frames_per_batch=50, total_frames=100)
    batches = [data.clone() for data in torchrl.recorded(collecting, name="pendulum")]
    (run,) = runner.list_runs(recordings)
    steps, _, spaces = steps_of(run)
    assert set(spaces["observation"]["spaces"]) >= {"th", "thdot", "step_count"}
    assert (steps["next_observation"]["th"] == torch.cat(batches)["next", "th"].numpy()).all()


def pole():
    return TransformedEnv(GymEnv("CartPole-v1"), StepCounter())


def test_the_workers_of_a_parallel_environment_are_one_run(recordings):
    with torchrl.Recording(pole, name="parallel", seed=3) as recording:
        gc.collect()  # the environment that describes the others stays open
        env = ParallelEnv(2, recording.train)
        env.set_seed(3)
        collecting = Collector(env, frames_per_batch=100, total_frames=200)
        assert sum(data.numel() for data in collecting) == 200
        collecting.shutdown()
    (run,) = runner.list_runs(recordings)
    assert (run.status, run.summary["train_steps"]) == ("finished", 200)
    assert "reproduced" in verified(run)


def test_values_after_the_environment_is_closed_are_in_its_run(recordings):
    env = torchrl.record(GymEnv("CartPole-v1"), name="x")
    with SummaryWriter() as writer:
        collecting = collector(env, batches=1)
        assert sum(data.numel() for data in collecting) == 90
        collecting.shutdown()
        writer.add_scalar("loss", 0.5, 90)
    (run,) = runner.list_runs(recordings)
    assert (run.status, run.summary["train_steps"], run.summary["logged"]["loss"]) == ("finished", 90, 0.5)
