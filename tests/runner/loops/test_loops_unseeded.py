"""A loop without a seed is never shown, compared or found as one of seed 0."""

from __future__ import annotations

from pathlib import Path

import pytest

import runner
from runner.analysis.compare.sections import unpaired
from runner.analysis.groups import groups_of
from runner.analysis.series import read_series
from runner.errors import RunNotFound
from runner.recording.reader import open_recording
from runner.runs.run import Run
from tests.runner.loops.making import make, play


def loop(folder: Path, seed: int | None, lr: float = 0.1, play_seed: int = 3) -> Run:
    with runner.record(make("FrozenLake-v1"), folder, name="lake", seed=seed, config={"lr": lr}) as env:
        for _ in play(env, 60, seed=play_seed):
            pass
        env.log("loss", lr)
    return env.run


def test_a_recording_is_titled_by_its_seed_only_if_it_has_one(tmp_path):
    for seed, title in ((None, "lake"), (0, "lake, seed 0"), (4, "lake, seed 4")):
        run = loop(tmp_path, seed)
        with open_recording(run.recording) as recording:
            assert (recording.seed, recording.title, run.title) == (seed, title, title)


def test_an_ambiguous_name_lists_no_seed_of_loops_without_one(tmp_path):
    loop(tmp_path, None)
    loop(tmp_path, None)
    with pytest.raises(RunNotFound, match="lake") as raised:
        runner.find_run("lake", tmp_path)
    assert "seed" not in str(raised.value)


def test_a_report_shows_no_seed_of_loops_without_one(tmp_path):
    pytest.importorskip("jinja2")
    from runner.export.reports.report import render_report

    page, _ = render_report([loop(tmp_path, seed).recording for seed in (None, 5)])
    assert "seed 5" in page
    assert "seed 0" not in page
    assert "seed None" not in page


def test_loops_without_a_seed_are_neither_averaged_nor_paired(tmp_path):
    from runner.analysis.compare import compare
    from runner.analysis.compare.moments import moment_of

    runs = [loop(tmp_path, None, lr, seed) for lr in (0.1, 0.2) for seed in (1, 2)]
    series = []
    for run in runs:
        with open_recording(run.recording) as recording:
            series.append(read_series(recording))
    groups = groups_of(series)
    assert [one.seed for one in series] == [None] * 4
    assert all("seed" not in group.described for group in groups)
    moment, metrics = moment_of("last", None, ["training.mean_return"])
    found = compare(groups, [(metric, "") for metric in metrics], moment)
    values = found.metrics[0]
    assert [group.n for group in values.groups] == [2, 2]
    assert all(pair.seeds == [] for pair in values.pairs)
    assert "only runs with a seed can be paired" in " ".join(unpaired(values.pairs))
