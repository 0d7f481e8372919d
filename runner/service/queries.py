"""Questions about all runs of a server, in SQL or for episodes: API routes, and pages with a form."""

from __future__ import annotations

import json
from collections.abc import Callable, Hashable
from functools import partial
from typing import Annotated, Final, Literal

from fastapi import APIRouter, Query, Request, Response
from pydantic import BaseModel, Field, TypeAdapter

from runner.analysis.sections import Grid
from runner.errors import RunnerError
from runner.query.text import cell_of
from runner.service import computed
from runner.service.computed import link
from runner.service.dependencies import json_response
from runner.service.pages.rendering import Page
from runner.views.find import VIEW as FIND
from runner.views.sql import VIEW as SQL

MAX_PICTURES: Final = 24
"""The most hits that a page shows pictures of."""
api = APIRouter(tags=["runs"])
pages = APIRouter(include_in_schema=False)

Sql = Annotated[str, Query(max_length=10_000, description="One SELECT, as for `dualtaxi sql`.")]
Runs = Annotated[str, Query(max_length=3000, description="A filter of runs, as for `dualtaxi ls`.")]


class QueryResponse(BaseModel):
    """The first 1,000 rows of a query."""

    columns: list[str]
    rows: list[list[object]]
    more: bool
    """Whether there are more rows."""
    left_out: list[str]
    """Sentences on the runs that were left out."""


class EpisodeQuestion(BaseModel):
    """What is asked about episodes."""

    expression: str = Field("", max_length=1000, description="A condition, as for `dualtaxi find`.")
    runs: str = Field("", max_length=3000, description="A filter of runs, as for `dualtaxi ls`.")
    phase: Literal["", "train", "eval"] = Field("", description="Training or evaluation; both by default.")
    sort: str = Field("", max_length=1000, description="A number to sort by, such as `-ret`.")
    limit: int = Field(
        20, ge=0, le=1000, description="Maximum number of episodes; 0 for the most of a server, 1,000."
    )


SearchOf = Annotated[EpisodeQuestion, Query()]


@api.get(
    "/sql",
    response_model=QueryResponse,
    summary="Ask the runs, and every step of them, in SQL.",
)
async def sql(request: Request, query: Sql, runs: Runs = "") -> Response:
    """Return the first rows that `dualtaxi sql` returns."""
    return json_response(await _answer(request, computed.query, query, runs))


@api.get(
    "/find",
    response_model=dict[str, object],
    summary="Find the episodes of all runs that match an expression.",
)
async def find(request: Request, search: SearchOf) -> Response:
    """Return what `dualtaxi find --json` prints."""
    return json_response(await _answer(request, computed.find, *search.model_dump().values()))


@pages.get("/find")
async def find_page(request: Request, search: SearchOf) -> Response:
    """Show the form, and the episodes that match."""
    asked = search.model_dump()
    shown: dict[str, object] = {
        "view": FIND,
        "given": asked,
        "problem": "",
        "found": None,
        "left_out": (),
        "max_pictures": MAX_PICTURES,
    }
    try:
        if search.expression.strip():
            from runner.query.find import Found  # needs the extra

            answer = await _answer(request, computed.find, *asked.values())
            found = TypeAdapter(Found).validate_json(answer)
            kept = link("", asked).removeprefix("?")
            links = [link(hit.replay, {"found": kept}) for hit in found.hits]
            shown |= {"found": found, "left_out": found.left_out, "links": links}
    except RunnerError as error:
        shown["problem"] = error
    return Page("find.html", shown)


@pages.get("/sql")
async def sql_page(request: Request, query: Sql = "", runs: Runs = "") -> Response:
    """Show the form, and the answer to a query."""
    shown: dict[str, object] = {
        "view": SQL,
        "given": {"query": query, "runs": runs},
        "problem": "",
        "left_out": [],
        "grid": None,
    }
    try:
        if query.strip():
            answer = json.loads(await _answer(request, computed.query, query, runs))
            rows = [tuple(map(cell_of, row)) for row in answer["rows"]]
            shown |= answer | {"grid": Grid(tuple(answer["columns"]), rows)}
    except RunnerError as error:
        shown["problem"] = error
    return Page("sql.html", shown)


async def _answer(request: Request, function: Callable[..., bytes], *asked: Hashable) -> bytes:
    """Return the answer to a question about all runs: computed in a process with limits, or seconds old."""
    state = request.app.state
    make = partial(state.processes, function, state.settings, *asked)
    answer: bytes = await state.cache.get_or_await((function, *asked, state.catalogue.state()), make)
    return answer
