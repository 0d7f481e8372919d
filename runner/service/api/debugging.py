"""What if another action had been taken: where each leads."""

from __future__ import annotations

from dataclasses import fields
from typing import Annotated, Any, get_type_hints

from fastapi import APIRouter, Path, Query, Response
from pydantic import create_model

from runner.analysis.episodes import EXPECTED
from runner.debugging.action_outcomes import WhatIf
from runner.debugging.what_if import what_if as outcomes_of
from runner.service import computed
from runner.service.api.replay import STEPS, ReplayPart, Start, Steps
from runner.service.dependencies import ComputationOf, RecordedRun

router = APIRouter(
    prefix="/runs/{run}",
    tags=["reading"],
)
MAX_ACTIONS = 1000
StepPath = Annotated[str, Path(max_length=60, description=EXPECTED, examples=["eval:3000:17:5"])]
ActionPath = Annotated[str, Path(max_length=200, description="A joint action: its number or its name.")]


_KINDS = get_type_hints(WhatIf)
_FIELDS: Any = {field.name: (_KINDS[field.name], ...) for field in fields(WhatIf) if field.name != "mdp"}
WhatIfAnswer = create_model("WhatIfAnswer", __doc__=WhatIf.__doc__, **_FIELDS)


@router.get("/what-if/{at}", response_model=WhatIfAnswer, summary="Where each joint action at a step leads.")
async def what_if(
    run: RecordedRun,
    compute: ComputationOf,
    at: StepPath,
    action: Annotated[
        list[str] | None, Query(max_length=MAX_ACTIONS, description="Numbers or names; default: all.")
    ] = None,
) -> Response:
    """Return what `dualtaxi branch --action all --json` prints; of a run that was trained here."""
    return await compute.json(
        computed.answer,
        run.recording,
        outcomes_of,
        "json",
        (("at", at), ("actions", tuple(action or ()))),
    )


@router.get(
    "/what-if/{at}/{action}",
    response_model=ReplayPart,
    summary="A part of the episode to which an action leads.",
)
async def branch(
    run: RecordedRun,
    compute: ComputationOf,
    at: StepPath,
    action: ActionPath,
    start: Start = 0,
    steps: Steps = STEPS,
) -> Response:
    """Return steps in the form of a replay: those recorded up to the step, then those played."""
    return await compute.json(computed.branch_part, run.recording, at, action, start, steps)
