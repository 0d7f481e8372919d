"""Plots and page of a sweep."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest
from click.testing import CliRunner
from sweeping import Here, described, digests, swept

from runner.analysis.groups import panels_of
from runner.archive.runs import archive_run
from runner.cli import cli
from runner.config import from_mapping
from runner.errors import RunnerError
from runner.export.plots.chart import Markers
from runner.runs.run import list_runs
from runner.sweep import state
from runner.sweep.charts import drawn_trials, learning, panel_of, parameter_chart
from runner.sweep.model import from_values
from runner.sweep.results import fresh_seeds, results_of


@pytest.fixture(scope="module")
def results(done, sweep):
    return results_of(sweep.name, done[0])


def typed(*words):
    result = CliRunner().invoke(cli, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    return result


def test_each_trial_is_drawn_at_its_values(results, done):
    drawn = drawn_trials(results)
    by_number = {trial.number: trial for trial in done[1].done}
    assert drawn.trials[0].number == done[2].best.number
    step_size, discount = drawn.axes
    for place, choice, value, trial in zip(
        step_size.values, discount.values, drawn.values, drawn.trials, strict=True
    ):
        trial_there = by_number[trial.number]
        assert place == trial_there.values["step_size"]
        assert discount.choices[int(choice)] == str(trial_there.values["discount"])
        assert value == trial_there.value
    assert all(low <= value <= high for value, (low, high) in zip(drawn.values, drawn.ranges, strict=True))


def test_a_pruned_trial_is_hollow(results):
    def hollow(entries):
        drawn = drawn_trials(replace(results, ranking=entries))
        marks = parameter_chart(drawn, drawn.axes[0]).marks
        dots = [mark for mark in marks if isinstance(mark, Markers) and not mark.fill]
        return sum(len(mark.points) for mark in dots), "A hollow one was pruned" in drawn.footnote

    *kept, last = results.ranking
    assert hollow(results.ranking) == (0, False)
    assert hollow([*kept, replace(last, state="pruned")]) == (1, True)


def test_the_learning_curves_are_those_of_the_runs(results, done):
    groups = learning(results, done[0])
    best = next(group for group in groups if group.label.startswith("best"))
    assert {run.run_id for run in best.runs} == set(results.ranking[0].runs.values())
    panel = panel_of("training.mean_reward", panels_of(groups))
    curve = next(curve for curve in panel.curves if groups[curve.group] is best)
    assert curve.middle[-1] == pytest.approx(results.ranking[0].median)


@pytest.mark.parametrize("suffix", ["png", "svg", "pdf"])
def test_a_sweep_is_drawn_by_its_name(done, tmp_path, suffix):
    output = tmp_path / f"small.{suffix}"
    result = typed("plot", "small", "-o", output, "--recordings", done[0])
    assert "the sweep small, 6 trials" in result.stdout
    assert output.stat().st_size > 10_000


def test_the_page_of_a_sweep_is_self_contained(done, results, tmp_path):
    output = tmp_path / "small.html"
    typed("report", "small", "-o", output, "--recordings", done[0])
    page = output.read_text()
    for title in ("step_size", "discount", "Learning curves", "Ranking", "The best configuration"):
        assert title in page
    assert not re.search(r"(src|href)=.(https?:)?//", page)
    assert results.best_yaml.splitlines()[0] in page
    ids = re.findall(r'\bid="([^"]+)"', page)
    assert len(ids) == len(set(ids))


def test_fresh_seeds_are_unused_also_at_the_end_of_their_range():
    assert fresh_seeds([5, 0, 7]) == list(range(8, 18))
    assert fresh_seeds([2**64 - 1, 1]) == [0, *range(2, 11)]


def test_the_best_configuration_is_that_of_the_best_trial_with_steps_and_fresh_seeds(results, done):
    import yaml

    config = from_mapping(yaml.safe_load(results.best_yaml))
    assert (config.name, config.recording.steps) == ("small_best", "all")
    assert (
        from_mapping(done[2].best.config).to_mapping()
        | {
            "name": "small_best",
            "seeds": list(range(2, 12)),
            "recording": config.to_mapping()["recording"],
        }
        == config.to_mapping()
    )


def test_a_sweep_without_finished_trials_cannot_be_drawn(tmp_path):
    sweep = from_values(described())
    state.begin(sweep, tmp_path, resume=False, accept_changes=False)
    with pytest.raises(RunnerError, match="no finished trial yet"):
        drawn_trials(results_of(sweep.name, tmp_path))


def test_duplicate_values_are_shown_once(tmp_path):
    sweep = from_values(described(strategy="random", trials=8, parameters={"discount": [0.5, 0.9]}))
    swept(tmp_path, sweep)
    results = results_of(sweep.name, tmp_path)
    assert len(results.ranking) == 2
    assert sum(1 + len(entry.duplicates) for entry in results.ranking) == 8


def test_a_level_never_reached_is_not_drawn(tmp_path):
    objective = {
        "metric": "training.percent_filled",
        "at": "first_over",
        "level": 101,
        "direction": "minimize",
    }
    sweep = from_values(described(objective=objective, trials=3))
    trials, _ = swept(tmp_path, sweep)
    assert len(digests(trials)) == 3
    with pytest.raises(RunnerError, match="nothing to draw"):
        drawn_trials(results_of(sweep.name, tmp_path))


def test_a_sweep_of_archived_runs_is_complete(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    sweep, folder = from_values(described(strategy="random", trials=2, seeds=[0])), tmp_path / "runs"
    before, ended = swept(folder, sweep)
    for run in list_runs(folder):
        archive_run(run, str(tmp_path / "archive"), remove=True)
    assert {run.status for run in list_runs(folder)} == {"archived"}
    results = results_of(sweep.name, folder)
    assert results.best.value == ended.best.value
    assert len(learning(results, folder)) == 2
    nobody = Here()
    again, _ = swept(folder, sweep, nobody)
    assert (nobody.done, digests(again)) == (0, digests(before))
