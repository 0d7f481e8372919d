"""Views over HTTP: an API route and a page with a form for each, of a run or of all runs."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from http import HTTPStatus
from typing import Annotated, Any, Final, Literal

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import HTMLResponse
from pydantic import AfterValidator, BaseModel, Field, TypeAdapter, create_model
from pydantic_core import PydanticCustomError
from starlette.concurrency import run_in_threadpool

from runner.analysis.contents import damage_of
from runner.analysis.sections import Grid
from runner.errors import RecordingError, RunnerError
from runner.recording.reader import open_recording
from runner.runs.run import Run
from runner.service import computed
from runner.service.api.files import OCTETS
from runner.service.api.reading import RunName, RunNames, found_runs
from runner.service.computed import AnswerForm, link, require_few
from runner.service.dependencies import (
    CatalogueOf,
    Computation,
    ComputationOf,
    RecordedRun,
    SettingsOf,
    json_response,
)
from runner.service.errors import EXPECTED
from runner.service.pages.rendering import Page, StatusName, installed_names, run_page
from runner.service.problems import filled, media_docs, status_of
from runner.util.row_text import cell_of
from runner.views import shipped_views, view_named
from runner.views.queries import FIND, MAX_QUERY, MAX_ROWS, SQL
from runner.views.view import Input, View, rows_in

api = APIRouter()
pages = APIRouter(include_in_schema=False)
_NAMES: Final[dict[str, Any]] = {
    "pair": {"a": (RunName, ...), "b": (RunName, ...)},
    "runs": {"run": (RunNames, ...)},
}
"""What a query has of several runs: the names of two, or of any number."""
MAX_THUMBNAILS: Final = 24
"""The most hits that a page shows pictures of."""
PageNumber = Annotated[int, Query(alias="page", ge=1, lt=10**9)]


def _add_routes(view: View) -> None:
    given_type = _type_of(view)

    def add(form: AnswerForm, ending: str, media_type: str, summary: str, **options: Any) -> None:
        async def answer(
            run: RecordedRun, compute: ComputationOf, settings: SettingsOf, given: Any
        ) -> Response:
            if view.rows_per_page:
                require_few(len(rows_in(given.start, given.stop)), settings.limits.page_records)
            body = await _answer(compute, run, view, form, given)
            return Response(body, media_type=media_type)

        answer.__annotations__["given"] = Annotated[given_type, Query()]
        path = f"/{view.name}{ending}"
        description = f"As `dualtaxi {view.name}` returns it."
        described = {"name": path[1:], "summary": summary, "description": description} | options
        api.get(f"/runs/{{run}}{path}", tags=["reading"], **described)(answer)

    if view.subject == "recording":
        add(
            "json",
            "",
            "application/json",
            view.help.partition("\n")[0],
            response_model=dict[str, object],
        )
    if view.file_ending:
        documented = {"response_class": Response, "responses": media_docs(OCTETS)}
        add("file", view.file_ending, OCTETS, view.file_help, **documented)

    if view.is_live:

        async def part(
            run: RecordedRun,
            compute: ComputationOf,
            given: BaseModel,
            status: StatusName,
            number: PageNumber = 1,
        ) -> Response:
            """Return the answer; 204 if the run no longer has this status."""
            if run.status != status:
                return Response(status_code=HTTPStatus.NO_CONTENT)
            return HTMLResponse(await _answer(compute, run, view, "html", given, number))

        part.__annotations__["given"] = Annotated[given_type, Query()]
        pages.get(f"/runs/{{run}}/{view.name}/part")(part)

    @pages.get(f"/runs/{{run}}/{view.name}")
    async def page(
        request: Request, run: RecordedRun, compute: ComputationOf, number: PageNumber = 1
    ) -> Response:
        """Show the form, and the answer to what it asks."""
        query = request.query_params
        form = {given.name: query.get(given.name, "").strip() for given in view.inputs.values()}
        body, problem = b"", None
        try:
            if view.has_default or any(form.values()):
                given = filled(given_type, form)
                body = await _answer(compute, run, view, "html", given, number)
        except RunnerError as error:
            problem = error
        live = ""
        if view.is_live and run.status == "running":
            asked = {name: text for name, text in form.items() if text}
            shown_page = {"page": number} if number > 1 else {}
            live = link(f"/runs/{run.run_id}/{view.name}/part", asked | shown_page | {"status": run.status})
        values = {"view": view, "given": form, "body": body.decode(), "problem": problem, "live": live}
        status = status_of(problem) if isinstance(problem, RecordingError) else None
        return run_page(run, view.name, "run_view.html", lambda: values | _form_values(run, view), status)


def _add_route_of_runs(view: View) -> None:
    async def answer(catalogue: CatalogueOf, compute: ComputationOf, given: Any) -> Response:
        values = given.model_dump()
        names = [values.pop(name) for name in _NAMES[view.subject]]
        several = view.subject == "runs"
        runs = await run_in_threadpool(found_runs, catalogue, names[0] if several else names, several)
        return await compute.json(computed.answer, runs, view.compute, "json", tuple(values.items()))

    answer.__annotations__["given"] = Annotated[_type_of(view), Query()]
    api.get(
        f"/{view.name}",
        name=view.name,
        tags=["comparing"],
        response_model=dict[str, object],
        summary=view.help.partition("\n")[0],
        description=f"As `dualtaxi {view.name}` returns it.",
    )(answer)


async def _answer(
    compute: Computation, run: Run, view: View, form: AnswerForm, given: BaseModel, page: int | None = None
) -> bytes:
    """Return the answer to what is given; on a page, with its own values, and of a long list its rows."""
    values = given.model_dump()
    if page is not None:
        values |= view.page_values
        if view.rows_per_page:
            values |= {"start": (page - 1) * view.rows_per_page, "stop": page * view.rows_per_page}
    asked = view.compute, form, tuple(values.items())
    if view.subject == "run":
        return await compute.uncached(computed.answer, run, *asked)
    return await compute(computed.answer, run.recording, *asked, alone=view.exclusive_spool)


def _type_of(view: View) -> type[BaseModel]:
    """Return the type of the inputs of a view in the query of a request."""

    def declared(given: Input) -> tuple[Any, Any]:
        kind: Any = Literal[tuple(given.values)] if given.values else given.kind
        if given.check is not None:
            kind = Annotated[kind, AfterValidator(partial(_checked, given.check, given.metavar))]
        if not (given.required or given.multiple or given.default is not None):
            kind |= None
        limits: dict[str, Any] = (
            {} if given.kind is bool or given.values else {"max_length": given.max_length}
        )
        if given.kind in (int, float):
            limits = {"ge": given.minimum, "le": given.maximum}
        if given.kind is float:
            limits["allow_inf_nan"] = False
        default: Any = ... if given.required else given.default
        if given.multiple:
            kind = tuple[kind, ...]
            default = ()
        return kind, Field(default, alias=given.name, description=given.help, **limits)

    fields: Any = _NAMES.get(view.subject, {}) | {
        name: declared(declared_input) for name, declared_input in view.inputs.items()
    }
    made: type[BaseModel] = create_model(view.title, **fields)
    return made


def _checked(check: Callable[[str], object], expected: str, text: str) -> str:
    """Return a text that passes the check of an input."""
    try:
        check(text)
    except RunnerError:
        raise PydanticCustomError(EXPECTED, "{expected}", {"expected": expected}) from None
    return text


def _form_values(run: Run, view: View) -> dict[str, object]:
    """Return texts of a run to choose from in the form of a view, or why it has none, and what is damaged."""
    with open_recording(run.recording) as recording:
        refusal = view.refusal(recording) if view.refusal is not None and run.can_train_again else ""
        damage = damage_of(run, recording).partition(": ")[2]
        choices = {
            given.name: given.choices(recording)
            for given in view.inputs.values()
            if given.choices is not None
        }
    return {"choices": choices, "refusal": refusal, "damage": damage}


for _view in (*shipped_views(), *map(view_named, installed_names())):
    if _view.is_served:
        if _view.has_tab:
            _add_routes(_view)
        else:
            _add_route_of_runs(_view)


Sql = Annotated[str, Query(max_length=MAX_QUERY, description="One SELECT, as for `dualtaxi sql`.")]
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
        20,
        ge=0,
        le=MAX_ROWS,
        description=f"Maximum number of episodes; 0 for the most of a server, {MAX_ROWS:,}.",
    )


SearchOf = Annotated[EpisodeQuestion, Query()]


@api.get(
    "/sql",
    tags=["runs"],
    response_model=QueryResponse,
    summary="Ask the runs, and every step of them, in SQL.",
)
async def sql(request: Request, query: Sql, runs: Runs = "") -> Response:
    """Return the first rows that `dualtaxi sql` returns."""
    return json_response(await _answer_query(request, computed.query, query, runs))


@api.get(
    "/find",
    tags=["runs"],
    response_model=dict[str, object],
    summary="Find the episodes of all runs that match an expression.",
)
async def find(request: Request, search: SearchOf) -> Response:
    """Return what `dualtaxi find --json` prints."""
    return json_response(await _answer_query(request, computed.find, *search.model_dump().values()))


@pages.get("/find")
async def find_page(request: Request, search: SearchOf) -> Response:
    """Show the form, and the episodes that match."""
    asked = search.model_dump()
    values: dict[str, object] = {
        "view": FIND,
        "given": asked,
        "problem": "",
        "found": None,
        "kept": {},
        "left_out": (),
        "max_thumbnails": MAX_THUMBNAILS,
    }
    try:
        if search.expression.strip():
            from runner.query.find import Found  # needs the extra

            answer = await _answer_query(request, computed.find, *asked.values())
            result = TypeAdapter(Found).validate_json(answer)
            kept = {"found": link("", asked).removeprefix("?")}
            links = [hit.replay and link(hit.replay, kept) for hit in result.hits]
            values |= {"found": result, "left_out": result.left_out, "links": links, "kept": kept}
    except RunnerError as error:
        values["problem"] = error
    return Page("find.html", values)


@pages.get("/sql")
async def sql_page(request: Request, query: Sql = "", runs: Runs = "") -> Response:
    """Show the form, and the answer to a query."""
    values: dict[str, object] = {
        "view": SQL,
        "given": {"query": query, "runs": runs},
        "problem": "",
        "left_out": [],
        "grid": None,
    }
    try:
        if query.strip():
            answer = json.loads(await _answer_query(request, computed.query, query, runs))
            rows = [tuple(map(cell_of, row)) for row in answer["rows"]]
            values |= answer | {"grid": Grid(tuple(answer["columns"]), rows)}
    except RunnerError as error:
        values["problem"] = error
    return Page("sql.html", values)


async def _answer_query(request: Request, function: Callable[..., bytes], *asked: object) -> bytes:
    """Return the answer to a question about all runs: computed in a process with limits."""
    state = request.app.state
    answer: bytes = await state.processes(function, state.settings, *asked)
    return answer
