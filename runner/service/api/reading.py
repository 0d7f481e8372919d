"""The contents of recordings: metrics, evaluations, episodes, steps, plots; and comparisons of runs."""

from __future__ import annotations

import pathlib
from collections.abc import Sequence
from typing import Annotated, Final, Literal

from fastapi import APIRouter, Depends, Path, Query, Response
from pydantic import BaseModel, Field
from starlette.concurrency import run_in_threadpool

from runner.analysis.axes import EPISODES
from runner.analysis.frames import Phase, episode_columns, step_columns
from runner.analysis.histograms import ValueCounts
from runner.debugging.explanation import Explanation, explanations_in, read_explanation
from runner.errors import RunNotFound
from runner.recording.reader import Recording
from runner.runs.run import Run
from runner.service import computed
from runner.service.catalogue import Catalogue
from runner.service.computed import require_few
from runner.service.curves import AxisName, CurveOptions, Curves, FigureOptions, curves_of, figure_of
from runner.service.dependencies import (
    CatalogueOf,
    ComputationOf,
    OpenRecording,
    ProcessesOf,
    RecordedRun,
    SettingsOf,
    json_response,
    recorded_run,
)
from runner.service.problems import media_docs
from runner.service.settings import ServiceSettings
from runner.util.arrays import Array
from runner.util.values import finite
from runner.views.view import START, STOP, rows_in

router = APIRouter(
    prefix="/runs/{run}",
    tags=["reading"],
)
ARROW: Final = "application/vnd.apache.arrow.stream"
SVG: Final = "image/svg+xml"
Start = Annotated[int, Query(ge=0, le=START.maximum, description=START.help)]
Stop = Annotated[int | None, Query(ge=0, le=STOP.maximum, description=STOP.help)]


async def _rows(start: Start = 0, stop: Stop = None) -> range:
    """Return the numbers of the records to return."""
    return rows_in(start, stop)


Rows = Annotated[range, Depends(_rows)]
PhasePath = Annotated[Phase, Path(description="`train`, or `eval`: the trials of evaluations.")]
AxisOf = Annotated[AxisName, Query()]


class Histograms(BaseModel):
    """The histograms of a run's training."""

    run_id: str
    histograms: list[ValueCounts]
    notes: list[str]
    """What is left out, a sentence each."""


class RecordsPage(BaseModel):
    """Some records of a run, one object each."""

    run_id: str
    start: int
    total: int
    records: list[dict[str, object]]


class Columns(BaseModel):
    """Some records of a run, a list for each field."""

    run_id: str
    start: int
    total: int
    """The number of all records."""
    columns: dict[str, list[object]]


@router.get("/metrics", response_model=Curves, summary="The curves of a run's metrics.")
async def metrics(
    run: RecordedRun, compute: ComputationOf, options: Annotated[CurveOptions, Query()]
) -> Response:
    """Return every metric over an axis, as plots show it.

    With `points`, longer curves have the lowest and the highest value of each section only, and `thinned` is
    true; `start` and `stop` select a part at full resolution.
    """
    return await compute.json(curves_of, [run.recording], options)


@router.get(
    "/histograms",
    response_model=Histograms,
    summary="Histograms over training, as heat maps.",
)
async def histograms(run: RecordedRun, compute: ComputationOf, axis: AxisOf = EPISODES.name) -> Response:
    """Return the counts of returns, lengths, actions and rewards in stretches of training."""
    return await compute.json(computed.run_histograms, run.recording, axis)


def _add_records_route(kind: computed.RecordKind, summary: str, description: str) -> None:
    @router.get(
        f"/{kind}",
        name=kind,
        response_model=RecordsPage,
        summary=summary,
        description=description,
    )
    async def records(run: RecordedRun, compute: ComputationOf, settings: SettingsOf, rows: Rows) -> Response:
        return await compute.json(computed.records, run.recording, kind, rows, settings.limits.page_records)


_add_records_route(
    "training",
    "The reports of training.",
    "Reports of training as `dualtaxi show --json` has them under `train`.",
)
_add_records_route(
    "optimality",
    "The exact measures of evaluations.",
    "The exact measures of evaluations; none unless `evaluation.exact` was set.",
)


@router.get(
    "/{table}/{phase}.arrow",
    response_class=Response,
    responses=media_docs(ARROW),
    summary="Steps or episodes by range, as Arrow.",
)
async def arrow(
    run: RecordedRun,
    processes: ProcessesOf,
    settings: SettingsOf,
    table: Literal["steps", "episodes"],
    phase: PhasePath,
    rows: Rows,
) -> Response:
    """Return the same columns as a stream of Arrow's IPC format."""
    require_few(len(rows), settings.limits.page_arrow)
    body = await processes(computed.arrow, run.recording, table, phase, rows)
    return Response(body, media_type=ARROW)


@router.get("/episodes/{phase}", response_model=Columns, summary="Episodes by range.")
def episodes(recording: OpenRecording, settings: SettingsOf, phase: PhasePath, rows: Rows) -> Response:
    """Return episodes as columns: length, return of each agent, events, how it ended."""
    total = recording.phase(phase).episodes.count()
    stop = _stop(rows, total, settings.limits.page_records)
    return _columns(recording, episode_columns(recording, phase, rows.start, stop), rows.start, total)


@router.get("/steps/{phase}", response_model=Columns, summary="Steps by range, or of one episode.")
def steps(
    recording: OpenRecording,
    settings: SettingsOf,
    phase: PhasePath,
    rows: Rows,
    episode: Annotated[int | None, Query(ge=0, lt=2**62, description="Instead: all of this one.")] = None,
) -> Response:
    """Return steps as columns: state, joint action, next state, reward of each agent, ..."""
    limit = settings.limits.page_records
    total = recording.phase(phase).steps.count()
    if episode is None:
        columns = step_columns(recording, phase, start=rows.start, stop=_stop(rows, total, limit))
        return _columns(recording, columns, rows.start, total)
    require_few(len(recording.phase(phase).episode(episode)), limit)
    columns = step_columns(recording, phase, episode=episode)
    return _columns(recording, columns, int(columns["step"][0]), total)


@router.get(
    "/plot.svg",
    response_class=Response,
    responses=media_docs(SVG),
    summary="Every metric in one figure.",
)
async def plot(
    run: RecordedRun, compute: ComputationOf, options: Annotated[FigureOptions, Query()]
) -> Response:
    """Return the figure that `dualtaxi plot` draws, of some metrics or all."""
    return Response(await compute(figure_of, [run.recording], options), media_type=SVG)


def _stop(rows: range, total: int, limit: int) -> int:
    """Return the end of a range of which only some records are there."""
    stop = min(rows.stop, total)
    require_few(stop - rows.start, limit)
    return stop


def _columns(recording: Recording, columns: dict[str, Array], start: int, total: int) -> Response:
    lists = {name: values.tolist() for name, values in columns.items()}
    page = {"run_id": recording.run_id, "start": start, "total": total, "columns": lists}
    return json_response(computed.as_json(page))


comparing = APIRouter(
    tags=["comparing"],
)
CSV: Final = "text/csv"
MAX_RUNS: Final = 1000
RunNames = Annotated[
    tuple[str, ...], Field(min_length=1, max_length=MAX_RUNS, description="A run; may be repeated.")
]
RunName = Annotated[
    str, Field(max_length=200, description="A run: its id, the beginning of it, its name, ...")
]
Part = Annotated[str, Path(max_length=120)]


class CurvesOfRuns(CurveOptions, frozen=True):
    """Runs, and the options of their curves."""

    run: RunNames
    lines: bool = Field(False, description="Include the single runs of each curve.")


class FigureOfRuns(FigureOptions, frozen=True):
    """Runs, and the options of their figure."""

    run: RunNames


@comparing.get("/explanations", summary="The names of the explanations that `dualtaxi explain` left.")
def explanations(settings: SettingsOf) -> list[str]:
    """Return names, each of a pair and a metric: `A-B-1f2e3d4c/success_percent`."""
    return [name for folder in settings.recordings for name in explanations_in(folder)]


@comparing.get("/explanations/{pair}/{metric}", summary="An explanation.")
def explanation(pair: Part, metric: Part, settings: SettingsOf) -> dict[str, object]:
    """Return what `dualtaxi explain --json` printed; null where there is no interval."""
    values: dict[str, object] = finite(found_explanation(pair, metric, settings).as_json())
    return values


def found_explanation(pair: str, metric: str, settings: ServiceSettings) -> Explanation:
    """Return an explanation in the recordings folders.

    Raises:
        RunNotFound: there is none.
    """
    name = f"{pair}/{metric}"
    folder = next((folder for folder in settings.recordings if name in explanations_in(folder)), None)
    if folder is None:
        raise RunNotFound(f"no explanation {name!r}: the page of sweeps lists those there are.")
    return read_explanation(name, folder)


@comparing.get("/curves", response_model=Curves, summary="The curves of several runs, seeds as one curve.")
async def curves(
    catalogue: CatalogueOf, compute: ComputationOf, options: Annotated[CurvesOfRuns, Query()]
) -> Response:
    """Return every metric over an axis, runs that differ in nothing but the seed as one curve with a band."""
    paths = await _recordings(catalogue, options.run)
    return await compute.json(curves_of, paths, options, options.lines)


@comparing.get(
    "/curves.csv",
    response_class=Response,
    responses=media_docs(CSV),
    summary="The points of the curves of several runs.",
)
async def curves_table(
    catalogue: CatalogueOf, compute: ComputationOf, options: Annotated[CurvesOfRuns, Query()]
) -> Response:
    """Return the curves as a table: the axis, and each curve with its band and its runs."""
    paths = await _recordings(catalogue, options.run)
    return Response(await compute(curves_of, paths, options, options.lines, True), media_type=CSV)


@comparing.get(
    "/curves.svg",
    response_class=Response,
    responses=media_docs(SVG),
    summary="The curves of several runs in one figure.",
)
async def curves_picture(
    catalogue: CatalogueOf, compute: ComputationOf, options: Annotated[FigureOfRuns, Query()]
) -> Response:
    """Return the figure that `dualtaxi plot` draws, of some metrics or all."""
    paths = await _recordings(catalogue, options.run)
    return Response(await compute(figure_of, paths, options), media_type=SVG)


async def _recordings(catalogue: Catalogue, names: Sequence[str]) -> list[pathlib.Path]:
    return [run.recording for run in await run_in_threadpool(found_runs, catalogue, names)]


def found_runs(catalogue: Catalogue, names: Sequence[str], several: bool = False) -> list[Run]:
    """Return the runs of some names, their recordings restored if they are archived.

    With `several`, a name means all runs of that name, each once.
    """
    if several:
        by_folder = {run.folder: run for name in names for run in catalogue.find_all(name)}
        return [recorded_run(run) for run in by_folder.values()]
    return [recorded_run(catalogue.find(name)) for name in names]
