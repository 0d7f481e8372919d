"""What if another action had been taken: where each leads, and the replay of one."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Response
from pydantic import Field

from runner.service import fragments
from runner.service.api.debugging import At
from runner.service.api.replay import STEPS
from runner.service.dependencies import ComputationOf, RecordedRun
from runner.service.fragments import ShownBranches
from runner.service.pages.frame import RunPage
from runner.service.pages.replay import BEFORE, T, stage_of, step_of

router = APIRouter(prefix="/runs/{run}", include_in_schema=False)

Action = Annotated[str, Field(max_length=200)]


@router.get("/what-if/{at}")
@router.get("/what-if/{at}/{action}")
async def what_if(
    run: RecordedRun,
    compute: ComputationOf,
    at: At,
    action: Action | None = None,
    t: T | None = None,
) -> Response:
    """Show where each joint action leads, and the replay of one: the recorded one unless it is named."""
    step = await step_of(run, compute, at)
    shown_t = step.t if t is None else t
    start = max(0, shown_t - BEFORE)
    branches = await compute.shown(ShownBranches, fragments.what_if_page, run, step, action, start, STEPS)

    def show() -> dict[str, object]:
        return {
            "at": str(step),
            "title": f"What if? {step.heading}, step {step.t:,}",
            "found": branches,
            "stage": stage_of(branches.part, shown_t),
            "source": f"/api/v1/runs/{run.run_id}/what-if/{step}/{branches.action}",
            "recorded": f"/runs/{run.run_id}/replay/{step.episode_path}?t={step.t}",
        }

    return RunPage(run, "replay", "run_what_if.html", show)
