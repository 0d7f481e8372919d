"""Comparisons of runs: their differences, where they diverge, both replays in step, their Q-tables."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Final

from fastapi import APIRouter, Depends, Query, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse

from runner.analysis.axes import EPISODES
from runner.analysis.episodes import EpisodeRef
from runner.analysis.evaluations import loop_summary
from runner.analysis.groups import flat_config
from runner.analysis.sections import Grid
from runner.errors import RecordingError, RunnerError
from runner.export.plots.comparisons import letter
from runner.recording.metrics import METRICS
from runner.recording.reader import open_recording
from runner.recording.run_file import EvaluationMetrics, Summary
from runner.runs.run import Run
from runner.service import computed
from runner.service.api.reading import AxisOf
from runner.service.computed import ShownDifference, link, places_in
from runner.service.dependencies import At, CatalogueOf, ComputationOf, recorded_run
from runner.service.pages.rendering import Page, RunHead, head_of, result_of
from runner.service.pages.replay import panel_of
from runner.service.problems import requests_page, status_of
from runner.util import humanize
from runner.util.humanize import UNKNOWN, counted
from runner.views.compare import MAX_SCORES

router = APIRouter(prefix="/compare", include_in_schema=False)

TABS: Final[tuple[tuple[str, str], ...]] = (
    ("", "Overview"),
    ("divergence", "Where they diverge"),
    ("replay", "Replays in step"),
    ("tables", "Q-tables"),
    ("code", "Code"),
)
EXPECTED_STEP: Final = "EPISODE:T such as 120:5, or eval:N:TRIAL:T"
MAX_LATEST: Final = 4
"""Runs whose latest episodes a page replays."""
MAX_RUNS: Final = 60
"""Runs that a page compares."""
Scores = Annotated[str, Query(max_length=MAX_SCORES)]
Names = Annotated[list[str] | None, Query(max_length=100)]


@dataclass(frozen=True)
class ComparedRun:
    """A run in a comparison."""

    head: RunHead
    letter: str
    label: str
    number: int
    """Number of its colour."""


@dataclass(frozen=True)
class Compared:
    """The head of every page of a comparison."""

    runs: list[ComparedRun]
    tabs: list[tuple[str, str]]
    """Path and title."""
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
    def query(self) -> str:
        """The runs, as an address names them."""
        return link("", {"run": [run.head.id for run in self.runs]})


def chosen_runs(
    catalogue: CatalogueOf,
    run: Names = None,
    name: Names = None,
) -> list[Run]:
    """Return the runs to compare: single ones, and all runs of some names.

    Raises:
        RunnerError: there are fewer than two of them, or too many.
    """
    named = [match for text in name or () for match in catalogue.find_all(text)]
    runs = {match.folder: match for match in [*map(catalogue.find, run or ()), *named]}
    if not 2 <= len(runs) <= MAX_RUNS:
        raise RunnerError(
            f"found {counted(len(runs), 'run')}, expected 2 to {MAX_RUNS}: select them in the table of runs."
        )
    return [recorded_run(match) for match in runs.values()]


ChosenRuns = Annotated[list[Run], Depends(chosen_runs)]


def two_runs(runs: ChosenRuns) -> list[Run]:
    """Return the two runs to compare step by step."""
    if len(runs) != 2:
        raise RunnerError(
            f"found {counted(len(runs), 'run')}, expected two: only two are compared step by step."
        )
    return runs


TwoRuns = Annotated[list[Run], Depends(two_runs)]


@router.get("")
def overview(runs: ChosenRuns, scores: Scores = "") -> Response:
    """Show the differences of runs, and their curves in common plots."""
    settings = _rows([({"seed": str(run.seed)} if run.has_seed else {}) | _settings(run) for run in runs])
    results = _rows([_results(run) for run in runs])
    digests = {run.summary.content_digest for run in runs}
    environments = {json.dumps(run.file.config.get("env"), sort_keys=True) for run in runs}
    tasks_address = link("/compare/tasks", {"run": [run.run_id for run in runs], "scores": scores})
    compared = _compared(runs, "")
    headings = ("", *(run.label for run in compared.runs))
    values = {
        "compared": compared,
        "differing": Grid(headings, [row for row in settings if len(set(row[1:])) > 1], left=headings),
        "results": Grid(headings, [row for row in results if {*row[1:]} != {UNKNOWN}], left=headings),
        "same": len(digests) == 1 and None not in digests,
        # The latest episodes of these replay by themselves.
        "running": [run for run in compared.runs if run.head.status == "running" and run.head.steps == "all"][
            :MAX_LATEST
        ],
        "scores": scores,
        "tasks": tasks_address if len(environments) > 1 else "",
    }
    return Page("compare_overview.html", values)


@router.get("/tasks")
async def tasks(
    request: Request,
    runs: ChosenRuns,
    compute: ComputationOf,
    scores: Scores = "",
    axis: AxisOf = EPISODES.name,
) -> Response:
    """Return the comparison over environments by normalised scores, as a part of the page; else the page."""
    if requests_page(request):
        return RedirectResponse(f"/compare?{request.url.query}#environments")
    paths = [run.recording for run in runs]
    return HTMLResponse(await compute(computed.tasks, paths, axis, scores))


@router.get("/replay")
async def replay(runs: TwoRuns, compute: ComputationOf, at: At = "") -> Response:
    """Show an episode of two runs, in step; by default the one in which they diverge."""
    step, problem = EpisodeRef(0), None
    try:
        if at:
            step = EpisodeRef.parse(at, EXPECTED_STEP)
            if step.word:  # which may mean different episodes of two runs
                raise RunnerError(f"found {at[:60]!r}, expected {EXPECTED_STEP}.")
        elif first := (await compute.shown(ShownDifference, computed.difference, *runs)).first_frame:
            step = EpisodeRef.parse(first)
    except RunnerError as error:
        problem = error
    names, steps = [run.run_id for run in runs], places_in(runs, step)

    def neighbour(by: int) -> str:
        other = replace(step, episode=step.episode + by, t=0)
        has_one = other.episode >= 0 and steps == [step, step]
        return link("/compare/replay", {"run": names, "at": str(other)}) if has_one else ""

    def show() -> dict[str, object]:
        compared, panels = _compared(runs, "replay"), []
        for run, side, own_step in zip(runs, compared.runs, steps, strict=True):
            source = f"/api/v1/runs/{run.run_id}/replay/{own_step.episode_path}"
            with open_recording(run.recording) as recording:
                panels.append(panel_of(recording, own_step.phase, source, side.label, side.number))
        return {
            "compared": compared,
            "shown": panels,
            "episode": step.heading,
            "prefix": step.episode_text,
            "t": step.t,
            "before": neighbour(-1),
            "after": neighbour(1),
            "base": link("/compare/replay", {"run": names}),
            "problem": problem,
            "at": at,
        }

    return Page("compare_replay.html", show, status_of(problem) if problem else None)


@router.get("/divergence")
@router.get("/tables")
@router.get("/code")
async def difference(request: Request, runs: TwoRuns, compute: ComputationOf) -> Response:
    """Show the first step at which two runs differ, and why; or how their Q-tables differ, or their code."""
    tab = request.url.path.rpartition("/")[2]
    function = computed.made_difference if tab == "code" else computed.difference
    found = await compute.shown(ShownDifference, function, *runs)
    lead, notes, body = found.tabs[tab]
    return Page(
        "compare_answer.html",
        lambda: {"compared": _compared(runs, tab), "lead": lead, "notes": notes, "body": body},
    )


def _compared(runs: list[Run], here: str) -> Compared:
    compared = [
        ComparedRun(head_of(run), letter(i), f"{letter(i)}: {run.name}", i % 7) for i, run in enumerate(runs)
    ]
    are_jobs = [run.can_train_again for run in runs]
    tabs = [tab for tab in TABS if len(runs) == 2 and (all(are_jobs) or tab[0] != "tables")]
    differ = len({repr(_settings(run)) for run in runs}) > 1
    can_explain = len(runs) == 2 and all(are_jobs) and differ
    return Compared(compared, tabs, here, can_explain)


def _settings(run: Run) -> dict[str, str]:
    return {key: humanize.setting(value) for key, value in flat_config(run.file.config).items()}


def _results(run: Run) -> dict[str, str]:
    last = run.summary
    if not run.can_train_again:
        last = Summary()  # of a loop whose recording cannot be read
        with contextlib.suppress(RecordingError), open_recording(run.recording) as recording:
            last = loop_summary(recording)
    evaluation = last.last_evaluation or EvaluationMetrics()
    return {
        "Status": run.status,
        **dict(result_of(metric, evaluation) for metric in METRICS),
        "Training episodes": humanize.number(run.summary.episodes, 0),
        "Training steps": humanize.number(run.summary.train_steps, 0),
        "Content digest": str(run.summary.content_digest or UNKNOWN)[:16],
    }


def _rows(columns: Sequence[Mapping[str, str]]) -> list[tuple[str, ...]]:
    """Return a row for each name that any column has, which begins with the name."""
    names = dict.fromkeys(name for column in columns for name in column)
    return [(name, *(column.get(name, UNKNOWN) for column in columns)) for name in names]
