"""The pages of what a run shows: its pictures, and maps of what was learned."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Response

from runner.service import fragments
from runner.service.dependencies import ComputationOf, RecordedRun
from runner.service.pages.frame import RunPage

router = APIRouter(prefix="/runs/{run}", include_in_schema=False)

StateParts = Annotated[
    list[str] | None, Query(max_length=20, description="The parts of the name of a state.")
]


@router.get("/pictures")
async def pictures(run: RecordedRun, compute: ComputationOf) -> Response:
    """Show the logged pictures."""
    body = (await compute(fragments.pictures, run.recording)).decode()
    return RunPage(run, "pictures", "run_body.html", {"body": body})


@router.get("/learned")
async def learned(run: RecordedRun, compute: ComputationOf, state: StateParts = None) -> Response:
    """Show the maps of what was learned, in the situation of a state."""
    body = (await compute(fragments.maps, run.recording, tuple(state or ()))).decode()
    return RunPage(run, "learned", "run_body.html", {"body": body})
