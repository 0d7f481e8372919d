"""Scripts that log in the shape of TensorBoard and of wandb, recorded by changing one import."""

from __future__ import annotations

import copy
import os
import pickle
import subprocess
import sys
import textwrap
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from click.testing import CliRunner
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv

import runner
from runner.analysis.series import points_of, read_series, values_left_out
from runner.cli import cli
from runner.errors import ConfigError, RunnerError
from runner.execution.redo import verify_by_redoing
from runner.integrations import wandb
from runner.integrations.script import MAX_NAMES
from runner.integrations.tensorboard import SummaryWriter
from runner.recording.schema import SCALAR_TOPIC

SETTINGS = {"env_id": "CartPole-v1", "seed": 3, "learning_rate": 2.5e-4, "target_kl": None, "exp_name": "ppo"}
TABLE = "|param|value|\n|-|-|\n" + "\n".join(f"|{key}|{value}|" for key, value in SETTINGS.items())


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Run each test in a folder of its own, with its recordings; no run stays open."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DUALTAXI_RECORDINGS", str(tmp_path / "recordings"))
    yield tmp_path
    if wandb.run is not None:
        wandb.finish()


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
        return [(each["name"], each["value"], each["step"]) for each in recording.decoded(SCALAR_TOPIC)]


def texts(run):
    with runner.open_recording(run.recording) as recording:
        return {each["name"]: each["message"] for each in recording.decoded(recording.topic("/log"))}


def arrays(run):
    with runner.open_recording(run.recording) as recording:
        return {each.name: each.values for each in recording.arrays()}


def images(run):
    with runner.open_recording(run.recording) as recording:
        topic = recording.topic("/image")
        return [(each["frame_id"], each["format"], each["data"]) for each in recording.decoded(topic)]


# --- a SummaryWriter ---------------------------------------------------------------------------------------


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
    assert verify_by_redoing(run.recording).verdict == "reproduced"


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
    with pytest.raises(ConfigError, match=r"Did you mean 'recordings'\?"):
        SummaryWriter(recording="here")


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
    assert verify_by_redoing(run.recording).reason == "No steps were recorded."
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
        assert recording.count(recording.topic("/train/frame")) == 1
        assert recording.config["recording"]["steps"] == "actions"
    with pytest.raises(ConfigError, match="found the argument 'step', expected one of chunk_steps"):
        SummaryWriter(step="actions")


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


def test_numbers_of_every_kind_are_logged_and_others_refused():
    with SummaryWriter() as writer:
        for value in (1, True, np.int64(3), np.array([0.5], np.float32), np.nan, np.inf):
            writer.add_scalar("x", value)
        with pytest.raises(ConfigError, match="found str for 'x', expected a number"):
            writer.add_scalar("x", "text")
        with pytest.raises(ConfigError, match="global_step: found 'two'"):
            writer.add_scalar("x", 1.0, "two")
    np.testing.assert_equal([value for _, value, _ in scalars(the_run())], [1, 1, 3, 0.5, np.nan, np.inf])


def test_histograms_pictures_films_and_figures_are_recorded():
    from matplotlib.figure import Figure

    figure = Figure(figsize=(1, 1), dpi=50)
    with SummaryWriter() as writer:
        writer.add_histogram("weights", np.arange(128.0), 5)
        writer.add_image("chw", np.zeros((3, 8, 6), np.uint8), 5)
        writer.add_image("hw", np.ones((8, 6)), 5, dataformats="HW")
        writer.add_images("four", np.zeros((4, 1, 8, 6)), 5)
        writer.add_video("film", np.zeros((2, 5, 3, 8, 6), np.uint8), 5, fps=10)
        writer.add_figure("figure", figure, 5)
        with pytest.raises(ConfigError, match=r"found shape \[8, 6\], expected the axes CHW"):
            writer.add_image("bad", np.zeros((8, 6)))
    found = arrays(the_run())
    assert found["weights/counts"].sum() == 128
    assert found["weights/edges"].shape == (65,)
    assert [(name, kind) for name, kind, _ in images(the_run())] == [
        *(("chw", "png"), ("hw", "png"), ("four", "png"), ("film", "webp"), ("figure", "png"))
    ]


def test_pictures_keep_their_pixels():
    import io

    from PIL import Image

    pixels = np.random.default_rng(0).integers(0, 256, (8, 6, 3), np.uint8)
    with SummaryWriter() as writer:
        writer.add_image("a", pixels, dataformats="HWC")
        writer.add_image("b", pixels.transpose(2, 0, 1) / 255.0 + 1e-6)
        writer.add_video("c", np.stack([pixels, 255 - pixels])[None].transpose(0, 1, 4, 2, 3))
    for name, _, data in images(the_run()):
        image = Image.open(io.BytesIO(data))
        assert image.size == ((6, 8))
        if name != "c":
            assert (np.asarray(image) == pixels).all()
        else:
            assert image.n_frames == 2


def test_what_a_recording_has_no_place_for_says_so_once():
    with SummaryWriter() as writer:
        with pytest.warns(RuntimeWarning, match="add_graph does nothing"):
            writer.add_graph(None)
        writer.add_graph(None)  # a second warning would be an error
        with pytest.raises(AttributeError, match="no 'add_nothing', but add_scalar"):
            writer.add_nothing()


def test_hyperparameters_of_tensorboard_are_the_settings():
    with SummaryWriter() as writer:
        writer.add_hparams({"lr": 0.1}, {"score": 2.0})
    assert the_run().facts["config"]["config"] == {"lr": 0.1}
    assert the_run().summary["logged"] == {"score": 2.0}


def test_the_folder_that_the_script_names_is_there_for_its_own_files(folder):
    with SummaryWriter("runs/ALE/Pong-v5__ppo__1") as writer:
        writer.add_scalar("x", 1.0)
        assert (folder / writer.get_logdir()).is_dir()
    assert the_run().name == "ALE/Pong-v5__ppo__1"


def test_names_are_bounded():
    with SummaryWriter() as writer:
        for number in range(MAX_NAMES):
            writer.add_scalar(f"step {number}", 1.0)
        with pytest.warns(RuntimeWarning, match="more than 10,000 names"):
            writer.add_scalar("one more", 1.0)
        writer.add_scalar("another", 1.0)
    assert len({name for name, *_ in scalars(the_run())}) == MAX_NAMES
    with runner.open_recording(the_run().recording) as recording:
        series = read_series(recording)
    (sentence,) = values_left_out([series])
    assert "other names than the first 64 that were logged: 9,936 values" in sentence


# --- wandb -------------------------------------------------------------------------------------------------


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
    assert verify_by_redoing(run.recording).verdict == "reproduced"
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
    wandb.log({"film": wandb.Video(np.zeros((3, 3, 4, 4), np.uint8), fps=5)})
    wandb.log({"histogram": wandb.Histogram([1, 2, 3]), "given": wandb.Histogram(np_histogram=([1], [0, 2]))})
    wandb.log({"table": wandb.Table(columns=["a", "b"], data=[[1, "x"]]), "text": "hello", "array": [1, 2]})
    with pytest.warns(RuntimeWarning, match="found object for 'thing', which is recorded as text"):
        wandb.log({"thing": object()})
    with pytest.warns(RuntimeWarning, match="None is not recorded, first found for 'nothing'"):
        wandb.log({"nothing": None})
    wandb.finish()
    run = the_run()
    assert [name for name, *_ in images(run)] == ["image", "pair/0", "pair/1", "film"]
    assert texts(run)["image/caption"] == "black"
    assert texts(run)["table"] == '{"columns": ["a", "b"], "data": [[1, "x"]]}'
    assert set(arrays(run)) >= {"histogram/counts", "given/edges", "array"}


def test_a_summary_has_the_last_values_and_what_the_script_puts_there():
    with wandb.init(monitor_gym=False) as run:
        run.log({"loss": 0.5})
        assert run.summary["loss"] == 0.5
        run.summary["best"] = 3
    assert the_run().summary["logged"] == {"loss": 0.5, "summary/best": 3.0}


def test_calls_without_effect_say_so_once_and_unknown_names_what_there_is(monkeypatch):
    monkeypatch.setattr(wandb, "_warned", set())
    wandb.init()
    with pytest.warns(RuntimeWarning, match="wandb.watch does nothing"):
        wandb.watch(None)
    wandb.run.watch(None, log="all")  # a second warning would be an error
    with pytest.raises(AttributeError, match="does not have 'sweep'"):
        wandb.sweep  # noqa: B018
    with pytest.raises(AttributeError, match="has no 'log_artifact', but config"):
        wandb.run.log_artifact  # noqa: B018
    wandb.finish()
    with pytest.raises(ConfigError, match="found the argument 'projekt', expected one of"):
        wandb.init(projekt="x")


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
    wandb.init(project="synced", sync_tensorboard=True, monitor_gym=False)
    with tensorboard.SummaryWriter("runs/x") as writer:
        writer.add_scalar("loss", 0.5, 7)
    wandb.finish()
    assert scalars(the_run()) == [("loss", 0.5, 7)]
    with tensorboard.SummaryWriter("runs/x") as writer:
        writer.add_scalar("loss", 0.5, 8)
    assert len(runner.list_runs()) == 1


# --- how scripts end ---------------------------------------------------------------------------------------

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
        assert recording.count(recording.topic("/train/step")) == 1


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
    assert "logged loss" in shown
    assert "id: none" not in shown
    assert "steps a second" not in shown
    assert "digest" in verified
    assert "environment" not in verified
