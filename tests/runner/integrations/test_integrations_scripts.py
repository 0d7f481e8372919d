"""Scripts whose environments are recorded by changing one import: which environment, and into which run."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from scripts import SETTINGS, TABLE, learn, make, scalars, texts, the_run

import runner
from runner.analysis.series import points_of, read_series
from runner.errors import ConfigError, EnvironmentNotUsable
from runner.execution.verify import verify
from runner.integrations import wandb
from runner.integrations.tensorboard import SummaryWriter


@pytest.mark.parametrize("vector", [SyncVectorEnv, AsyncVectorEnv])
def test_a_script_of_cleanrl_is_recorded_whole_by_the_import(vector):
    writer = SummaryWriter("runs/CartPole-v1__ppo__3__1700000000")
    writer.add_text("hyperparameters", TABLE)
    envs = vector([make] * 4)
    learn(envs, lambda step, value: writer.add_scalar("losses/value_loss", value, step))
    writer.close()
    run = the_run()
    assert (run.name, run.seed, run.status) == ("CartPole-v1__ppo__3__1700000000", 3, "finished")
    assert run.summary["train_steps"] == 200
    assert run.facts["config"]["config"] == SETTINGS
    assert "learning_rate" in texts(run)["hyperparameters"]
    assert scalars(run) == [
        (name, value, 4 * step)
        for step in range(10, 51, 10)
        for name, value in (("global_step", 4 * step), ("losses/value_loss", 1 / step))
    ]
    assert verify(run.recording).verdict == "reproduced"


def test_the_environment_may_be_made_before_the_writer():
    env = make()
    with SummaryWriter() as writer:
        learn(env, lambda step, value: writer.add_scalar("loss", value, step))
        assert writer.run.run_id == the_run().run_id
    assert the_run().summary["train_steps"] == 50
    assert the_run().name == "CartPole-v1"


def test_the_script_keeps_its_environment_and_its_results():
    def trajectory():
        env = make()
        env.reset(seed=1)
        return type(env), [env.step(1)[0].tolist() for _ in range(5)]

    alone = trajectory()
    with SummaryWriter() as writer:
        writer.add_scalar("x", 1.0)
        assert trajectory() == alone


def test_steps_after_the_writer_is_closed_are_not_recorded():
    env = make()
    writer = SummaryWriter()
    env.reset(seed=1)
    env.step(0)
    writer.close()
    env.step(0)
    env.reset()
    assert the_run().summary["train_steps"] == 1


def test_copies_of_the_environment_are_not_recorded_and_are_copies():
    env = make()
    with SummaryWriter():
        env.reset(seed=1)
        for other in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
            expected = np.array(env.unwrapped.state)
            other.step(1)
            assert (np.array(env.unwrapped.state) == expected).all()
            assert (np.array(other.unwrapped.state) != expected).any()
        env.step(1)
    assert the_run().summary["train_steps"] == 1


def test_only_the_environment_that_is_reset_first_is_recorded_and_the_next_gets_a_warning():
    first, second = make(), make()
    with SummaryWriter():
        first.reset(seed=1)
        first.step(1)
        with pytest.warns(RuntimeWarning, match="records the environment that was reset first"):
            second.reset(seed=2)
        second.step(1)
    assert the_run().summary["train_steps"] == 1


def test_environments_that_are_not_recorded_give_one_warning_in_all():
    with SummaryWriter():
        make().reset(seed=1)
        with pytest.warns(RuntimeWarning, match="and no other") as found:
            make().reset(seed=2)
        SyncVectorEnv([make] * 2).reset(seed=3)  # a second warning would be an error
    assert len(found) == 1


def test_classes_have_their_own_reset_unless_a_run_has_to_see_which_environments_are_reset():
    classes = (gymnasium.Env, gymnasium.Wrapper, gymnasium.wrappers.TimeLimit, SyncVectorEnv)
    own = [vars(cls)["reset"] for cls in classes]

    def are_own():
        assert ("__init_subclass__" in vars(gymnasium.Env)) is (vars(gymnasium.Env)["reset"] is not own[0])
        return [vars(cls)["reset"] for cls in classes] == own

    first = make()
    with SummaryWriter():
        assert not are_own()
        first.reset(seed=1)
        first.step(1)
        with pytest.warns(RuntimeWarning, match="and no other"):
            make().reset(seed=2)
        assert are_own()
        first.reset()
        first.step(1)
    assert the_run().summary["train_steps"] == 2
    with runner.open_recording(the_run().recording) as recording:
        assert recording.train.resets.count() == 2
    assert not {"reset", "step"} & set(vars(first))
    with SummaryWriter("runs/values", monitor_gym=False) as writer:
        writer.add_scalar("a", 1.0, 1)
        assert are_own()
    with SummaryWriter("runs/again"):
        make().reset(seed=1)
    assert are_own()


def test_steps_before_the_writer_was_made_give_a_warning():
    env = make()
    env.reset(seed=1)
    env.step(0)
    with SummaryWriter():
        with pytest.warns(RuntimeWarning, match="1 steps of its last episode"):
            env.reset()
        env.step(0)
    assert the_run().summary["train_steps"] == 1


def test_values_after_the_end_of_the_run_give_one_warning_and_are_not_recorded():
    wandb.init()
    joined = SummaryWriter()
    joined.add_scalar("a", 1, 1)
    wandb.finish()
    writer = SummaryWriter()
    writer.add_scalar("a", 1, 1)
    writer.close()
    for closed in (joined, writer):
        with pytest.warns(RuntimeWarning, match="is closed"):
            closed.add_scalar("b", 1, 51)
        closed.add_histogram("c", np.arange(5))  # a second warning would be an error
        closed.add_hparams({"lr": 1}, {"d": 1.0})
    assert [run.summary["logged"] for run in runner.list_runs()] == [{"a": 1.0}] * 2


def test_the_summary_of_wandb_is_recorded_without_finish(folder):
    script = (
        "from runner.integrations import wandb; wandb.init(); wandb.log({'a': 1}); wandb.summary['best'] = 7"
    )
    subprocess.run([sys.executable, "-c", script], check=True)
    assert the_run().status == "finished"
    assert the_run().summary["logged"] == {"a": 1.0, "summary/best": 7.0}


def test_the_nearest_of_all_arguments_is_suggested():
    with pytest.raises(ConfigError, match=r"found the argument 'seeds'.* Did you mean 'seed'\?"):
        runner.record(make(), seeds=1)
    with pytest.warns(RuntimeWarning, match=r"'here' has no effect here. Did you mean 'recordings'\?"):
        SummaryWriter(recording="here").close()
    with pytest.raises(ConfigError, match=r"found the argument 'frames_of', expected one of [^?]*\.$"):
        runner.record(make(), frames_of=0)


def test_each_writer_has_a_run_of_its_own_with_its_own_environment():
    for seed in (1, 2):
        with SummaryWriter(f"runs/seed{seed}") as writer:
            env = make()
            env.reset(seed=seed)
            env.step(0)
            writer.add_scalar("seed", seed)
    runs = {run.name: run for run in runner.list_runs()}
    assert {name: run.summary["logged"] for name, run in runs.items()} == {
        "seed1": {"seed": 1.0},
        "seed2": {"seed": 2.0},
    }


def test_values_go_into_the_loop_that_the_script_records_itself():
    writer = SummaryWriter()
    writer.add_scalar("before", 1.0)
    with runner.record(make(), name="own") as env:
        env.reset(seed=1)
        env.step(0)
        writer.add_scalar("loss", 0.5, 1)
        writer.close()
        env.step(0)
    run = the_run()
    assert (run.name, run.summary["train_steps"]) == ("own", 2)
    assert run.summary["logged"] == {"before": 1.0, "global_step": 1.0, "loss": 0.5}


def test_values_after_the_end_of_a_loop_go_into_the_next_one():
    with SummaryWriter("runs/rest") as writer:
        for name in ("first", "second"):
            with runner.record(make(), name=name) as env:
                env.reset(seed=1)
                env.step(0)
                writer.add_scalar("loss", 0.5, 1)
    assert {run.name: run.summary["logged"] for run in runner.list_runs()} == {
        "first": {"global_step": 1.0, "loss": 0.5},
        "second": {"global_step": 1.0, "loss": 0.5},
    }


def test_values_without_an_environment_are_a_run_of_their_own():
    with SummaryWriter("runs/regression") as writer:
        for step in range(0, 100, 10):
            writer.add_scalars("loss", {"train": 1 / (step + 1), "test": 2 / (step + 1)}, step)
    run = the_run()
    assert (run.name, run.status, run.summary["train_steps"]) == ("regression", "finished", 0)
    assert scalars(run)[:3] == [("loss/train", 1.0, 0), ("loss/test", 2.0, 0), ("loss/train", 1 / 11, 10)]
    assert verify(run.recording).reason == "No steps were recorded."
    with runner.open_recording(run.recording) as recording:
        series = read_series(recording)
    assert series.axis.name == "steps"
    assert points_of(series, "training.logged.loss/train", "", aligned=False)[20] == 1 / 21


def test_options_of_recording_can_be_given():
    env = gymnasium.make("CartPole-v1", render_mode="rgb_array")
    with SummaryWriter(steps="actions", frames_every=10, index="chunk"):
        env.reset(seed=1)
        env.step(0)
    with runner.open_recording(the_run().recording) as recording:
        assert recording.train.frames.count() == 1
        assert recording.config["recording"]["steps"] == "actions"
    with pytest.warns(RuntimeWarning, match="the argument step='actions' has no effect here"):
        SummaryWriter(step="actions").close()


def test_many_values_do_not_wait_for_an_environment_for_ever():
    writer = SummaryWriter("runs/many")
    for step in range(10_000):
        writer.add_scalar("loss", 0.5, step)
    assert the_run().status == "running"
    writer.close()
    assert len(scalars(the_run())) == 10_000


def test_an_environment_is_not_recorded_if_the_script_says_so():
    with SummaryWriter(monitor_gym=False) as writer:
        writer.add_scalar("loss", 0.5, 1)
        make().reset(seed=1)
    assert the_run().summary["train_steps"] == 0


class Several(gymnasium.Env):
    """Pays several rewards at once, which no recording holds."""

    observation_space = action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {}

    def step(self, action):
        return 0, np.array([1.0, 2.0]), False, False, {}


class Unnamed(Several):
    """Has a part of observations whose name cannot be printed."""

    observation_space = gymnasium.spaces.Dict({"\n": gymnasium.spaces.Discrete(2)})

    def reset(self, *, seed=None, options=None):
        return {"\n": 0}, super().reset(seed=seed)[1]


def test_an_environment_that_cannot_be_recorded_leaves_the_values():
    envs = SyncVectorEnv([Unnamed] * 2)
    with SummaryWriter("runs/missions") as writer:
        with pytest.warns(RuntimeWarning, match="the environment was left out: .*found a part called"):
            envs.reset(seed=1)
        for step in range(20):
            writer.add_scalar("loss", 0.5, step)
        envs.reset(seed=1)  # a second warning would be an error
    assert [step for *_, step in scalars(the_run())] == list(range(20))


def test_a_step_that_cannot_be_recorded_leaves_the_values():
    env = Several()
    wandb.init(project="several")
    env.reset(seed=1)
    wandb.log({"before": 1.0})
    with pytest.warns(RuntimeWarning, match="recording stopped at step 0, and the loop went on without it"):
        env.step(0)
    with pytest.warns(RuntimeWarning, match="has ended: further values go into run"):
        wandb.log({"reward": env.step(0)[1][0]})
    for _ in range(9):
        wandb.log({"reward": env.step(0)[1][0]})
    wandb.finish()
    assert {run.status: len(scalars(run)) for run in runner.list_runs()} == {"failed": 1, "finished": 10}


def test_an_error_is_raised_only_if_the_script_asks_for_it():
    envs = SyncVectorEnv([Unnamed] * 2)
    with SummaryWriter(on_error="raise"), pytest.raises(EnvironmentNotUsable, match="found a part called"):
        envs.reset()
