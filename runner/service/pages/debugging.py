"""What if another action had been taken: where each leads, and the replay of one."""

from __future__ import annotations

import json
from typing import Annotated

from fastapi import APIRouter, Response
from pydantic import Field

from runner.service import fragments
from runner.service.api.debugging import At
from runner.service.api.replay import STEPS
from runner.service.dependencies import ComputationOf, RecordedRun
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
    found = json.loads(await compute(fragments.what_if_page, run.recording, step, action, start, STEPS))
    return RunPage(
        run,
        "replay",
        "run_what_if.html",
        lambda: {"step": step, "found": found, "stage": stage_of(found, shown_t)},
    )
