"""What if, when and why: questions about how a run learned, answered from its recording."""

from __future__ import annotations

from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Path, Query, Response
from pydantic import BaseModel

from runner.analysis.episodes import EXPECTED, EpisodeRef
from runner.debugging.action_outcomes import ActionOutcome, Outcome
from runner.debugging.expressions import MAX_CHARACTERS
from runner.debugging.what_if import what_if_in
from runner.debugging.when import when_in
from runner.debugging.why import LIMIT, MAX_LIMIT, why_in
from runner.service import computed, fragments
from runner.service.api.replay import STEPS, Part, Start, Steps
from runner.service.dependencies import ComputationOf, RecordedRun
from runner.service.problems import RUN_ERRORS, error_docs

router = APIRouter(
    prefix="/runs/{run}",
    tags=["reading"],
    responses=RUN_ERRORS | error_docs(HTTPStatus.SERVICE_UNAVAILABLE),
)
MAX_ACTIONS = 1000
At = Annotated[str, Path(max_length=60, description=EXPECTED, examples=["eval:3000:17:5"])]
Expression = Annotated[
    str, Query(max_length=MAX_CHARACTERS, description="A condition.", examples=["max(q[300]) > 20"])
]
StepText = Annotated[str | None, Query(max_length=40, description="A training step: EPISODE:T, or step:N.")]
StateName = Annotated[
    str | None, Query(max_length=1000, description="A state, by number or name; default: that of `at`.")
]
ActionName = Annotated[
    str | None, Query(max_length=1000, description="An action, by number or name; default: that of `at`.")
]
AgentName = Annotated[
    str | None, Query(max_length=200, description="The agent whose Q-table it is in, where each has its own.")
]
StepName = Annotated[
    str | None, Query(max_length=60, description="The value before this step, EPISODE:T or eval:N:TRIAL:T.")
]
ActionPath = Annotated[str, Path(max_length=200, description="A joint action: its number or its name.")]


class WhatIf(BaseModel):
    """The actions at a step, and where each leads."""

    run_id: str
    at: str
    title: str
    state: int
    state_in_words: str
    tables_step: int
    """Training steps that the tables have learned from."""
    learners: list[str]
    policy: str
    epsilon: float
    discount: float
    recorded: Outcome
    actions: list[ActionOutcome]
    """Those of the highest value first."""
    left_out: int
    """Number of further actions, of lower value, that were not played."""
    notes: list[str]


@router.get("/what-if/{at}", response_model=WhatIf, summary="Where each joint action at a step leads.")
async def what_if(
    run: RecordedRun,
    compute: ComputationOf,
    at: At,
    action: Annotated[
        list[str] | None, Query(max_length=MAX_ACTIONS, description="Numbers or names; default: all.")
    ] = None,
) -> Response:
    """Return what `dualtaxi branch --action all --json` prints; of a run that was trained here."""
    return await compute.json(
        computed.answer, run.recording, what_if_in, EpisodeRef.parse(at), tuple(action or ())
    )


@router.get(
    "/what-if/{at}/{action}", response_model=Part, summary="A part of the episode to which an action leads."
)
async def branch(
    run: RecordedRun,
    compute: ComputationOf,
    at: At,
    action: ActionPath,
    start: Start = 0,
    steps: Steps = STEPS,
) -> Response:
    """Return steps in the form of a replay: those recorded up to the step, then those played."""
    return await compute.json(
        fragments.branch_part, run.recording, EpisodeRef.parse(at), action, start, steps
    )


@router.get(
    "/when",
    response_model=dict[str, object],
    summary="The training steps after which an expression holds.",
)
async def when(
    run: RecordedRun,
    compute: ComputationOf,
    expression: Expression,
    every: Annotated[bool, Query(alias="all", description="Find every interval.")] = False,
    first: Annotated[StepText, Query(alias="from")] = None,
    last: Annotated[StepText, Query(alias="to")] = None,
) -> Response:
    """Return what `dualtaxi when --json` prints; of a run that was trained here."""
    return await compute.json(computed.answer, run.recording, when_in, expression, every, first, last)


@router.get(
    "/why",
    response_model=dict[str, object],
    summary="The rewards that a Q-value is the sum of.",
)
async def why(
    run: RecordedRun,
    compute: ComputationOf,
    state: StateName = None,
    action: ActionName = None,
    agent: AgentName = None,
    at: StepName = None,
    limit: Annotated[int, Query(ge=0, le=MAX_LIMIT, description="Most steps, 0 for all.")] = LIMIT,
) -> Response:
    """Return where a Q-value comes from, as `dualtaxi why --json` prints it; of a run trained here."""
    return await compute.json(
        computed.answer, run.recording, why_in, state, action, agent, at, limit, alone=True
    )
