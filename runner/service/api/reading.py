"""What a recording holds: measures, episodes, steps, tables, plots."""

from __future__ import annotations

from http import HTTPStatus
from typing import TYPE_CHECKING, Annotated, Any, Literal

from fastapi import APIRouter, Path, Query, Request, Response
from pydantic import BaseModel

from runner.analysis.frames import Phase, episode_columns, step_columns
from runner.recording.reader import Recording
from runner.service import computed
from runner.service.computed import too_many
from runner.service.dependencies import (
    CacheOf,
    OpenRecording,
    ProcessesOf,
    RecordedRun,
    SettingsOf,
    recording_state,
)
from runner.service.errors import Refused
from runner.service.problems import error_docs, media_docs
from runner.service.response_cache import ALWAYS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from runner.runs.run import Run
    from runner.service.processes import ProcessPool
    from runner.service.response_cache import ResponseCache
    from runner.service.settings import Settings

router = APIRouter(
    prefix="/runs/{run}",
    tags=["reading"],
    responses=error_docs(HTTPStatus.BAD_REQUEST, HTTPStatus.NOT_FOUND, HTTPStatus.CONFLICT),
)
BUSY = error_docs(HTTPStatus.SERVICE_UNAVAILABLE, HTTPStatus.NOT_IMPLEMENTED)
"""What else may become of work in a process of its own."""
ARROW = "application/vnd.apache.arrow.stream"
MEDIA = {"svg": "image/svg+xml", "png": "image/png", "pdf": "application/pdf"}
FEW = 1000
"""Records in an answer unless asked otherwise."""

Number = Annotated[int, Query(ge=0, lt=2**62)]
Start = Annotated[int, Query(ge=0, lt=2**62, description="The first, from 0.")]
Stop = Annotated[
    int | None, Query(ge=0, lt=2**62, description=f"Behind the last; else {FEW:,} from `start`.")
]
Step = Annotated[int | None, Query(ge=0, lt=2**62, description="After so many training steps.")]
Episode = Annotated[int | None, Query(ge=0, lt=2**62, description="After so many training episodes.")]


InPhase = Annotated[Phase, Path(description="`train`, or `eval`: the trials of evaluations.")]


class Curve(BaseModel):
    """A metric over training episodes."""

    metric: str
    line: str
    """An agent or a reward; empty if it has one line only."""
    title: str
    unit: str
    episodes: list[float]
    values: list[float | None]
    of: int
    """How many points there are between `start` and `stop`."""
    thinned: bool
    """Whether not all of them are given: of each stretch the lowest and the highest."""


class Curves(BaseModel):
    """The metrics of a run."""

    run_id: str
    curves: list[Curve]


class Records(BaseModel):
    """Some records of a run, one object each."""

    run_id: str
    start: int
    total: int
    records: list[dict[str, Any]]


class Columns(BaseModel):
    """Some records of a run, a list for each field."""

    run_id: str
    start: int
    total: int
    """How many there are in all."""
    columns: dict[str, list[Any]]


@router.get("/metrics", response_model=Curves, responses=BUSY, summary="The curves of a run's metrics.")
async def metrics(
    run: RecordedRun,
    request: Request,
    cache: CacheOf,
    processes: ProcessesOf,
    metric: Annotated[list[str] | None, Query(max_length=100, description="Which; else all.")] = None,
    start: Number = 0,
    stop: Annotated[
        int | None, Query(ge=0, lt=2**62, description="Behind the last training episode.")
    ] = None,
    points: Annotated[int, Query(ge=0, le=100_000, description="At most so many a curve; 0: all.")] = 0,
) -> Response:
    """Return every metric over training episodes, as plots show it.

    With `points`, of longer curves the lowest and the highest value of each stretch are given, and
    `thinned` says so; ask again with `start` and `stop` for a part at full resolution.
    """
    key = ("metrics", recording_state(run), request.url.query)
    wanted = tuple(metric or ())
    body = await cache.get_or_await(
        key, lambda: processes(computed.curves, run.recording, wanted, start, stop, points), ALWAYS
    )
    return Response(body, media_type="application/json")


@router.get(
    "/evaluations",
    response_model=Records,
    responses=BUSY,
    summary="The evaluations, with every event counted.",
)
async def evaluations(
    run: RecordedRun,
    cache: CacheOf,
    processes: ProcessesOf,
    settings: SettingsOf,
    start: Start = 0,
    stop: Stop = None,
) -> Response:
    """Return evaluations as `dualtaxi show --json` has them under `eval`."""
    return await _records(run, cache, processes, settings, "evaluations", start, stop)


@router.get("/training", response_model=Records, responses=BUSY, summary="The reports of training.")
async def training(
    run: RecordedRun,
    cache: CacheOf,
    processes: ProcessesOf,
    settings: SettingsOf,
    start: Start = 0,
    stop: Stop = None,
) -> Response:
    """Return reports of training as `dualtaxi show --json` has them under `train`."""
    return await _records(run, cache, processes, settings, "training", start, stop)


@router.get(
    "/optimality", response_model=Records, responses=BUSY, summary="The exact measures of evaluations."
)
async def optimality(
    run: RecordedRun,
    cache: CacheOf,
    processes: ProcessesOf,
    settings: SettingsOf,
    start: Start = 0,
    stop: Stop = None,
) -> Response:
    """Return what evaluations know exactly; nothing unless `evaluation.exact` was set."""
    return await _records(run, cache, processes, settings, "optimality", start, stop)


@router.get(
    "/{table}/{phase}.arrow",
    response_class=Response,
    responses=media_docs(ARROW) | BUSY,
    summary="Steps or episodes by range, as Arrow.",
)
async def arrow(
    run: RecordedRun,
    processes: ProcessesOf,
    settings: SettingsOf,
    table: Literal["steps", "episodes"],
    phase: InPhase,
    start: Start = 0,
    stop: Stop = None,
) -> Response:
    """Return the same columns as a stream of Arrow's IPC format."""
    most = settings.limits.page_arrow
    stop = start + FEW if stop is None else stop
    if stop - start > most:
        raise too_many(stop - start, most)
    body = await processes(computed.arrow, run.recording, table, phase, start, stop)
    return Response(body, media_type=ARROW)


@router.get("/episodes/{phase}", response_model=Columns, summary="Episodes by range.")
def episodes(
    recording: OpenRecording, settings: SettingsOf, phase: InPhase, start: Start = 0, stop: Stop = None
) -> Response:
    """Return episodes as columns: length, return of each agent, events, how it ended."""
    total = recording.count(recording.topic(f"/{phase}/episode"))
    stop = _bounded(start, stop, total, settings.limits.page_records)
    return _columns(recording, episode_columns(recording, phase, start, stop), start, total)


@router.get("/steps/{phase}", response_model=Columns, summary="Steps by range, or of one episode.")
def steps(
    recording: OpenRecording,
    settings: SettingsOf,
    phase: InPhase,
    start: Start = 0,
    stop: Stop = None,
    episode: Annotated[int | None, Query(ge=0, lt=2**62, description="Instead: all of this one.")] = None,
) -> Response:
    """Return steps as columns: state, joint action, next state, reward of each agent, ..."""
    most = settings.limits.page_records
    total = recording.count(recording.topic(f"/{phase}/step"))
    if episode is not None:
        columns = step_columns(recording, phase, episode=episode)
        if len(columns["step"]) > most:
            raise too_many(len(columns["step"]), most)
        return _columns(recording, columns, int(columns["step"][0]), total)
    columns = step_columns(recording, phase, start=start, stop=_bounded(start, stop, total, most))
    return _columns(recording, columns, start, total)


@router.get("/qtable", responses=BUSY, summary="The Q-table at any step: what is told of it.")
async def q_table(
    run: RecordedRun,
    request: Request,
    cache: CacheOf,
    processes: ProcessesOf,
    step: Step = None,
    episode: Episode = None,
    state: Annotated[
        int | None, Query(ge=0, lt=2**31, description="Also the values of this state, with their history.")
    ] = None,
) -> dict[str, Any]:
    """Return size, fill and range of each learner's exact table, as `dualtaxi qtable --json` tells it."""
    body = await _q_table(run, request, cache, processes, step, episode, state, "json")
    return Response(body, media_type="application/json")  # type: ignore[return-value]


@router.get(
    "/qtable.npy",
    response_class=Response,
    responses=media_docs("application/octet-stream") | BUSY,
    summary="The Q-table at any step, whole.",
)
async def q_table_whole(
    run: RecordedRun,
    request: Request,
    cache: CacheOf,
    processes: ProcessesOf,
    step: Step = None,
    episode: Episode = None,
) -> Response:
    """Return the exact table as a NumPy file: float64 [states, actions], of several [learners, ...]."""
    body = await _q_table(run, request, cache, processes, step, episode, None, "npy")
    return Response(body, media_type="application/octet-stream")


@router.get(
    "/plot.{form}",
    response_class=Response,
    responses=media_docs(*MEDIA.values()) | BUSY,
    summary="Every metric in one figure.",
)
async def plot(
    run: RecordedRun, cache: CacheOf, processes: ProcessesOf, form: Literal["svg", "png", "pdf"]
) -> Response:
    """Return the figure that `dualtaxi plot` draws."""
    key = ("plot", recording_state(run), form)
    body = await cache.get_or_await(key, lambda: processes(computed.plot, [run.recording], form), ALWAYS)
    return Response(body, media_type=MEDIA[form])


async def _q_table(
    run: Run,
    request: Request,
    cache: ResponseCache,
    processes: ProcessPool,
    step: int | None,
    episode: int | None,
    state: int | None,
    form: Literal["json", "npy"],
) -> bytes:
    if step is not None and episode is not None:
        raise Refused(HTTPStatus.UNPROCESSABLE_ENTITY, "query: found step and episode, expected one of them.")
    key = ("qtable", recording_state(run), request.url.query, form)
    return await cache.get_or_await(
        key, lambda: processes(computed.q_table, run.recording, step, episode, state, form), ALWAYS
    )


def _bounded(start: int, stop: int | None, total: int, most: int) -> int:
    """Return behind which record to stop.

    Raises:
        Refused: that is too many.
    """
    stop = min(start + FEW if stop is None else stop, total)
    if stop - start > most:
        raise too_many(stop - start, most)
    return stop


async def _records(
    run: Run,
    cache: ResponseCache,
    processes: ProcessPool,
    settings: Settings,
    which: computed.Which,
    start: int,
    stop: int | None,
) -> Response:
    """Return some records; found in a process of its own, as all of them are read for it."""
    stop = start + FEW if stop is None else stop
    key = ("records", recording_state(run), which, start, stop)
    most = settings.limits.page_records
    body = await cache.get_or_await(
        key, lambda: processes(computed.records, run.recording, which, start, stop, most), ALWAYS
    )
    return Response(body, media_type="application/json")


def _columns(recording: Recording, columns: dict[str, NDArray[Any]], start: int, total: int) -> Response:
    lists = {name: values.tolist() for name, values in columns.items()}
    told = {"run_id": recording.run_id, "start": start, "total": total, "columns": lists}
    return Response(computed.as_json(told), media_type="application/json")
