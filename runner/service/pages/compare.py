"""Comparisons of runs: their differences, where they diverge, both replays in step, their Q-tables."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar, Final

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import HTMLResponse
from starlette.concurrency import run_in_threadpool

from runner.analysis.axes import EPISODES
from runner.analysis.diff.sections import made_sections
from runner.analysis.groups import flat_config
from runner.analysis.sections import Section
from runner.analysis.step_reference import StepRef
from runner.errors import RunnerError
from runner.export.plots.comparisons import letter
from runner.export.reports.rendering import View
from runner.recording.metrics import METRICS
from runner.recording.reader import open_recording
from runner.runs.run import Run
from runner.service import fragments
from runner.service.addresses import link, places_in
from runner.service.api.comparing import MAX_SCORES, found_runs
from runner.service.api.reading import AxisName
from runner.service.dependencies import CatalogueOf, ComputationOf
from runner.service.fragments import ShownDifference
from runner.service.pages.frame import RunHead, has_tables, head_of, last_evaluation, result_of
from runner.service.pages.rendering import page
from runner.service.pages.replay import Panel, panel_of
from runner.util import humanize
from runner.util.humanize import counted

router = APIRouter(prefix="/compare", include_in_schema=False)

TABS: Final = (
    ("", "Overview"),
    ("/divergence", "Where they diverge"),
    ("/replay", "Replays in step"),
    ("/tables", "Q-tables"),
    ("/code", "Code"),
)
MAX_LATEST: Final = 4
"""Runs whose latest episodes a page replays."""
MAX_RUNS: Final = 60
"""Runs that a page compares."""
Names = Annotated[list[str] | None, Query(max_length=100)]
Scores = Annotated[str, Query(max_length=MAX_SCORES)]
Rows = list[tuple[str, list[str]]]
"""Rows of a table: a name, and the value of each run."""


@dataclass(frozen=True)
class ComparedRun:
    """A run in a comparison."""

    head: RunHead
    recording: Path
    letter: str
    label: str
    number: int
    """Number of its colour."""


@dataclass(frozen=True)
class Compared:
    """The head of every page of a comparison."""

    runs: list[ComparedRun]
    tabs: list[tuple[str, str, str]]
    """Path, title and address."""
    here: str
    can_explain: bool
    """Whether mixtures of both can be trained: jobs that differ in more than their seed."""

    @property
    def title(self) -> str:
        """The names of the runs; of more than two, each name once."""
        names = [run.head.name for run in self.runs]
        if len(names) > 2:
            names = list(dict.fromkeys(names))
        return " against ".join(names) if len(names) > 1 else f"{len(self.runs)} runs of {names[0]}"

    @property
    def charts(self) -> list[dict[str, str]]:
        """The runs, as `charts.js` reads them."""
        return [{"id": run.head.id, "label": run.label} for run in self.runs]


@dataclass(frozen=True)
class CompareView(View):
    """A page of a comparison."""

    compared: Compared


@dataclass(frozen=True)
class _OverviewView(CompareView):
    TEMPLATE: ClassVar = "compare_overview.html"
    differing: Rows
    results: Rows
    same: bool
    """Whether the content of all runs is the same."""
    running: list[ComparedRun]
    """The runs whose latest episodes replay by themselves."""
    scores: str
    """A table of scores as CSV; empty without one."""
    tasks: str
    """Address of the comparison over environments; empty where there is one environment."""


@dataclass(frozen=True)
class _DivergenceView(CompareView):
    TEMPLATE: ClassVar = "compare_divergence.html"
    found: ShownDifference


@dataclass(frozen=True)
class _TablesView(CompareView):
    TEMPLATE: ClassVar = "compare_tables.html"
    body: str


@dataclass(frozen=True)
class _CodeView(CompareView):
    TEMPLATE: ClassVar = "compare_code.html"
    lead: str
    code: Section
    provenance: Section


@dataclass(frozen=True)
class _ReplaysView(CompareView):
    TEMPLATE: ClassVar = "compare_replay.html"
    shown: list[Panel]
    episode: str
    prefix: str
    """The reference of the episode, without its step."""
    t: int
    before: str
    after: str
    base: str


@router.get("")
async def overview(
    request: Request, catalogue: CatalogueOf, run: Names = None, scores: Scores = ""
) -> Response:
    """Show the differences of runs, and their curves in common plots."""
    runs = await _chosen(catalogue, run)

    def show() -> Response:
        settings = [{**({"seed": str(each.seed)} if each.has_seed else {}), **_flat(each)} for each in runs]
        rows = [
            (key, [each.get(key, humanize.UNKNOWN) for each in settings])
            for key in dict.fromkeys(key for each in settings for key in each)
        ]
        digests = {each.summary.content_digest for each in runs}
        compared = _compared(runs, "")
        view = _OverviewView(
            compared,
            differing=[(key, values) for key, values in rows if len(set(values)) > 1],
            results=_results(runs),
            same=len(digests) == 1 and None not in digests,
            running=[each for each in compared.runs if each.head.status == "running"][:MAX_LATEST],
            scores=scores,
            tasks=_tasks_address(runs, scores),
        )
        return page(request, view)

    return await run_in_threadpool(show)


def _tasks_address(runs: list[Run], scores: str) -> str:
    environments = {json.dumps(run.file.config.get("env"), sort_keys=True) for run in runs}
    query: dict[str, object] = {"run": [run.run_id for run in runs]} | ({"scores": scores} if scores else {})
    return link("/compare/tasks", query) if len(environments) > 1 else ""


@router.get("/tasks")
async def tasks(
    catalogue: CatalogueOf,
    compute: ComputationOf,
    run: Names = None,
    scores: Scores = "",
    axis: AxisName = EPISODES.name,
) -> Response:
    """Return the comparison over environments by normalised scores, as a part of the page."""
    paths = [each.recording for each in await _chosen(catalogue, run)]
    return HTMLResponse(await compute(fragments.tasks, paths, axis, scores))


@router.get("/divergence")
async def divergence(
    request: Request, catalogue: CatalogueOf, compute: ComputationOf, run: Names = None
) -> Response:
    """Show the first step at which two runs differ, and the cause."""
    runs = _two(await _chosen(catalogue, run))
    difference = await compute.shown(ShownDifference, fragments.difference, *runs)
    compared = _compared(runs, "/divergence")
    view = _DivergenceView(compared, difference)
    return await run_in_threadpool(page, request, view)


@router.get("/tables")
async def tables(
    request: Request, catalogue: CatalogueOf, compute: ComputationOf, run: Names = None
) -> Response:
    """Show the difference of the Q-tables of two runs."""
    runs = _two(await _chosen(catalogue, run))
    body = (await compute.shown(ShownDifference, fragments.difference, *runs)).tables
    return await run_in_threadpool(page, request, _TablesView(_compared(runs, "/tables"), body))


@router.get("/code")
async def code(request: Request, catalogue: CatalogueOf, run: Names = None) -> Response:
    """Show how the code of two runs differs, and how else they were made."""
    runs = _two(await _chosen(catalogue, run))

    def show() -> Response:
        with open_recording(runs[0].recording) as a, open_recording(runs[1].recording) as b:
            made, files, changes = made_sections(a, b)
        return page(request, _CodeView(_compared(runs, "/code"), made, files, changes))

    return await run_in_threadpool(show)


@router.get("/replay")
async def replay(
    request: Request,
    catalogue: CatalogueOf,
    compute: ComputationOf,
    run: Names = None,
    at: Annotated[str, Query(max_length=60)] = "",
) -> Response:
    """Show an episode of two runs, in step; by default the one in which they diverge."""
    runs = _two(await _chosen(catalogue, run))
    if at:
        step = StepRef.parse(at)
    else:
        first = (await compute.shown(ShownDifference, fragments.difference, *runs)).first_frame
        step = StepRef.parse(first) if first else StepRef(0)
    names, places = [each.run_id for each in runs], places_in(runs, step)

    def neighbour(by: int) -> str:
        other = replace(step, episode=step.episode + by, t=0)
        has_one = other.episode >= 0 and places == [step, step]
        return link("/compare/replay", {"run": names, "at": str(other)}) if has_one else ""

    def show() -> Response:
        head, shown = _compared(runs, "/replay"), []
        for one, place in zip(head.runs, places, strict=True):
            source = f"/api/v1/runs/{one.head.id}/replay/{place.episode_path}"
            with open_recording(one.recording) as recording:
                phase = "train" if place.after is None else "eval"
                shown.append(panel_of(recording, phase, source, one.label, one.number))
        view = _ReplaysView(
            head,
            shown=shown,
            episode=step.episode_name,
            prefix=step.episode_text,
            t=step.t,
            before=neighbour(-1),
            after=neighbour(1),
            base=link("/compare/replay", {"run": names}),
        )
        return page(request, view)

    return await run_in_threadpool(show)


async def _chosen(catalogue: CatalogueOf, names: list[str] | None) -> list[Run]:
    """Return the runs to compare.

    Raises:
        RunnerError: there are fewer than two of them, or too many.
    """
    names = list(dict.fromkeys(names or []))
    if not 2 <= len(names) <= MAX_RUNS:
        raise RunnerError(
            f"found {counted(len(names), 'run')}, expected 2 to {MAX_RUNS}: select them in the table of runs."
        )
    return await found_runs(catalogue, names)


def _two(runs: list[Run]) -> list[Run]:
    if len(runs) != 2:
        raise RunnerError(
            f"found {counted(len(runs), 'run')}, expected two: only two are compared step by step."
        )
    return runs


def _compared(runs: list[Run], here: str) -> Compared:
    names = [each.run_id for each in runs]
    tabs = [(tab, title, link(f"/compare{tab}", {"run": names})) for tab, title in TABS]
    letters = [letter(i) for i in range(len(runs))]
    compared = [
        ComparedRun(head_of(each), each.recording, letter, f"{letter}: {each.name}", i % 7)
        for i, (each, letter) in enumerate(zip(runs, letters, strict=True))
    ]
    if not any(map(has_tables, runs)):
        tabs = [tab for tab in tabs if tab[0] != "/tables"]
    differ = len({repr(_flat(each)) for each in runs}) > 1
    can_explain = len(runs) == 2 and all(map(has_tables, runs)) and differ
    return Compared(compared, tabs if len(runs) == 2 else [], here, can_explain)


def _flat(run: Run) -> dict[str, str]:
    return {key: humanize.setting(value) for key, value in flat_config(run.file.config).items()}


def _results(runs: list[Run]) -> Rows:
    """Return the results of runs, a row for each measure."""
    last = [last_evaluation(each) for each in runs]
    metrics = [
        metric
        for metric in METRICS
        if not (metric.per_agent and all(map(has_tables, runs)))
        and any(each.values.get(metric.name) is not None for each in last)
    ]
    digests = [str(each.summary.content_digest or humanize.UNKNOWN)[:16] for each in runs]
    return [
        ("Status", [each.status for each in runs]),
        *(
            (result_of(metric, last[0])[0], [result_of(metric, each)[1] for each in last])
            for metric in metrics
        ),
        ("Training episodes", [humanize.number(each.summary.episodes, 0) for each in runs]),
        ("Training steps", [humanize.number(each.summary.train_steps, 0) for each in runs]),
        ("Content digest", digests),
    ]
