"""Questions about how a run learned: when something held, where a Q-value comes from, where actions lead."""

from __future__ import annotations

from http import HTTPStatus
from typing import Annotated, Final

from fastapi import APIRouter, Query, Request, Response
from pydantic import Field
from starlette.concurrency import run_in_threadpool

from runner.debugging.expressions import MAX_CHARACTERS
from runner.errors import RunnerError
from runner.service import fragments
from runner.service.addresses import step_in
from runner.service.api.debugging import At
from runner.service.api.replay import STEPS
from runner.service.dependencies import ComputationOf, OpenRecording, RecordedRun
from runner.service.fragments import ShownBranches, ShownWhen
from runner.service.pages.frame import run_page
from runner.service.pages.rendering import message_of
from runner.service.pages.replay import BEFORE, T, stage_of

router = APIRouter(prefix="/runs/{run}", include_in_schema=False)

INTERVALS: Final = 200
"""The most intervals that the page of `when` lists."""
WHY_STEPS: Final = 30
"""Steps that the page of `why` lists."""
StepField = Annotated[str, Query(max_length=40)]
Name = Annotated[str, Query(max_length=1000)]
Action = Annotated[str, Field(max_length=200)]


@router.get("/when")
async def when(
    request: Request,
    run: RecordedRun,
    compute: ComputationOf,
    expression: Annotated[str, Query(max_length=MAX_CHARACTERS)] = "",
    every: Annotated[bool, Query(alias="all")] = False,
    first: Annotated[StepField, Query(alias="from")] = "",
    last: Annotated[StepField, Query(alias="to")] = "",
) -> Response:
    """Show the form, and the steps after which its expression holds."""
    found, problem = None, ""
    if expression.strip():
        options = (expression, every, first or None, last or None, INTERVALS)
        try:
            found = await compute.shown(ShownWhen, fragments.when, run.recording, *options)
        except RunnerError as error:
            problem = message_of(error, request)
    form = {"expression": expression, "every": every, "first": first, "last": last}
    values = {**form, "found": found, "problem": problem}
    status = HTTPStatus.BAD_REQUEST if problem else HTTPStatus.OK
    return run_page(request, run, "when", "run_when.html", values, status)


@router.get("/why")
async def why(
    request: Request,
    run: RecordedRun,
    recording: OpenRecording,
    compute: ComputationOf,
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
            body = await compute(fragments.why, run.recording, *given, WHY_STEPS, alone=True)
        except RunnerError as error:
            problem = message_of(error, request)
    form = {"state": state, "action": action, "agent": agent, "at": at}
    values = {**form, "learners": recording.agents, "body": body.decode(), "problem": problem}
    status = HTTPStatus.BAD_REQUEST if problem else HTTPStatus.OK
    return run_page(request, run, "why", "run_why.html", values, status)


@router.get("/what-if/{at}")
@router.get("/what-if/{at}/{action}")
async def what_if(
    request: Request,
    run: RecordedRun,
    compute: ComputationOf,
    at: At,
    action: Action | None = None,
    t: T | None = None,
) -> Response:
    """Show where each joint action leads, and the replay of one: the recorded one unless it is named."""
    step = step_in(at)
    shown_t = step.t if t is None else t
    start = max(0, shown_t - BEFORE)
    branches = await compute.shown(ShownBranches, fragments.what_if_page, run, step, action, start, STEPS)

    def show() -> Response:
        values = {
            "at": str(step),
            "title": f"What if? {step.heading}, step {step.t:,}",
            "found": branches,
            "stage": stage_of(branches.part, shown_t),
            "source": f"/api/v1/runs/{run.run_id}/what-if/{step}/{branches.action}",
            "recorded": f"/runs/{run.run_id}/replay/{step.episode_path}?t={step.t}",
        }
        return run_page(request, run, "replay", "run_what_if.html", values)

    return await run_in_threadpool(show)
