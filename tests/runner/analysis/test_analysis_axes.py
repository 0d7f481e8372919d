"""Metrics are read over episodes, training steps and updates, and runs are compared at the same step."""

from __future__ import annotations

import json
import time

import gymnasium
import numpy as np
import pytest
from click.testing import CliRunner

import runner
from runner.analysis.axes import AXES, EPISODES, STEPS, TIME, UPDATES, edges_of
from runner.analysis.series import read_series
from runner.cli import cli
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.machine import read_clock
from runner.recording.reader import open_recording

STEPS_TAKEN = 2_000


def record(folder, name, seed, *, every=50, updates=True, **config):
    """Record random steps with a loss and a number of updates logged at regular steps."""
    env = runner.record(gymnasium.make("CartPole-v1"), recordings=folder, name=name, seed=seed, config=config)
    env.action_space.seed(seed)
    env.reset(seed=seed)
    for step in range(1, STEPS_TAKEN + 1):
        *_, terminated, truncated, _ = env.step(env.action_space.sample())
        if step % every == 0:
            env.log("loss", 1 / step)
            if updates:
                env.log("train/n_updates", 4 * step // every)
        if terminated or truncated:
            env.reset()
    env.close()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("axes")
    for seed in range(2):
        record(made, "often", seed, lr=1)
        record(made, "seldom", seed, every=400, lr=2)
    record(made, "silent", 0, updates=False, lr=3)
    return made


def series(folder, name, axis):
    run = next(run for run in runner.list_runs(folder) if run.name == name)
    with open_recording(run.recording) as recording:
        episodes = recording.train.episodes.array()
        return read_series(recording, axis), episodes


def command(folder, *words):
    return CliRunner().invoke(cli, [*words, "--recordings", str(folder)])


def test_episodes_are_at_the_step_at_which_they_end(folder):
    over_steps, episodes = series(folder, "often", STEPS)
    points = {
        place: r["training.mean_length"][""]
        for place, r in over_steps.training
        if "training.mean_length" in r
    }
    edges = np.arange(0, STEPS_TAKEN + 10, 10)
    stretch = np.searchsorted(edges, episodes["last_step"] + 1)
    expected = {int(edges[k]): episodes["length"][stretch == k].mean() for k in np.unique(stretch)}
    assert points == pytest.approx(expected)


def test_logged_values_are_at_their_steps_and_updates(folder):
    by_step, _ = series(folder, "often", STEPS)
    losses = {
        place: r["training.logged.loss"][""] for place, r in by_step.training if "training.logged.loss" in r
    }
    assert losses == pytest.approx({step: 1 / step for step in range(50, STEPS_TAKEN + 1, 50)})
    by_update, _ = series(folder, "often", UPDATES)
    last, readings = by_update.training[-1]
    assert last == 4 * STEPS_TAKEN // 50
    assert readings["training.logged.loss"][""] == pytest.approx(1 / STEPS_TAKEN)
    assert all(isinstance(place, int) for place, _ in by_update.training)


def test_evaluations_of_a_job_are_at_the_steps_recorded_with_them(taxis):
    with open_recording(taxis.recording) as recording:
        metrics = recording.eval.all_metrics()
        over_steps, over_episodes = read_series(recording, STEPS), read_series(recording)
        assert read_series(recording, UPDATES).training == over_steps.training
    assert [place for place, _ in over_steps.evaluation] == [one["step"] for one in metrics]
    assert [r for _, r in over_steps.evaluation] == [r for _, r in over_episodes.evaluation]


def test_values_logged_in_evaluation_are_where_training_was(tmp_path):
    env = runner.record(gymnasium.make("CartPole-v1"), recordings=tmp_path, name="tested", seed=1)
    env.reset(seed=1)
    for _ in range(100):
        *_, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()
    with env.phase("eval"):
        env.reset(seed=2)
        for _ in range(7):
            *_, terminated, truncated, _ = env.step(env.action_space.sample())
            if terminated or truncated:
                env.reset()
        env.log("score", 5.0)
    env.close()
    for axis in (STEPS, EPISODES):
        (run,) = runner.list_runs(tmp_path)
        with open_recording(run.recording) as recording:
            own = read_series(recording, axis)
            ended = recording.train.episodes.count()
        (place,) = [place for place, r in own.training if "training.logged.score (eval)" in r]
        assert place == (100 if axis is STEPS else ended)


def test_a_run_without_the_axis_is_refused_with_advice(folder, tmp_path):
    with pytest.raises(
        RecordingError, match=r'nothing was logged as updates or n_updates; rec.log\("updates"'
    ):
        series(folder, "silent", UPDATES)
    refused = command(folder, "plot", "often", "silent", "--axis", "updates", "-o", str(tmp_path / "a.svg"))
    assert refused.exit_code == 2
    assert "has no axis of updates" in refused.stderr
    assert not list(tmp_path.iterdir())


def test_wall_time_is_that_of_the_clock(tmp_path):
    env = runner.record(gymnasium.make("CartPole-v1"), recordings=tmp_path, name="slow", seed=1)
    env.reset(seed=1)
    for step in range(1, 60):
        *_, terminated, truncated, _ = env.step(step % 2)
        if step == 30:
            time.sleep(1.2)
        if terminated or truncated:
            env.reset()
    env.close()
    (run,) = runner.list_runs(tmp_path)
    with open_recording(run.recording) as recording:
        clock, episodes = read_clock(recording), recording.train.episodes.array()
        over_time = read_series(recording, TIME)
    ends = clock.seconds_at(episodes["last_step"] + 1)
    assert clock.duration >= 1.2
    edges = edges_of(TIME, clock.duration, 200)
    assert [place for place, _ in over_time.training] == edges[
        np.unique(np.searchsorted(edges, ends))
    ].tolist()
    assert 0 < edges[1] < 1


def test_an_evaluation_is_at_the_time_at_which_it_began(taxis):
    with open_recording(taxis.recording) as recording:
        clock = read_clock(recording)
        over_time = read_series(recording, TIME)
        began = [
            recording.train.episodes.array(e - 1, e)["log_time"][0] if e else 0
            for e in (one["episode"] for one in recording.eval.all_metrics())
        ]
    times = clock.seconds_at(np.array(began, np.int64) // schema.STEP_NANOSECONDS)
    assert [place for place, _ in over_time.evaluation] == pytest.approx(times.tolist(), abs=1e-3)


def test_a_run_of_several_processes_has_no_wall_time(tmp_path):
    with runner.record(gymnasium.make("CartPole-v1"), recordings=tmp_path, name="several", seed=1) as env:
        other = runner.record(gymnasium.make("CartPole-v1"), join=env.run, shard="other")
        for each in (env, other):
            each.reset(seed=1)
            each.step(0)
        other.close()
    (run,) = runner.list_runs(tmp_path)
    with open_recording(run.recording) as recording:
        assert read_series(recording, STEPS).axis is STEPS
        with pytest.raises(RecordingError, match="several processes took its steps at the same time"):
            read_series(recording, TIME)


def test_updates_that_go_back_or_are_no_numbers_are_no_axis(tmp_path):
    for name, values in (("back", [3, 2]), ("nan", [float("nan")]), ("endless", [float("inf")])):
        env = runner.record(gymnasium.make("CartPole-v1"), recordings=tmp_path, name=name, seed=0)
        env.reset(seed=0)
        for value in values:
            env.step(0)
            env.log("updates", value)
        env.close()
        with pytest.raises(RecordingError, match="expected numbers that do not decrease"):
            series(tmp_path, name, UPDATES)


def test_two_loops_are_compared_after_the_same_number_of_steps(folder):
    compared = command(
        folder,
        "compare",
        "often",
        "seldom",
        "--metric",
        "training.logged.loss",
        "--at-step",
        "1000",
        "--json",
    )
    assert compared.exit_code == 0, compared.output
    result = json.loads(compared.stdout)
    assert result["moment"] == "after 1,000 training steps"
    often, seldom = result["metrics"][0]["groups"]
    assert often["values"] == pytest.approx([1 / 1000] * 2)
    assert seldom["values"] == pytest.approx([(1 / 800 + 1 / 1200) / 2] * 2)  # between two of its points


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (
            ["--at-step", "9000"],
            "found no values after 9,000 training steps; the nearest are those after 2,000",
        ),
        (["--at-step", "10", "--axis", "steps"], "excludes axis and moment"),
        (["--axis", "step"], "Did you mean 'steps'?"),
        (["--axis", "steps", "--moment", "1.5"], "or a number of training steps"),
    ],
)
def test_what_cannot_be_compared_at_a_step_is_reported(folder, words, expected):
    refused = command(folder, "compare", "often", "seldom", "--metric", "training.logged.loss", *words)
    assert refused.exit_code == 2
    assert expected in refused.stderr


def test_plot_and_report_name_the_axis(folder, tmp_path):
    for axis in AXES.values():
        out = tmp_path / f"{axis.name}.svg"
        assert command(folder, "plot", "often", "--axis", axis.name, "-o", str(out)).exit_code == 0
        assert out.read_text().count(f">{axis.label}<") == 4
    page = tmp_path / "page.html"
    assert command(folder, "report", "often", "--axis", "steps", "-o", str(page)).exit_code == 0
    assert "Return of training episodes over training steps" in page.read_text()


def test_an_unknown_axis_is_refused(folder, tmp_path):
    done = command(folder, "plot", "often", "--axis", "stpes", "-o", str(tmp_path / "x.svg"))
    assert done.exit_code == 2
    assert "found 'stpes', expected one of episodes" in done.output
    assert "Did you mean 'steps'" in done.output


@pytest.mark.parametrize("last", [0, 1, 199, 200, 201, 333, 1_999, 123_456, 10**12])
def test_stretches_are_few_whole_and_reach_the_end(last):
    edges = edges_of(EPISODES, last, 200)
    width = edges[1]
    assert str(int(width)).strip("0") in ("1", "2", "5")
    assert len(edges) <= 201
    assert edges[-2] < max(last, 1) <= edges[-1]
