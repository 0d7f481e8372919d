"""Plots: the panels show the recordings, files are valid, and errors are clear."""

from __future__ import annotations

import errno
import re
from statistics import mean

import numpy as np
import pytest
from click.testing import CliRunner

from runner.analysis.evaluations import evaluation_records
from runner.analysis.groups import groups_of, panels_of
from runner.analysis.series import RunSeries, read_series
from runner.cli import cli
from runner.errors import RunnerError
from runner.export.plots import chart
from runner.export.plots.chart import Text
from runner.export.plots.curves import curves_sheet, panel_chart
from runner.recording.reader import open_recording
from runner.runs.resolve import find_run
from tests.runner.recording.making import TAXIS, make_run, with_id


def series(*runs):
    found = []
    for run in runs:
        with open_recording(run.recording) as recording:
            found.append(read_series(recording))
    return found


@pytest.fixture
def seeds(pictured):
    return [pictured("rivals", seed=seed) for seed in (1, 2, 3)]


def plot(*words):
    return CliRunner().invoke(cli, ["plot", *map(str, words)])


def test_seeds_below_four_are_one_group_with_mean_and_range(seeds):
    (group,) = groups_of(series(*seeds))
    panel = next(panel for panel in panels_of([group]) if panel.metric == "mean_length")
    (curve,) = panel.curves
    lengths = []
    for run in seeds:
        with open_recording(run.recording) as recording:
            lengths.append([record.value("mean_length") for record in evaluation_records(recording)])
    assert curve.places.tolist() == [0, 20, 40]
    assert curve.middle.tolist() == pytest.approx([mean(each) for each in zip(*lengths, strict=True)])
    assert curve.low.tolist() == [min(each) for each in zip(*lengths, strict=True)]
    assert curve.high.tolist() == [max(each) for each in zip(*lengths, strict=True)]


def recorded_again(run, folder, run_id):
    """Return the same content, recorded under another id."""
    (folder / run_id).mkdir(parents=True)
    with_id(run_id, run.recording, folder / run_id / "recording.mcap")
    return find_run(run_id, folder)


def test_a_run_recorded_twice_counts_once_with_a_message(seeds, tmp_path):
    copies = [recorded_again(seeds[0], tmp_path, run_id) for run_id in ("again111", "again222")]
    (group,) = groups_of(series(*seeds, *copies))
    assert sorted(run.seed for run in group.runs) == [1, 2, 3]
    assert set(group.left_out) == {seeds[0].run_id, "again111"}
    assert "left out" in group.described
    done = plot(*(run.folder for run in (*copies, seeds[1])), "-o", tmp_path / "p.svg")
    assert done.exit_code == 0, done.output
    assert "Left out, as the same run is there: again111." in done.stderr
    assert "of 2 runs" in done.stdout


def test_loops_of_one_seed_are_all_drawn_unless_they_are_the_same():
    config = {"made_by": "runner.record"}
    runs = [RunSeries(f"loop{i}", "mine", 0, "finished", config, [], [], d) for i, d in enumerate("aab")]
    (group,) = groups_of(runs)
    assert [run.run_id for run in group.runs] == ["loop1", "loop2"]
    assert group.left_out == ("loop0",)


def test_every_metric_of_the_tutorial_and_every_event_has_a_panel(pictured):
    panels = panels_of(groups_of(series(pictured("taxis"))))
    metrics = {panel.metric for panel in panels}
    assert {"success_percent", "mean_length", "mean_penalties", "training.mean_length"} <= metrics
    assert {"training.percent_filled", "training.reward", "event.pickup", "event.collision"} <= metrics
    shares = next(panel for panel in panels if panel.metric == "training.reward")
    totals = sum(np.interp(shares.curves[0].places, c.places, c.middle) for c in shares.curves)
    assert totals == pytest.approx(np.full(len(totals), 100.0))


def test_groups_of_one_name_are_labelled_by_what_differs(pictured):
    one, other = pictured("lake"), pictured("lake", discount=0.5)
    labels = [group.label for group in groups_of(series(one, other))]
    assert labels[1] == "lake, discount=0.5"
    assert labels[0].startswith("lake, discount=")
    described = groups_of(series(one))[0].described
    assert one.run_id in described
    assert "seed 1" in described


def test_axes_are_honest(seeds, pictured):
    groups = groups_of(series(*seeds, pictured("taxis")))
    for panel in panels_of(groups):
        chart = panel_chart(panel, len(groups))
        low, high = chart.y.low, chart.y.high
        assert chart.x.low == 0
        assert not panel.percent or (low == 0 and 100 <= high <= 105)
        assert not panel.at_least_zero or low == 0
        assert low <= min(curve.low.min() for curve in panel.curves)
        assert high >= max(curve.high.max() for curve in panel.curves)


def test_the_figure_names_its_runs_and_what_bands_are(seeds, pictured):
    groups = groups_of(series(*seeds, pictured("taxis")))
    sheet = curves_sheet(groups, panels_of(groups))
    texts = [mark.text for mark in sheet.marks if isinstance(mark, Text)]
    assert any("interquartile mean" in text and "lowest" in text for text in texts)
    assert all(any(run.run_id in text for text in texts) for run in (*seeds, pictured("taxis")))


@pytest.mark.parametrize(("suffix", "magic"), [("png", b"\x89PNG"), ("svg", b"<?xml"), ("pdf", b"%PDF")])
def test_the_command_writes_the_file_once(pictured, tmp_path, suffix, magic):
    path = tmp_path / f"plot.{suffix}"
    result = plot(pictured("corridor", log=None).recording, "-o", path)
    assert result.exit_code == 0, result.output
    assert path.read_bytes().startswith(magic)
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


def test_a_file_is_replaced_by_force_only(pictured, tmp_path):
    path = tmp_path / "plot.svg"
    path.write_text("mine")
    result = plot(pictured("corridor", log=None).recording, "-o", path)
    assert (result.exit_code, path.read_text()) == (2, "mine")
    assert "--force" in result.stderr
    assert plot(pictured("corridor", log=None).recording, "-o", path, "--force").exit_code == 0
    assert path.read_text() != "mine"


def test_a_missing_folder_is_created(pictured, tmp_path):
    path = tmp_path / "new" / "folder" / "plot.svg"
    assert plot(pictured("corridor", log=None).recording, "-o", path).exit_code == 0
    assert path.stat().st_size > 10_000


def test_a_place_that_cannot_be_written_is_wrong_input(pictured, tmp_path):
    (tmp_path / "file").touch()
    result = plot(pictured("corridor", log=None).recording, "-o", tmp_path / "file" / "plot.svg")
    assert result.exit_code == 2
    assert f"{tmp_path / 'file'} is a file, expected a folder" in result.stderr


def test_a_full_disk_is_no_fault_of_the_input(pictured, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(chart, "save", full)
    result = plot(pictured("corridor", log=None).recording, "-o", tmp_path / "plot.svg")
    assert result.exit_code == 1
    assert "cannot be written (No space left on device)" in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_axis_smoothing_and_logarithms_are_options_of_plot_and_report(pictured, tmp_path):
    run = pictured("taxis")
    words = ("--axis", "steps", "--smooth", "10", "--log-x", "--log-y", "--lines")
    for command, name in (("plot", "p.svg"), ("report", "r.html")):
        path = tmp_path / name
        done = CliRunner().invoke(cli, [command, str(run.folder), *words, "-o", str(path)])
        assert done.exit_code == 0, done.output
        text = " ".join(re.sub(r"<[^>]*>", " ", path.read_text()).split())
        assert "memory of 10 % of the axis" in text
        assert "On logarithmic axes" in text
        assert "training steps" in text
    assert "expected a number from 0 to 100" in plot(run.folder, "--smooth", "101").stderr
    assert "a figure of its own" in plot(run.folder, "--normalise", "minmax", "--log-y").stderr


def test_a_name_stands_for_all_its_runs(pictured, tmp_path):
    runs = [pictured("lake", name="trio", seed=seed) for seed in (1, 2, 3)]
    words = ("trio", "--recordings", runs[0].folder.parent, "-o", tmp_path / "p.svg")
    assert "of 3 runs" in plot(*words).stdout
    few = ("seed > 1 and name == 'trio'", "--recordings", runs[0].folder.parent, "-o", tmp_path / "few.svg")
    assert "of 2 runs" in plot(*few).stdout


def test_errors_name_the_problem(pictured, tmp_path):
    assert "expected one of .png" in plot(pictured("lake").recording, "-o", tmp_path / "x.bmp").stderr
    assert "no run 'nobody'" in plot("nobody", "--recordings", tmp_path, "-o", tmp_path / "x.png").stderr
    silent = pictured("lake", evaluation=None, log=None)
    with pytest.raises(RunnerError, match=f"no metrics in {silent.run_id}"):
        panels_of(groups_of(series(silent)))


def test_a_missing_package_is_named(pictured, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "matplotlib", None)
    result = plot(pictured("lake").recording, "-o", tmp_path / "x.png")
    assert result.exit_code == 2
    assert "[plots]" in result.stderr


def test_where_success_is_unknown_there_is_no_panel_of_it(pictured):
    metrics = {panel.metric for panel in panels_of(groups_of(series(pictured("corridor"))))}
    assert "success_percent" not in metrics
    assert "mean_length" in metrics


def test_exact_measures_are_drawn_with_the_optimum(tmp_path):
    run = make_run(tmp_path, TAXIS, evaluation={"every": 20, "trials": 3, "exact": True})
    with open_recording(run.recording) as recording:
        panels = {panel.metric: panel for panel in panels_of(groups_of([read_series(recording)]))}
    assert panels["exact.value"].lines == ["", "optimum"]
    policy, optimum = panels["exact.value"].curves
    assert (policy.middle <= optimum.middle + 1e-9).all()
    assert panels["exact.to_gain"].lines == ["taxi_1", "taxi_2"]
