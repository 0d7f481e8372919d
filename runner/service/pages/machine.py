"""The pages of how a run went: what it used of its machine over time, what it printed, and its pictures."""

from __future__ import annotations

from http import HTTPStatus
from typing import Annotated, Literal

from fastapi import APIRouter, Query, Request, Response
from starlette.concurrency import run_in_threadpool

from runner.runs.run import Run
from runner.service import fragments
from runner.service.addresses import link
from runner.service.dependencies import ComputationOf, RecordedRun
from runner.service.fragments import Output
from runner.service.pages.frame import run_page
from runner.service.pages.rendering import page

router = APIRouter(prefix="/runs/{run}", include_in_schema=False)

Sought = Annotated[str, Query(alias="q", max_length=200)]
Stream = Literal["", "stdout", "stderr"]
Status = Annotated[str, Query(max_length=20)]


@router.get("/system")
async def system(request: Request, run: RecordedRun, compute: ComputationOf) -> Response:
    """Show steps a second, and the use of the machine, over time."""
    body = (await compute(fragments.system, run.recording)).decode()
    values = {"body": body, "live": _live(run, "system/part")}
    return await run_in_threadpool(run_page, request, run, "system", "run_system.html", values)


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
    values = {"body": body, "live": ""}
    return await run_in_threadpool(run_page, request, run, "pictures", "run_system.html", values)


@router.get("/console")
async def console(
    request: Request, run: RecordedRun, compute: ComputationOf, sought: Sought = "", stream: Stream = ""
) -> Response:
    """Show the last lines of the output, or the last that have a text."""
    output = await compute.shown(Output, fragments.console, run.recording, sought, stream)
    live = _live(run, "console/part", q=sought, stream=stream)
    values = {"output": output, "sought": sought, "stream": stream, "live": live}
    return await run_in_threadpool(run_page, request, run, "console", "run_console.html", values)


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
    output = await compute.shown(Output, fragments.console, run.recording, sought, stream)
    return page(request, "run_console_lines.html", {"output": output})


def _live(run: Run, path: str, **query: str) -> str:
    """Return the address of a part of the page of a run that is running; empty if it is not."""
    if run.status != "running":
        return ""
    return link(f"/runs/{run.run_id}/{path}", {**query, "status": run.status})
