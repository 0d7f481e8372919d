"""The pages of how a run went: what it used of its machine over time, what it printed, and its pictures."""

from __future__ import annotations

from dataclasses import dataclass
from http import HTTPStatus
from typing import Annotated, ClassVar, Literal

from fastapi import APIRouter, Query, Request, Response
from starlette.concurrency import run_in_threadpool

from runner.export.reports.rendering import View
from runner.runs.run import Run
from runner.service import fragments
from runner.service.addresses import link
from runner.service.dependencies import ComputationOf, RecordedRun
from runner.service.fragments import Output
from runner.service.pages.frame import RunView, head_of
from runner.service.pages.rendering import page

router = APIRouter(prefix="/runs/{run}", include_in_schema=False)

Sought = Annotated[str, Query(alias="q", max_length=200)]
Stream = Literal["", "stdout", "stderr"]
Status = Annotated[str, Query(max_length=20)]


@dataclass(frozen=True)
class _SystemView(RunView):
    TEMPLATE: ClassVar = "run_system.html"
    body: str
    live: str
    """Address of the part that changes; empty unless the run is running."""


@dataclass(frozen=True)
class _ConsoleView(RunView):
    TEMPLATE: ClassVar = "run_console.html"
    output: Output
    sought: str
    stream: Stream
    live: str
    """As in `_SystemView`."""


@dataclass(frozen=True)
class _LinesView(View):
    TEMPLATE: ClassVar = "run_console_lines.html"
    output: Output


@router.get("/system")
async def system(request: Request, run: RecordedRun, compute: ComputationOf) -> Response:
    """Show steps a second, and the use of the machine, over time."""
    body = (await compute(fragments.system, run.recording)).decode()
    live = _live(run, "system/part")
    return await run_in_threadpool(page, request, _SystemView(head_of(run), "system", body, live))


@router.get("/system/part")
async def system_part(run: RecordedRun, compute: ComputationOf, status: Status = "running") -> Response:
    """Return what changes of the page; 204 if the run no longer has this status."""
    if run.status != status:
        return Response(status_code=HTTPStatus.NO_CONTENT)
    return Response(await compute(fragments.system, run.recording), media_type="text/html")


@router.get("/pictures")
async def pictures(request: Request, run: RecordedRun, compute: ComputationOf) -> Response:
    """Show the last pictures and films that were logged."""
    body = (await compute(fragments.pictures, run.recording)).decode()
    return await run_in_threadpool(page, request, _SystemView(head_of(run), "pictures", body, ""))


@router.get("/console")
async def console(
    request: Request, run: RecordedRun, compute: ComputationOf, sought: Sought = "", stream: Stream = ""
) -> Response:
    """Show the last lines of the output, or the last that have a text."""
    output = await compute.shown(Output, fragments.console, run.recording, sought, stream)
    live = _live(run, "console/part", q=sought, stream=stream)
    view = _ConsoleView(head_of(run), "console", output, sought, stream, live)
    return await run_in_threadpool(page, request, view)


@router.get("/console/part")
async def console_part(
    request: Request,
    run: RecordedRun,
    compute: ComputationOf,
    sought: Sought = "",
    stream: Stream = "",
    status: Status = "running",
) -> Response:
    """Return the lines alone; 204 if the run no longer has this status."""
    if run.status != status:
        return Response(status_code=HTTPStatus.NO_CONTENT)
    return page(
        request, _LinesView(await compute.shown(Output, fragments.console, run.recording, sought, stream))
    )


def _live(run: Run, path: str, **query: str) -> str:
    """Return the address of a part of the page of a run that is running; empty if it is not."""
    if run.status != "running":
        return ""
    return link(f"/runs/{run.run_id}/{path}", {**query, "status": run.status})
