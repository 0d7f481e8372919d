"""Runs in a notebook: how they show themselves, and the tutorial's notebook, executed."""

from __future__ import annotations

import html
import json
import re
import sys
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

import runner
from runner.errors import MissingExtra
from runner.export.notebook import facts_html, plot, report, rerun_view, run_html

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
        patch.setitem(sys.modules, "matplotlib", None)
        shown = run_html(run)
    assert "[plots]" in shown
    assert run.run_id in shown
    assert "<iframe" not in shown
    gone = runner.Run(Path("/nowhere"), run.facts | {"name": "<b>"})
    assert run_html(gone) == facts_html(gone)
    assert "<b>" not in facts_html(gone)


def test_a_plot_is_a_picture(run):
    assert plot(run)._repr_html_().startswith("<svg")


def test_the_rerun_viewer_gets_the_run(monkeypatch, tmp_path):
    config = {"name": "taxi", "env": {"id": "Taxi-v4"}, "episodes": 4, "evaluation": None}
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    module = pytest.importorskip("rerun_notebook")
    sent = []
    monkeypatch.setattr(module.Viewer, "send_rrd", lambda _, data: sent.append(data))
    taxi = runner.run(config, recordings=tmp_path)
    assert isinstance(rerun_view(taxi), module.Viewer)
    assert sent[0].startswith(b"RRF")


def test_without_rerun_notebook_it_says_what_to_install(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun_notebook", None)
    with pytest.raises(MissingExtra, match=r"\[notebook\]"):
        rerun_view(run)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_the_notebook_runs_from_random_taxis_to_trained_ones(path, tmp_path):
    notebook = nbformat.read(path, as_version=4)
    assert all(not cell.get("outputs") for cell in notebook.cells), "keep it without outputs"
    NotebookClient(notebook, timeout=240, resources={"metadata": {"path": str(tmp_path)}}).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    shown = [output["data"].get("text/html", "") for output in outputs if "data" in output]
    assert sum("<iframe" in text for text in shown) == 3
    assert sum(text.startswith("<svg") for text in shown) == 1
    runs = {
        facts["name"]: facts["summary"]["last_evaluation"]
        for facts in map(json.loads, (file.read_text() for file in tmp_path.glob("recordings/*/run.json")))
    }
    assert runs["random"]["mean_length"] > 300
    assert runs["together"]["mean_length"] < 60
    assert runs["together"]["success_percent"] > 90
