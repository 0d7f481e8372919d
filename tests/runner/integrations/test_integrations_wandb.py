"""Scripts that log in the shape of wandb."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import textwrap
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner
from gymnasium.vector import SyncVectorEnv
from scripts import SETTINGS, arrays, images, learn, make, scalars, texts, the_run

import runner
from runner.cli import cli
from runner.errors import RunnerError
from runner.execution.verify import verify
from runner.integrations import shapes, wandb
from runner.integrations.tensorboard import SummaryWriter


def test_a_script_of_wandb_is_recorded_whole_by_the_import():
    wandb.init(
        project="cartpole",
        entity="me",
        config=SimpleNamespace(**SETTINGS),
        name="a run",
        group="seeds",
        tags=["baseline"],
        notes="the first",
        monitor_gym=True,
        save_code=True,
    )
    run_id = wandb.run.id
    envs = SyncVectorEnv([make] * 2)
    learn(envs, lambda step, value: wandb.log({"losses": {"value": value}, "global_step": step}))
    wandb.finish()
    run = the_run()
    assert (run.run_id, run.name, run.seed, run.note) == (run_id, "a-run", 3, "the first")
    assert run.tags == ("baseline", "group=seeds", "project=cartpole")
    assert run.facts["config"]["config"] == SETTINGS
    assert run.summary["train_steps"] == 100
    assert scalars(run)[-2:] == [("losses/value", 1 / 50, 100), ("global_step", 100.0, 100)]
    assert verify(run.recording).verdict == "reproduced"
    assert wandb.run is None


def test_a_writer_logs_into_the_run_of_wandb_and_its_end_is_finish():
    wandb.init(project="both", sync_tensorboard=True, config=SETTINGS)
    writer = SummaryWriter("runs/other")
    learn(make(), lambda step, value: writer.add_scalar("loss", value, step))
    writer.close()
    assert the_run().status == "running"
    wandb.finish()
    assert (the_run().name, the_run().summary["logged"]["loss"]) == ("both", 1 / 50)


def test_settings_are_read_and_changed_by_item_and_attribute():
    run = wandb.init(config={"lr": 0.1})
    wandb.config.batch = 32
    wandb.config["layers"] = [64, 64]
    wandb.config.update({"lr": 0.2}, allow_val_change=True)
    wandb.config.setdefaults({"lr": 0.3, "gamma": 0.9})
    assert (wandb.config.lr, wandb.config["batch"], run.config.get("none", 7)) == (0.2, 32, 7)
    with pytest.raises(AttributeError, match="config has no 'rate', but lr, batch"):
        wandb.config.rate  # noqa: B018
    wandb.log({"loss": 1.0})
    wandb.finish()
    expected = {"lr": 0.2, "batch": 32, "layers": [64, 64], "gamma": 0.9}
    assert the_run().facts["config"]["config"] == expected


def test_settings_that_json_cannot_hold_become_text_with_one_warning():
    with pytest.warns(RuntimeWarning, match=r"config: device, model\.activation are recorded as text"):
        wandb.init(config={"device": object(), "model": {"activation": len}, "array": np.arange(2), "f": 1.5})
    wandb.log({"loss": 1.0})
    wandb.finish()
    found = the_run().facts["config"]["config"]
    assert found["array"] == [0, 1]
    assert found["model"]["activation"] == "<built-in function len>"


@pytest.mark.parametrize("has_environment", [True, False])
def test_a_value_that_cannot_be_recorded_does_not_end_a_training_that_prefers_a_warning(has_environment):
    wandb.init(on_error="warn", monitor_gym=has_environment)
    if has_environment:
        make().reset(seed=0)
    with pytest.warns(RuntimeWarning, match="a value was left out"):
        wandb.log({"\ud800": 1.0})
    wandb.finish()
    assert the_run().status == "finished"


def test_settings_after_the_recording_began_are_logged_as_text():
    wandb.init()
    env = make()
    env.reset(seed=0)
    with pytest.warns(RuntimeWarning, match="found settings after the recording began"):
        wandb.config.late = 5
    wandb.finish()
    assert texts(the_run())["config"] == '{"late": 5}'


def test_steps_are_counted_where_no_environment_is_recorded():
    wandb.init(project="regression", monitor_gym=False)
    wandb.log({"a": 0.0})
    wandb.log({"a": 1.0}, commit=False)
    wandb.log({"b": 1.0})
    wandb.log({"a": 7.0}, step=7)
    wandb.log({"a": 8.0}, step=7)
    wandb.finish()
    assert scalars(the_run()) == [
        ("a", 0.0, 0),
        ("a", 1.0, 1),
        ("b", 1.0, 1),
        ("a", 7.0, 7),
        ("a", 8.0, 7),
    ]


def test_values_of_every_kind_are_logged():
    wandb.init(monitor_gym=False)
    wandb.log({"image": wandb.Image(np.zeros((4, 4), np.uint8), caption="black")})
    wandb.log({"pair": [wandb.Image(np.zeros((4, 4, 3))), wandb.Image(np.ones((4, 4, 3)))]})
    wandb.log({"histogram": wandb.Histogram([1, 2, 3]), "given": wandb.Histogram(np_histogram=([1], [0, 2]))})
    wandb.log({"text": "hello", "array": [1, 2]})
    wandb.define_metric("loss", step_metric="epoch")
    with pytest.warns(RuntimeWarning, match="found object for 'thing', which is recorded as text"):
        wandb.log({"thing": object()})
    with pytest.warns(RuntimeWarning, match="None is not recorded, first found for 'nothing'"):
        wandb.log({"nothing": None})
    wandb.finish()
    run = the_run()
    assert [name for name, *_ in images(run)] == ["image", "pair/0", "pair/1"]
    assert texts(run)["image/caption"] == "black"
    assert texts(run)["text"] == "hello"
    assert set(arrays(run)) >= {"histogram/counts", "given/edges", "array"}


def test_a_summary_has_the_last_values_and_what_the_script_puts_there():
    with wandb.init(monitor_gym=False) as run:
        run.log({"loss": 0.5})
        assert run.summary["loss"] == 0.5
        run.summary["best"] = 3
    assert the_run().summary["logged"] == {"loss": 0.5, "summary/best": 3.0}


def test_what_a_recording_has_no_place_for_does_nothing_with_one_warning_each(monkeypatch):
    monkeypatch.setattr(shapes, "_warned", set())
    run = wandb.init(monitor_gym=False)
    with pytest.warns(RuntimeWarning, match="wandb.watch does nothing"):
        wandb.watch(None)
    run.watch(None, log="all")  # a second warning would be an error

    def train():
        artifact = wandb.Artifact("policy", type="model")
        artifact.add_file("policy.pt")
        artifact.metadata["score"] = 1.0
        run.log_artifact(artifact).wait()
        wandb.alert(title="done", text="done")
        wandb.agent(wandb.sweep({}), function=print)
        wandb.log({"curve": wandb.plot.line(None, "x", "y"), "loss": 1.0})
        assert not isinstance(artifact, wandb.Audio)
        table = wandb.Table(columns=["a"])
        table.add_data(1)
        wandb.log({"rows": table})
        assert not run.url
        for _ in wandb.Api().runs("me/project"):
            raise AssertionError

    with pytest.warns(RuntimeWarning) as found:
        train()
    ignored = ("Artifact", "log_artifact", "alert", "agent", "sweep", "plot", "Audio", "Table", "url", "Api")
    kinds = [f"wandb.{name} does nothing" for name in ignored]
    kinds.insert(6, "log: wandb.plot is not recorded, first found for 'curve'")
    kinds.insert(9, "log: wandb.Table is not recorded, first found for 'rows'")
    assert len(found) == len(kinds)
    assert all(kind in str(each.message) for kind, each in zip(kinds, found, strict=True))
    wandb.finish()
    assert scalars(the_run()) == [("loss", 1.0, 0)]


def test_values_that_cannot_be_recorded_lose_no_others():
    wandb.init(monitor_gym=False, config={"lr": 0.1, "text": "\ud800"})
    with pytest.warns(RuntimeWarning, match="a setting was left out: config: 'text': 'utf-8' codec"):
        wandb.log({"loss": 0.75})
    with pytest.warns(RuntimeWarning, match=r"a value was left out: picture: none\.png cannot be read"):
        wandb.log({"file": wandb.Image("none.png"), "image": wandb.Image(3), "loss": 0.5})
    with pytest.warns(RuntimeWarning, match="a step was left out: found the step -1"):
        wandb.log({"loss": 0.25}, step=-1)
    with pytest.warns(RuntimeWarning, match="found str, expected a mapping of names"):
        wandb.log("loss")
    wandb.log({"loss": 0.125}, step=2**61)
    wandb.finish()
    assert [value for _, value, _ in scalars(the_run())] == [0.75, 0.5, 0.25, 0.125]
    assert the_run().facts["config"]["config"] == {"lr": 0.1}


@pytest.mark.parametrize("has_environment", [True, False])
def test_each_call_is_a_step_also_while_an_environment_is_awaited(has_environment):
    wandb.init(monitor_gym=None if has_environment else False)
    for number in range(200):
        wandb.log({"loss": 1 / (number + 1)}, commit=False)
        wandb.log({"accuracy": number / 200})
    wandb.finish()
    found = scalars(the_run())
    assert [step for name, _, step in found if name == "loss"] == list(range(200))
    assert [step for name, _, step in found if name == "accuracy"] == list(range(200))


def test_a_run_that_is_resumed_is_followed_by_one_that_names_it(monkeypatch):
    monkeypatch.setattr(shapes, "_warned", set())
    for value in (1.0, 2.0):
        with contextlib.ExitStack() as stack:
            if value == 2.0:
                stack.enter_context(pytest.warns(RuntimeWarning, match="with this id is not continued"))
            run = wandb.init(id="mine", resume="allow", notes="longer", monitor_gym=False)
            assert (run.id, run.resumed) == ("mine", False)
            run.log({"loss": value})
            run.finish()
    second, first = sorted(runner.list_runs(), key=lambda run: run.created, reverse=True)
    assert (first.note, second.note) == ("longer", f"Follows run {first.run_id}.\nlonger")
    assert scalars(first) == [("loss", 1.0, 0)]


def test_there_must_be_a_run():
    for use in (lambda: wandb.log({"a": 1}), lambda: wandb.config, lambda: wandb.summary):
        with pytest.raises(RunnerError, match="no run is open: call wandb"):
            use()
    wandb.finish()


def test_a_second_init_returns_the_open_run_or_finishes_it():
    first = wandb.init(monitor_gym=False)
    with pytest.warns(RuntimeWarning, match="is still open, and is returned"):
        assert wandb.init() is first
    first.log({"a": 1.0})
    second = wandb.init(reinit=True, monitor_gym=False)
    second.log({"a": 2.0})
    wandb.finish(exit_code=1)
    assert {run.run_id: run.status for run in runner.list_runs()} == {
        first.id: "finished",
        second.id: "failed",
    }


def test_disabled_records_nothing(folder):
    wandb.init(mode="disabled", config={"a": 1})
    wandb.log({"a": 1.0})
    make().reset(seed=0)
    wandb.finish()
    assert runner.list_runs() == []


def test_another_writer_is_followed(monkeypatch):
    tensorboard = pytest.importorskip("tensorboardX")
    assert sys.modules["tensorboardX.writer"]
    own = tensorboard.SummaryWriter.add_scalar
    wandb.init(project="synced", sync_tensorboard=True, monitor_gym=False)
    with tensorboard.SummaryWriter("runs/x") as writer:
        writer.add_scalar("loss", 0.5, 7)
    wandb.finish()
    assert scalars(the_run()) == [("loss", 0.5, 7)]
    assert tensorboard.SummaryWriter.add_scalar is own
    with tensorboard.SummaryWriter("runs/x") as writer:
        writer.add_scalar("loss", 0.5, 8)
    assert len(runner.list_runs()) == 1


SCRIPT = """
import gymnasium, os, sys
from runner.integrations import wandb
wandb.init(project="end")
env = gymnasium.make("CartPole-v1")
env.reset(seed=0)
env.step(0)
wandb.log({"loss": 0.5})
"""


@pytest.mark.parametrize(
    ("ending", "status", "error"),
    [("", "finished", None), ("1 / 0", "failed", "ZeroDivisionError"), ("os._exit(1)", "interrupted", None)],
)
def test_a_script_that_does_not_finish_its_run(ending, status, error, folder):
    (folder / "script.py").write_text(SCRIPT + "import time; time.sleep(1.5)\n" + ending)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run([sys.executable, "script.py"], capture_output=True, check=False, env=environment)
    run = the_run()
    assert run.status == status
    assert error is None or error in run.summary["error"]
    with runner.open_recording(run.recording) as recording:
        assert recording.train.steps.count() == 1


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork here")
def test_a_forked_process_logs_nothing(folder):
    program = """
    pid = os.fork()
    if not pid:
        import warnings
        warnings.simplefilter("error", DeprecationWarning)
        wandb.log({"loss": 1.0})
        env.step(0)
        other = gymnasium.make("CartPole-v1")
        other.reset()
        sys.exit()
    os.waitpid(pid, 0)
    wandb.log({"loss": 2.0})
    """
    (folder / "script.py").write_text(SCRIPT + textwrap.dedent(program))
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        [sys.executable, "script.py"], capture_output=True, check=True, env=environment, text=True
    )
    assert "belongs to the process that this one was forked from" in done.stderr
    assert [value for _, value, _ in scalars(the_run())] == [0.5, 2.0]
    assert the_run().summary["train_steps"] == 1


def test_a_run_with_pictures_and_actions_alone_is_repaired():
    with SummaryWriter("runs/pictured", steps="actions") as writer:
        learn(make(), lambda step, value: writer.add_image("view", np.zeros((3, 4, 4), np.uint8), step))
    path = the_run().recording
    os.truncate(path, path.stat().st_size - 1000)
    done = CliRunner().invoke(cli, ["repair", "pictured"])
    assert done.exit_code == 0, done.output
    assert "5 pictures" in done.output
    assert "actions" in done.output


def test_a_run_without_an_environment_is_shown_without_one(tmp_path, monkeypatch):
    monkeypatch.setenv("DUALTAXI_RECORDINGS", str(tmp_path))
    with SummaryWriter(str(tmp_path / "runs" / "x")) as writer:
        writer.add_scalar("loss", 1.0, 1)
    shown, verified = (CliRunner().invoke(cli, [command, "@latest"]).output for command in ("show", "verify"))
    assert "Logged last: loss" in shown
    assert "id: none" not in shown
    assert "steps a second" not in shown
    assert "digest" in verified
    assert "environment" not in verified
