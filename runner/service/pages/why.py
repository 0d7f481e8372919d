"""Where a Q-value of a run comes from: a form, and the sum with links to the replay."""

from __future__ import annotations

from dataclasses import dataclass
from http import HTTPStatus
from typing import Annotated, ClassVar, Final

from fastapi import APIRouter, Query, Request, Response

from runner.errors import RunnerError
from runner.service import fragments
from runner.service.dependencies import OpenRecording, RecordedRun, RunComputationOf
from runner.service.pages.frame import RunView, head_of
from runner.service.pages.rendering import message_of, page

router = APIRouter(prefix="/runs/{run}", include_in_schema=False)

STEPS: Final = 30
"""Steps that the page lists."""
Name = Annotated[str, Query(max_length=1000)]


@dataclass(frozen=True)
class _WhyView(RunView):
    TEMPLATE: ClassVar = "run_why.html"
    learners: tuple[str, ...]
    state: str
    action: str
    agent: str
    at: str
    body: str
    problem: str


@router.get("/why")
async def why(
    request: Request,
    run: RecordedRun,
    recording: OpenRecording,
    compute: RunComputationOf,
    state: Name = "",
    action: Name = "",
    agent: Name = "",
    at: Annotated[str, Query(max_length=60)] = "",
) -> Response:
    """Show the form, and the parts of the value that it names."""
    body, problem = b"", ""
    if state or action or at:
        given = (text.strip() or None for text in (state, action, agent, at))
        try:
            body = await compute(fragments.why, *given, STEPS, alone=True)
        except RunnerError as error:
            problem = message_of(error, request)
    view = _WhyView(head_of(run), "why", recording.agents, state, action, agent, at, body.decode(), problem)
    return page(request, view, HTTPStatus.BAD_REQUEST if problem else HTTPStatus.OK)
