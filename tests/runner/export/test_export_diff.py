"""The pages about a difference and a comparison: self-contained, with the same content as the text."""

from __future__ import annotations

import html
import json
import re

import pytest
from click.testing import CliRunner

from runner.analysis.compare import compare
from runner.analysis.compare.moments import Moment
from runner.analysis.diff import diff
from runner.analysis.groups import grouped, metrics_of
from runner.analysis.series import read_series
from runner.cli import cli
from runner.export.reports.comparisons import render_comparison, render_diff
from runner.recording.reader import open_recording
from tests.runner.export.conftest import WORLDS
from tests.runner.export.outline import check_page


def page_of(a, b):
    with open_recording(a.recording) as left, open_recording(b.recording) as right:
        difference = diff(left, right)
        return difference, render_diff(difference, left, right)


def text_of(page):
    return re.sub(r"\s+", " ", html.unescape(re.sub(r"<[^>]*>", "", page)))


@pytest.mark.parametrize("world", ["taxi", "cliff", "corridor"])
def test_the_page_of_another_discount_shows_where_and_why_the_runs_part(world, pictured):
    difference, page = page_of(pictured(world), pictured(world, discount=0.7))
    check_page(page)
    text = text_of(page)
    divergence = difference.divergence
    assert f"They diverge in training episode {divergence.episode:,}, at t = {divergence.t}" in text
    assert "Why that update differs: the discount was" in text
    assert text.count("(greedy in A") >= 1
    assert text.count("(greedy in B") + text.count("greedy in A and B") >= 1
    drawn = world != "corridor"
    assert ("Before, in both: " in page) == drawn
    assert ('aria-label="Largest difference of' in page) == drawn
    assert '<h2 id="training-0-title">Training</h2>' in page
    assert "Difference of the Q-tables over training episodes" in page


@pytest.mark.parametrize("world", WORLDS)
def test_the_page_of_another_seed_shows_where_the_runs_part(world, pictured):
    difference, page = page_of(pictured(world), pictured(world, seed=5))
    check_page(page)
    assert f"at t = {difference.divergence.t}" in text_of(page)
    starts = difference.cause.kind == "start"
    drawn = page.count("B, at its start: " if starts else "B, after its step: ")
    assert (drawn > 0) == (world != "corridor")


def test_a_page_of_runs_that_hardly_have_anything_in_common_is_whole(pictured):
    for other in (
        pictured("lake"),
        pictured("rivals"),
        pictured("taxis", recording={"steps": "none"}, seed=2),
    ):
        _, page = page_of(pictured("taxis"), other)
        check_page(page)


def test_a_page_of_the_same_run_is_marked_as_such(pictured):
    _, page = page_of(pictured("taxis"), pictured("taxis"))
    check_page(page)
    assert "The content is the same" in page


def test_the_page_of_a_comparison_is_whole(pictured):
    runs = [pictured("rivals", seed=seed, discount=discount) for seed in (1, 2, 3) for discount in (0.7, 0.9)]
    series = []
    for run in runs:
        with open_recording(run.recording) as recording:
            series.append(read_series(recording))
    groups, notes = grouped(series)
    page = render_comparison(compare(groups, metrics_of(groups), Moment("last"), notes), groups)
    check_page(page)
    assert "rivals, discount=0.7: 3 runs" in page
    assert "fewer than 10 seeds" in page.lower()
    assert page.count('performance profile"') >= 2


@pytest.mark.parametrize("command", ["diff", "compare"])
def test_an_existing_page_is_replaced_by_force_only(command, pictured, tmp_path):
    runs = [pictured("taxi"), pictured("taxi", discount=0.5)]
    words = [command, *(str(run.recording) for run in runs), "--html", str(tmp_path / "page.html")]
    made = CliRunner().invoke(cli, words)
    assert made.exit_code == (command == "diff"), made.output
    again = CliRunner().invoke(cli, words)
    assert again.exit_code == 2
    assert "--force" in again.stderr
    assert CliRunner().invoke(cli, [*words, "--force"]).exit_code == (command == "diff")


@pytest.mark.parametrize("command", ["diff", "compare"])
def test_with_a_page_stdout_is_json_alone(command, pictured, tmp_path):
    runs = [pictured("taxi"), pictured("taxi", discount=0.5)]
    page = tmp_path / "page.html"
    words = [command, *(str(run.recording) for run in runs), "--html", str(page), "--json"]
    made = CliRunner().invoke(cli, words)
    assert json.loads(made.stdout)["files"] == [{"path": str(page), "bytes": page.stat().st_size}]
    assert f"{page}: " in made.stderr
    assert page.stat().st_size > 1000
