"""Logged values over axes: none is merged with another unless the output says so."""

from __future__ import annotations

import json

import gymnasium
import pytest
from click.testing import CliRunner

import runner
from runner.analysis.axes import STEPS, axis_of
from runner.analysis.groups import groups_of, panels_of
from runner.analysis.series import LOGGED, points_of, read_series, values_left_out
from runner.cli import cli
from runner.errors import RecordingError, RunnerError
from runner.integrations import wandb


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DUALTAXI_RECORDINGS", str(tmp_path / "recordings"))
    return tmp_path


def logged(calls, steps=None):
    """Log mappings in the shape of wandb; return the path of the recording."""
    wandb.init(project="logged", monitor_gym=False)
    for number, values in enumerate(calls):
        wandb.log(values, step=None if steps is None else steps[number])
    wandb.finish()
    return max(runner.list_runs(), key=lambda run: run.created).recording


def series_over(path, axis=STEPS.name, metrics=()):
    with runner.open_recording(path) as recording:
        return read_series(recording, axis_of(axis), metrics)


def curve(series, name):
    return points_of(series, f"{LOGGED}{name}", "", aligned=False)


@pytest.mark.parametrize("steps", [None, range(200), range(0, 2000, 10)])
@pytest.mark.parametrize("axis", ["episodes", "steps"])
def test_each_call_is_a_point_at_its_step(axis, steps):
    series = series_over(logged(({"loss": 1 / (i + 1)} for i in range(200)), steps), axis)
    assert curve(series, "loss") == {at: 1 / (i + 1) for i, at in enumerate(steps or range(200))}
    assert (series.axis.label, series.averaged) == ("steps", "")
    (panel,) = panels_of(groups_of([series]))
    assert len(panel.curves[0].places) == 200


def test_many_calls_are_means_and_the_output_says_so():
    series = series_over(logged({"loss": float(i)} for i in range(2_000)))
    assert curve(series, "loss") == {at: at - 4.5 for at in range(9, 2_000, 10)}
    assert series.averaged == "Means over stretches of 10 steps."


def test_any_logged_name_that_does_not_decrease_is_an_axis():
    path = logged({"epoch": i // 2, "loss": float(i), "lr": -i} for i in range(10))
    series = series_over(path, "epoch")
    assert curve(series, "loss") == {epoch: 2 * epoch + 0.5 for epoch in range(5)}
    assert (series.axis.label, series.averaged) == ("epoch", "Values at the same position are averaged.")
    with pytest.raises(RecordingError, match="found -1 logged as 'lr' at training step 1"):
        series_over(path, "lr")
    with pytest.raises(RunnerError, match=r"axis: found 'stps', .* Did you mean 'steps'"):
        series_over(path, "stps")


def test_names_beyond_the_first_64_are_read_by_name():
    path = logged([{f"m{i}": float(i) for i in range(100)}])
    series = series_over(path)
    assert len(series.names) == 100
    (sentence,) = values_left_out([series])
    assert "other names than the first 64 that were logged: 36 values. Choose others" in sentence
    chosen = series_over(path, metrics=[f"{LOGGED}m99"])
    assert curve(chosen, "m99") == {0: 99.0}
    assert not values_left_out([chosen])


@pytest.mark.parametrize("name", ["m70", f"{LOGGED}m70"])
def test_a_logged_value_is_compared_by_its_name(name):
    ids = []
    for seed in range(2):
        with runner.record(gymnasium.make("CartPole-v1"), seed=seed, config={"lr": seed}) as env:
            ids.append(env.run.run_id)
            env.reset(seed=0)
            env.step(0)
            for i in range(100):
                env.log(f"m{i}", float(seed))
    done = CliRunner().invoke(cli, ["compare", *ids, "--metric", name, "--json"])
    assert done.exit_code == 0, done.output
    (metric,) = json.loads(done.stdout)["metrics"]
    assert metric["metric"] == f"{LOGGED}m70"
    assert [group["values"] for group in metric["groups"]] == [[0.0], [1.0]]
    done = CliRunner().invoke(cli, ["compare", *ids, "--metric", f"{name}x"])
    assert done.exit_code == 2
    assert "training.mean_length" in done.output
    assert f"found '{name}x', expected one of m0, m1, " in done.output
    assert "Did you mean 'm70'?" in done.output


def test_a_run_of_values_alone_is_plotted_over_its_steps():
    logged({"epoch": i, "loss": float(i)} for i in range(5))
    for arguments in ([], ["--axis", "epoch"]):
        done = CliRunner().invoke(cli, ["plot", "logged", "-o", "a.svg", "--force", *arguments])
        assert done.exit_code == 0, done.output
    done = CliRunner().invoke(cli, ["plot", "logged", "-o", "b.svg", "--axis", "epohc"])
    assert done.exit_code == 2
    assert "found 'epohc', expected one of" in done.output
