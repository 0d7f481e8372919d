"""Runs in a notebook: how they show themselves, and the tutorial's notebook, executed."""

from __future__ import annotations

import html
import json
import re
import sys
from pathlib import Path

import nbformat
import pytest

import runner
from docs.notebooks.store_outputs import execute, reproducible
from runner.errors import MissingExtra
from runner.export.notebook import facts_html, plot, report, rerun_view, run_html
from runner.export.reports.rendering import templates

NOTEBOOKS = sorted((Path(__file__).parents[1] / "docs" / "notebooks").glob("*.ipynb"))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    config = {"name": "lake", "env": {"id": "FrozenLake-v1"}, "episodes": 20}
    config |= {"evaluation": {"every": 10, "trials": 4}}
    return runner.run(config, recordings=tmp_path_factory.mktemp("noted"))


def test_a_run_shows_its_report_in_a_frame_of_its_own(run):
    shown = run_html(run)
    (page,) = re.findall(r'srcdoc="([^"]*)"', shown)
    assert run.run_id in shown
    assert "<h2" in html.unescape(page)
    assert "allow-same-origin" not in shown
    assert report(run, height=300).html.count('height="300"') == 1


def test_without_packages_or_recording_it_shows_its_facts(run, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "jinja2", None)
        templates.cache_clear()
        shown = run_html(run)
    assert "[plots]" in shown
    assert run.run_id in shown
    assert "<iframe" not in shown
    gone = runner.Run(Path("/nowhere"), run.facts | {"name": "<b>"})
    assert run_html(gone) == facts_html(gone)
    assert "<b>" not in facts_html(gone)


def test_a_plot_is_a_picture(run):
    assert plot(run)._repr_png_().startswith(b"\x89PNG")


def test_the_slider_is_above_the_picture_and_the_result_above_the_frame(run):
    shown = run_html(run)
    assert ".scrub { order: -1;" in html.unescape(shown)
    assert re.match(
        r"<p><b>lake, seed 0</b>, last evaluation: [\d.]+ % of trials succeed, [\d.]+ steps", shown
    )


def test_the_rerun_viewer_gets_the_run(monkeypatch, tmp_path):
    config = {"name": "taxi", "env": {"id": "Taxi-v4"}, "episodes": 4, "evaluation": None}
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    module = pytest.importorskip("rerun_notebook")
    sent = []
    monkeypatch.setattr(module.Viewer, "send_rrd", lambda _, data: sent.append(data))
    taxi = runner.run(config, recordings=tmp_path)
    assert isinstance(rerun_view(taxi), module.Viewer)
    assert sent[0].startswith(b"RRF")


def test_without_rerun_notebook_the_error_names_the_extra(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun_notebook", None)
    with pytest.raises(MissingExtra, match=r"\[notebook\]"):
        rerun_view(run)


@pytest.mark.long
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_the_notebook_runs_from_random_taxis_to_trained_ones(path, tmp_path):
    notebook = execute(path, tmp_path)
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    shown = [output["data"].get("text/html", "") for output in outputs if "data" in output]
    assert sum("<iframe" in text for text in shown) == 3
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 1
    runs = {
        facts["name"]: facts["summary"]["last_evaluation"]
        for facts in map(json.loads, (file.read_text() for file in tmp_path.glob("recordings/*/run.json")))
    }
    assert runs["random"]["mean_length"] > 300
    assert runs["together"]["mean_length"] < 60
    assert runs["together"]["success_percent"] > 90
    stored = nbformat.read(path, as_version=4)
    assert texts_of(stored) == texts_of(reproducible(notebook)), "run docs/notebooks/store_outputs.py"


def texts_of(notebook):
    """Return what cells print and show as text; pictures differ with the versions of libraries."""
    return [
        output.get("text")
        or {kind: data for kind, data in output["data"].items() if kind.startswith("text/")}
        for cell in notebook.cells
        for output in cell.get("outputs", [])
    ]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_notebook_is_stored_with_outputs_that_name_no_machine(path):
    text = path.read_text("utf-8")
    assert len(text) < 1 << 20
    assert '"image/png"' in text
    assert "<iframe" not in text
    assert str(Path.home()) not in text
