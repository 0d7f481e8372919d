"""Parts of the pages of sweeps that take long to compute, for child processes: HTML."""

from __future__ import annotations

import contextlib
import importlib
import os
import sys
import threading
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from markupsafe import Markup

from runner.analysis.sections import Grid, Section
from runner.errors import RunnerError
from runner.export.reports.rendering import partials
from runner.service.settings import without_folders
from runner.sweep.charts import best_section, learning, learning_section, parameters_section, picture_of
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
    ranking, *others = ranking_sections(results, None)
    runs = {str(entry.number): _run_links(entry.runs) for entry in results.ranking}
    grids = [
        Grid((*grid.headings, "runs, by seed"), [(*row, runs[row[0]]) for row in grid.rows])
        for grid in ranking.grids
    ]
    best = [best_section(results)] if results.best_yaml else []
    return _answer([replace(ranking, title="Ranking", grids=grids), *others, *best], recordings)


def _run_links(runs: Mapping[int, str]) -> str:
    links = [
        Markup('<a href="/runs/{0}" title="{0}">{1}</a>').format(run, seed) for seed, run in runs.items()
    ]
    return Markup(" ").join(links)


def sweep_importance(name: str, recordings: Path, digest: str) -> bytes:
    """Return the importance of a sweep's parameters as HTML, empty if it is unknown."""
    return _answer(effects_sections(_results(name, recordings, digest)), recordings)


def sweep_pictures(name: str, recordings: Path, digest: str) -> bytes:
    """Return the charts of a sweep as HTML: its parameters, and learning curves of some of its trials."""
    results = _results(name, recordings, digest)
    sections = []
    with contextlib.suppress(RunnerError):  # no trial is finished yet, as the ranking says
        sections.append(parameters_section(picture_of(results)))
    try:
        sections.append(learning_section(learning(results, recordings)))
    except RunnerError as error:
        sections.append(Section("Learning curves", [str(error)]))
    return _answer(sections, recordings)


def _answer(sections: Sequence[Section], recordings: Path) -> bytes:
    """Return sections as HTML, without the path of the recordings folder."""
    shown = [
        replace(section, sentences=[without_folders(text, recordings) for text in section.sentences])
        for section in sections
    ]
    return str(partials().answer(shown)).encode()
