"""Parts of the pages of sweeps that take long to compute, for child processes: HTML."""

from __future__ import annotations

import contextlib
import importlib
import os
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from markupsafe import Markup

from runner.analysis.sections import Grid, Section
from runner.errors import RunnerError
from runner.export.reports.rendering import partials
from runner.service.settings import without_folders
from runner.sweep.charts import best_section, learning, learning_section, parameters_section, picture_of
from runner.sweep.results import Results, effects_sections, ranking_sections
from runner.views.sweep_show import sweep_show


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
    return sweep_show((name, recordings), everything=True)


def sweep_part(
    part: Callable[[Results, Path], Iterable[Section]], name: str, recordings: Path, digest: str
) -> bytes:
    """Return a part of the page of a sweep as HTML, without the path of the recordings folder."""
    shown = [
        replace(section, sentences=[without_folders(text, recordings) for text in section.sentences])
        for section in part(_results(name, recordings, digest), recordings)
    ]
    return str(partials().answer(shown)).encode()


def ranking(results: Results, _: Path) -> Iterator[Section]:
    """Yield the ranking of a sweep, with links to its runs, and the best configuration."""
    first, *others = ranking_sections(results)
    runs = {str(entry.number): _run_links(entry.runs) for entry in results.ranking}
    grids = [
        Grid((*grid.headings, "runs, by seed"), [(*row, runs[row[0]]) for row in grid.rows])
        for grid in first.grids
    ]
    yield replace(first, title="Ranking", grids=grids)
    yield from others
    if results.best_yaml:
        yield best_section(results)


def _run_links(runs: Mapping[int, str]) -> str:
    links = [
        Markup('<a href="/runs/{0}" title="{0}">{1}</a>').format(run, seed) for seed, run in runs.items()
    ]
    return Markup(" ").join(links)


def importance(results: Results, _: Path) -> Iterable[Section]:
    """Return the importance of a sweep's parameters; nothing if it is unknown."""
    return effects_sections(results)


def pictures(results: Results, recordings: Path) -> Iterator[Section]:
    """Yield the charts of a sweep: its parameters, and learning curves of some of its trials."""
    with contextlib.suppress(RunnerError):  # no trial is finished yet, as the ranking says
        yield parameters_section(picture_of(results))
    try:
        yield learning_section(learning(results, recordings))
    except RunnerError as error:
        yield Section("Learning curves", [str(error)])
