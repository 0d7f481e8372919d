"""The pages of how a run went: its machine over time, its output, its pictures, and what was learned."""

from __future__ import annotations

from collections.abc import Callable
from http import HTTPStatus
from pathlib import Path
from typing import Annotated, Literal

from fastapi import APIRouter, Query, Response
from fastapi.responses import HTMLResponse

from runner.runs.run import Run
from runner.service import fragments
from runner.service.addresses import link
from runner.service.dependencies import ComputationOf, RecordedRun
from runner.service.pages.frame import RunPage

router = APIRouter(prefix="/runs/{run}", include_in_schema=False)

Sought = Annotated[str, Query(alias="q", max_length=200)]
Stream = Literal["", "stdout", "stderr"]
StatusName = Annotated[str, Query(max_length=20)]
StateParts = Annotated[
    list[str] | None, Query(max_length=20, description="The parts of the name of a state.")
]


def _add_page(tab: str, body_of: Callable[[Path], bytes], is_live: bool = False) -> None:
    """Add a page of the HTML that a function returns; a live one loads it again while the run is running."""

    @router.get(f"/{tab}")
    async def body_page(run: RecordedRun, compute: ComputationOf) -> Response:
        body = (await compute(body_of, run.recording)).decode()
        values = {"body": body, "live": _live(run, f"{tab}/part") if is_live else ""}
        return RunPage(run, tab, "run_body.html", values)

    if is_live:

        @router.get(f"/{tab}/part")
        async def part(run: RecordedRun, compute: ComputationOf, status: StatusName = "running") -> Response:
            """Return what changes of the page; 204 if the run no longer has this status."""
            if run.status != status:
                return Response(status_code=HTTPStatus.NO_CONTENT)
            return HTMLResponse(await compute(body_of, run.recording))


_add_page("system", fragments.system, is_live=True)
_add_page("pictures", fragments.pictures)


@router.get("/learned")
async def learned(run: RecordedRun, compute: ComputationOf, state: StateParts = None) -> Response:
    """Show the maps of what was learned, in the situation of a state."""
    body = (await compute(fragments.maps, run.recording, tuple(state or ()))).decode()
    return RunPage(run, "learned", "run_body.html", {"body": body, "live": ""})


@router.get("/console")
async def console(
    run: RecordedRun, compute: ComputationOf, sought: Sought = "", stream: Stream = ""
) -> Response:
    """Show the last lines of the output, or the last that have a text."""
    body = (await compute(fragments.console, run.recording, sought, stream)).decode()
    live = _live(run, "console/part", q=sought, stream=stream)
    values = {"body": body, "sought": sought, "stream": stream, "live": live}
    return RunPage(run, "console", "run_console.html", values)


@router.get("/console/part")
async def console_part(
    run: RecordedRun,
    compute: ComputationOf,
    sought: Sought = "",
    stream: Stream = "",
    status: StatusName = "running",
) -> Response:
    """Return the lines alone; 204 if the run no longer has this status."""
    if run.status != status:
        return Response(status_code=HTTPStatus.NO_CONTENT)
    return HTMLResponse(await compute(fragments.console, run.recording, sought, stream))


def _live(run: Run, path: str, **query: str) -> str:
    """Return the address of a part of the page of a run that is running; empty if it is not."""
    if run.status != "running":
        return ""
    return link(f"/runs/{run.run_id}/{path}", {**query, "status": run.status})
