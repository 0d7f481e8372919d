"""The actions at a step of a recorded episode: where each leads, with the replay of one of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

from fastapi import APIRouter, Request, Response
from pydantic import Field
from starlette.concurrency import run_in_threadpool

from runner.analysis.step_reference import StepRef
from runner.service import fragments
from runner.service.api.debugging import At
from runner.service.api.replay import STEPS
from runner.service.dependencies import ComputationOf, RecordedRun
from runner.service.fragments import ShownBranches
from runner.service.pages.frame import RunView, head_of
from runner.service.pages.rendering import page
from runner.service.pages.replay import BEFORE, ShownStep, T, shown_step

router = APIRouter(prefix="/runs/{run}/what-if", include_in_schema=False)
Action = Annotated[str, Field(max_length=200)]


@dataclass(frozen=True)
class _WhatIfView(RunView):
    TEMPLATE: ClassVar = "run_what_if.html"
    at: str
    title: str
    found: ShownBranches
    step: ShownStep
    source: str
    """Address of the branch's data."""
    recorded: str
    """Address of the recorded episode at the step."""


@router.get("/{at}")
@router.get("/{at}/{action}")
async def what_if(
    request: Request,
    run: RecordedRun,
    compute: ComputationOf,
    at: At,
    action: Action | None = None,
    t: T | None = None,
) -> Response:
    """Show where each joint action leads, and the replay of one: the recorded one unless it is named."""
    step = StepRef.parse(at)
    shown_t = step.t if t is None else t
    start = max(0, shown_t - BEFORE)
    found = await compute.shown(ShownBranches, fragments.what_if_page, run, step, action, start, STEPS)

    def show() -> Response:
        view = _WhatIfView(
            run=head_of(run),
            here="replay",
            at=str(step),
            title=f"What if? {step.episode_name}, step {step.t:,}",
            found=found,
            step=shown_step(found.part, shown_t),
            source=f"/api/v1/runs/{run.run_id}/what-if/{step}/{found.action}",
            recorded=f"/runs/{run.run_id}/replay/{step.episode_path}?t={step.t}",
        )
        return page(request, view)

    return await run_in_threadpool(show)
