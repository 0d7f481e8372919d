"""The sweeps, the results of one, and explanations of the difference between two runs."""

from __future__ import annotations

import contextlib
import hashlib
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Final, Literal

from fastapi import APIRouter, Depends, Request, Response
from fastapi import Path as InPath
from fastapi.responses import HTMLResponse

from runner.analysis.episodes import EpisodeRef
from runner.analysis.sections import Grid, Link
from runner.debugging.explanation import Explanation, drawn_sections, explanations_in
from runner.errors import RunnerError, RunNotFound
from runner.runs.catalogue.filters import parse
from runner.service import computed
from runner.service.api.reading import Part, found_explanation
from runner.service.computed import link
from runner.service.dependencies import CacheOf, CatalogueOf, JobsOf, SettingsOf, SweepProcesses
from runner.service.errors import Busy
from runner.service.pages.rendering import Page, message_of
from runner.sweep import folder_of, sweeps_in, tag_of
from runner.sweep.state import read_sweep

router = APIRouter(prefix="/sweeps", include_in_schema=False)

Name = Annotated[str, InPath(max_length=100)]
SweepPart = Literal["results", "importance", "pictures"]
PARTS: Final = {
    "results": (computed.sweep_ranking, "Comparing the trials"),
    "importance": (computed.sweep_importance, "Computing the importance of parameters"),
    "pictures": (computed.sweep_pictures, "Drawing parameters and learning curves"),
}
"""Parts of the page of a sweep in the order in which they are computed, the fastest first.

For each what computes it, and what the page says meanwhile.
"""


@router.get("")
def sweeps(
    request: Request, settings: SettingsOf, catalogue: CatalogueOf, processes: SweepProcesses
) -> Response:
    """Show the sweeps, and prepare for the page of one."""
    rows: list[tuple[str, ...]] = []
    places = [(name, folder) for folder in settings.recordings for name in sweeps_in(folder)]
    counts = catalogue.read(lambda index: {name: index.count(parse(_filter_of(name))) for name, _ in places})
    for name, folder in places:
        try:
            sweep = read_sweep(name, folder)
        except RunnerError as error:
            rows.append((name, message_of(error, request), "", "", ""))
            continue
        parameters = ", ".join(sweep.file.parameters)
        rows.append((name, sweep.file.strategy, parameters, sweep.objective.description, f"{counts[name]:,}"))
    if rows:
        with contextlib.suppress(Busy):
            processes.submit(settings.limits.work_seconds, computed.load_sweep_libraries)
    headings = ("name", "strategy", "parameters", "objective", "runs")
    listed_sweeps = Grid(headings, rows, links=[f"/sweeps/{name}" for name, *_ in rows], left=headings[:4])
    names = [name for folder in settings.recordings for name in explanations_in(folder)]
    return Page("sweeps.html", {"sweeps": listed_sweeps, "explanations": names})


@dataclass(frozen=True)
class _SweepState:
    """The state of a sweep; what is computed from it holds as long as it is the same."""

    name: str
    folder: Path
    """The recordings folder."""
    runs: int
    digest: str
    """A hash of the catalogue's rows of its runs, and of the sweep's own files."""


def _state_of(name: Name, settings: SettingsOf, catalogue: CatalogueOf) -> _SweepState:
    """Return the present state of a sweep.

    Raises:
        RunNotFound: there is no sweep of this name.
    """
    folder = next((folder for folder in settings.recordings if name in sweeps_in(folder)), None)
    if folder is None:
        raise RunNotFound(f"no sweep {name!r}: the page of sweeps lists those there are.")
    is_of_sweep = parse(_filter_of(name))
    rows = catalogue.read(lambda index: index.select(is_of_sweep))
    files = []
    for path in sorted(folder_of(name, folder).iterdir()):
        with contextlib.suppress(FileNotFoundError):  # a temporary file, which has replaced another meanwhile
            facts = path.stat()
            files.append((path.name, facts.st_size, facts.st_mtime_ns))
    digest = hashlib.sha256(json.dumps([files, rows], default=str, sort_keys=True).encode()).hexdigest()
    return _SweepState(name, folder, len(rows), digest)


SweepOf = Annotated[_SweepState, Depends(_state_of)]


@router.get("/{name}")
async def sweep(state: SweepOf, cache: CacheOf, jobs: JobsOf) -> Response:
    """Show the results of a sweep, at once, with placeholders for the parts that are not ready yet."""
    parts = [(part, waiting, cache.get(_key(state, part))) for part, (_, waiting) in PARTS.items()]

    def show() -> dict[str, object]:
        sweep_jobs = [job for job in jobs.store.jobs() if job.kind == "sweep" and job.name == state.name]
        parameters = [f"config.{path}" for path in read_sweep(state.name, state.folder).file.parameters]
        columns = ",".join(["id", "seed", "status", "success_percent", "mean_length", *parameters])
        query = {"filter": _filter_of(state.name), "columns": columns}
        return {
            "name": state.name,
            "runs": state.runs,
            "runs_address": link("/runs", query),
            "job": sweep_jobs[-1].status() if sweep_jobs else None,
            "shown_parts": parts,
        }

    return Page("sweep_page.html", show)


@router.get("/explanations/{pair}/{metric}")
def explanation(pair: Part, metric: Part, settings: SettingsOf) -> Response:
    """Show an explanation."""
    result = found_explanation(pair, metric, settings)
    first, *others = drawn_sections(result)
    sections = [replace(first, title="", links=_links(result)), *others]
    return Page("explanation.html", {"title": first.title, "answer": sections})


def _links(explanation: Explanation) -> list[Link]:
    """Return the replays of the first step that the strongest setting changed, without and with it."""
    first = explanation.first_step
    if first is None or first.episode is None:
        return []
    step = EpisodeRef(first.episode, first.t or 0)
    runs = (("without", first.run_a), ("with", first.run_b))
    return [Link(f"Replay {word} {first.setting}", step.replay_address(run)) for word, run in runs]


@router.get("/{name}/{part}")
async def sweep_part(state: SweepOf, part: SweepPart, cache: CacheOf, processes: SweepProcesses) -> Response:
    """Return a part of the page of a sweep: the ranking, the importance of parameters, or the pictures."""
    make, _ = PARTS[part]
    body = await cache.get_or_await(
        _key(state, part),
        lambda: processes(computed.sweep_part, make, state.name, state.folder, state.digest),
    )
    return HTMLResponse(body)


def _filter_of(name: str) -> str:
    return f"{json.dumps(tag_of(name))} in tags"


def _key(state: _SweepState, part: str) -> tuple[str, _SweepState]:
    return f"sweep {part}", state
