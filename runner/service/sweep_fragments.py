"""Parts of the pages of sweeps that take long to compute, for child processes: HTML."""

from __future__ import annotations

import contextlib
import importlib
import os
import sys
import threading
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from markupsafe import Markup

from runner.analysis.sections import Grid, Section
from runner.errors import RunnerError
from runner.export.plots.curves import footnote, panel_plots
from runner.export.reports.rendering import partials
from runner.service.settings import without_folders
from runner.sweep.charts import learning, picture_of, picture_plots, sweep_legend
from runner.sweep.results import Results, effects_sections, ranking_sections, results_of
from runner.sweep.state import read_sweep


def load_sweep_libraries() -> None:
    """Import the libraries that the pages of sweeps need, at a low priority where a thread can have one.

    SciPy, scikit-learn and Optuna take seconds to load, which no request should have to wait for.
    """

    def load() -> None:
        if sys.platform == "linux":  # elsewhere a priority is that of a whole process
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 10)
        for module in ("scipy.stats", "sklearn.ensemble", "optuna.samplers", "runner.sweep.results"):
            with contextlib.suppress(ImportError):  # the function that needs it explains how to install it
                importlib.import_module(module)

    thread = threading.Thread(target=load)
    thread.start()
    thread.join()


@lru_cache(maxsize=1)
def _results(name: str, recordings: Path, digest: str) -> Results:  # noqa: ARG001
    """Return the results of a sweep in the state that the digest identifies."""
    return results_of(read_sweep(name, recordings), recordings)


def sweep_results(name: str, recordings: Path, digest: str) -> bytes:
    """Return the ranking of a sweep as HTML, with links to its runs."""
    results = _results(name, recordings, digest)
    ranking, *others = (_without_folders(each, recordings) for each in ranking_sections(results, None))
    runs = {str(entry.number): _run_links(entry.runs) for entry in results.ranking}
    grids = [
        Grid((*grid.headings, "runs, by seed"), [(*row, runs[row[0]]) for row in grid.rows])
        for grid in ranking.grids[:1]
    ]
    shown = partials()
    html = [shown.section("ranking", "Ranking", replace(ranking, grids=[*grids, *ranking.grids[1:]]))]
    html += [shown.section(f"results-{i}", each.title, each) for i, each in enumerate(others)]
    return "".join([*html, shown.best(results.best_yaml) if results.best_yaml else ""]).encode()


def _run_links(runs: Mapping[int, str]) -> str:
    links = [
        Markup('<a href="/runs/{0}" title="{0}">{1}</a>').format(run, seed) for seed, run in runs.items()
    ]
    return Markup(" ").join(links)


def sweep_importance(name: str, recordings: Path, digest: str) -> bytes:
    """Return the importance of a sweep's parameters as HTML, empty if it is unknown."""
    shown = partials()
    sections = [
        _without_folders(each, recordings) for each in effects_sections(_results(name, recordings, digest))
    ]
    return "".join(
        shown.section(f"importance-{i}", each.title, each) for i, each in enumerate(sections)
    ).encode()


def _without_folders(section: Section, recordings: Path) -> Section:
    return replace(section, sentences=[without_folders(text, recordings) for text in section.sentences])


def sweep_pictures(name: str, recordings: Path, digest: str) -> bytes:
    """Return the charts of a sweep as HTML: its parameters, and learning curves of some of its trials."""
    results, shown, html = _results(name, recordings, digest), partials(), ""
    with contextlib.suppress(RunnerError):  # no trial is finished yet, as the ranking says
        picture = picture_of(results)
        html = shown.charts("parameters", "Parameters", picture.footnote, picture_plots(picture))
    try:
        groups, panels = learning(results, recordings)
        plots, note = panel_plots(panels, len(groups)), footnote(groups, panels)
        html += shown.charts("curves", "Learning curves", note, plots, sweep_legend(groups))
    except RunnerError as error:
        html += shown.charts("curves", "Learning curves", without_folders(str(error), recordings), [])
    return str(html).encode()
