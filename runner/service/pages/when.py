"""When an expression held in the training of a run: a form, and the answer with links to the replay."""

from __future__ import annotations

from dataclasses import dataclass
from http import HTTPStatus
from typing import Annotated, ClassVar, Final

from fastapi import APIRouter, Query, Request, Response

from runner.debugging.expressions import MAX_CHARACTERS
from runner.errors import RunnerError
from runner.service import fragments
from runner.service.dependencies import RecordedRun, RunComputationOf
from runner.service.fragments import ShownWhen
from runner.service.pages.frame import RunView, head_of
from runner.service.pages.rendering import message_of, page

router = APIRouter(prefix="/runs/{run}", include_in_schema=False)

INTERVALS: Final = 200
"""The most intervals that the page lists."""
StepField = Annotated[str, Query(max_length=40)]


@dataclass(frozen=True)
class _WhenView(RunView):
    TEMPLATE: ClassVar = "run_when.html"
    expression: str
    every: bool
    first: str
    last: str
    found: ShownWhen | None = None
    problem: str = ""


@router.get("/when")
async def when(
    request: Request,
    run: RecordedRun,
    compute: RunComputationOf,
    expression: Annotated[str, Query(max_length=MAX_CHARACTERS)] = "",
    every: Annotated[bool, Query(alias="all")] = False,
    first: Annotated[StepField, Query(alias="from")] = "",
    last: Annotated[StepField, Query(alias="to")] = "",
) -> Response:
    """Show the form, and the steps after which its expression holds."""
    form = (head_of(run), "when", expression, every, first, last)
    if not expression.strip():
        return page(request, _WhenView(*form))
    options = (expression, every, first or None, last or None, INTERVALS)
    try:
        found = await compute.shown(ShownWhen, fragments.when, *options)
    except RunnerError as error:
        return page(request, _WhenView(*form, None, message_of(error, request)), HTTPStatus.BAD_REQUEST)
    return page(request, _WhenView(*form, found))
