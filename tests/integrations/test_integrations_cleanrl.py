"""CleanRL's own scripts, recorded by a change of one import."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import runner
from runner.execution.verify import verify
from runner.integrations import wandb
from runner.integrations.tensorboard import SummaryWriter
from runner.recording.schema import SCALAR_TOPIC

SCRIPTS = Path(__file__).parent / "cleanrl"
WRITER = ("from torch.utils.tensorboard import", "from runner.integrations.tensorboard import")
WANDB = ("import wandb\n", "from runner.integrations import wandb\n")
BUFFER = ("from cleanrl_utils.buffers import", "from stable_baselines3.common.buffers import")
"""CleanRL's copy of the replay buffer; it is not part of the change."""


def execute(name, changes, *arguments):
    """Run a script in the current folder, with some of its lines changed; return what it printed."""
    source = (SCRIPTS / f"{name}.py").read_text()
    for before, after in changes:
        assert source.count(before) == 1
        source = source.replace(before, after)
    Path(f"{name}.py").write_text(source)
    paths = [str(SCRIPTS), str(Path(runner.__file__).parents[1]), os.environ.get("PYTHONPATH", "")]
    done = subprocess.run(
        [sys.executable, f"{name}.py", *arguments],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def recorded(name, changes, *arguments):
    """Run a script; return the run that it recorded."""
    execute(name, changes, *arguments)
    (run,) = runner.list_runs()
    return run


def series(run, name):
    """Return (steps, the script's own steps) of the values that were logged under a name."""
    steps, own, last = [], [], None
    with runner.open_recording(run.recording) as recording:
        for scalar in recording.table(SCALAR_TOPIC).decoded():
            if scalar["name"] == "global_step":
                last = scalar["value"]
            elif scalar["name"] == name:
                steps.append(scalar["step"])
                own.append(last)
    return steps, own


@pytest.mark.parametrize(
    ("changes", "track"),
    [([WRITER], "False"), ([WANDB], "True"), ([WRITER, WANDB], "True")],
    ids=["writer", "wandb", "both"],
)
def test_ppo_is_recorded_whole(changes, track, recordings):
    run = recorded("ppo", changes, "--total-timesteps", "1024", "--track", track)
    assert run.status == "finished"
    assert run.name.startswith("CartPole-v1__ppo__1__")
    assert run.seed == 1
    settings = run.facts["config"]["config"]
    assert (settings["learning_rate"], settings["num_envs"], settings["target_kl"]) == (2.5e-4, 4, None)
    assert run.summary["train_steps"] == 1024
    assert series(run, "losses/value_loss") == ([512, 1024], [512.0, 1024.0])
    verdict = verify(run.recording)
    assert (verdict.verdict, verdict.reason) == ("reproduced", "")


def test_recording_does_not_change_what_ppo_learns(recordings):
    last = "    envs.close()\n"
    report = (last, f"    print(v_loss.item(), agent.critic[0].weight.sum().item())\n{last}")
    plain = execute("ppo", [report], "--total-timesteps", "1024")
    assert runner.list_runs() == []
    assert (
        execute("ppo", [report, WRITER], "--total-timesteps", "1024").splitlines()[-1]
        == plain.splitlines()[-1]
    )
    assert len(runner.list_runs()) == 1


def test_dqn_is_recorded_whole(recordings):
    arguments = ["--total-timesteps", "1000", "--learning-starts", "400"]
    run = recorded("dqn", [WRITER, BUFFER], *arguments)
    assert run.summary["train_steps"] == 1000
    steps, own = series(run, "losses/td_loss")
    assert own == [500.0, 600.0, 700.0, 800.0, 900.0]
    assert steps == [step + 1 for step in own]
    assert verify(run.recording).verdict == "reproduced"


def test_tensors_are_logged_and_pictures_of_them_recorded(recordings):
    import torch

    with SummaryWriter(monitor_gym=False) as writer:
        weight = torch.nn.Linear(2, 2).weight
        writer.add_scalar("loss", weight.sum() * 0 + 2, torch.tensor(7))
        writer.add_scalar("half", torch.tensor(1.5, dtype=torch.bfloat16), 7)
        writer.add_histogram("weight", weight, 7)
        writer.add_image("picture", torch.rand(3, 4, 4), 7)
    (run,) = runner.list_runs()
    assert run.summary["logged"] == {"loss": 2.0, "half": 1.5}
    assert run.summary["messages"]["/image"] == 1
    assert series(run, "loss")[0] == [7]


def test_a_vector_of_envpool_is_recorded(recordings):
    import envpool

    envs = envpool.make_gymnasium("CartPole-v1", num_envs=2, seed=1)
    with SummaryWriter() as writer:
        envs.reset()
        for step in range(50):
            envs.step(np.zeros(2, np.int64))
            writer.add_scalar("step", step, 2 * step)
    (run,) = runner.list_runs()
    assert run.summary["train_steps"] == 100


def test_values_go_into_the_run_of_an_adapter(recordings):
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback

    wandb.init(project="sb3", sync_tensorboard=True, config={"lr": 1.0})
    model = PPO("MlpPolicy", "CartPole-v1", n_steps=64, device="cpu")

    class Logging(BaseCallback):
        def _on_step(self):
            wandb.log({"double": 2.0 * self.num_timesteps})
            return True

    model.learn(128, callback=[runner.integrations.sb3.Recording(name="adapted"), Logging()])
    wandb.log({"after": 1.0})
    wandb.finish()
    runs = {run.name: run.summary for run in runner.list_runs()}
    assert (runs["adapted"]["train_steps"], runs["adapted"]["logged"]["double"]) == (128, 256.0)
    assert (runs["sb3"]["train_steps"], runs["sb3"]["logged"]) == (0, {"after": 1.0})
    assert len(runs) == 2
