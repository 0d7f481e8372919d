"""Views over HTTP: an API route and a page with a form for each."""

from __future__ import annotations

from http import HTTPStatus
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, Field, ValidationError, create_model
from starlette.concurrency import run_in_threadpool

from runner.errors import RunnerError
from runner.recording.reader import open_recording
from runner.runs.run import Run
from runner.service import computed, fragments
from runner.service.dependencies import ComputationOf, RecordedRun
from runner.service.pages.frame import run_page
from runner.service.pages.rendering import message_of
from runner.service.problems import RUN_ERRORS, error_docs
from runner.views import VIEWS
from runner.views.view import Input, View

api = APIRouter(
    prefix="/runs/{run}",
    tags=["reading"],
    responses=RUN_ERRORS | error_docs(HTTPStatus.SERVICE_UNAVAILABLE),
)
pages = APIRouter(prefix="/runs/{run}", include_in_schema=False)


def _add_routes(view: View) -> None:
    given_type = _type_of(view)

    async def answer(run: RecordedRun, compute: ComputationOf, given: BaseModel) -> Response:
        values = tuple(given.model_dump().items())
        alone = view.exclusive_spool
        return await compute.json(computed.answer, run.recording, view.compute, values, alone=alone)

    answer.__annotations__["given"] = Annotated[given_type, Query()]
    description = f"Return what `dualtaxi {view.name} --json` prints; of a run that was trained here."
    api.get(
        f"/{view.name}",
        name=view.name,
        response_model=dict[str, object],
        summary=view.summary,
        description=description,
    )(answer)

    @pages.get(f"/{view.name}")
    async def page(request: Request, run: RecordedRun, compute: ComputationOf) -> Response:
        """Show the form, and the answer to what it asks."""
        query = request.query_params
        form = {each.name: query.get(each.name, "").strip() for each in view.inputs.values()}
        body, problem = b"", ""
        try:
            given = given_type.model_validate({name: text for name, text in form.items() if text})
            values = tuple((given.model_dump() | dict(view.page_values)).items())
            if any(form.values()):
                alone = view.exclusive_spool
                body = await compute(fragments.answer, run.recording, view.compute, values, alone=alone)
        except ValidationError as error:
            if any(form.values()):
                raise RequestValidationError(error.errors()) from error
        except RunnerError as error:
            problem = message_of(error, request)
        shown = {"view": view, "form": form, "body": body.decode(), "problem": problem}
        status = HTTPStatus.BAD_REQUEST if problem else HTTPStatus.OK
        return await run_in_threadpool(_page, request, run, shown, status)


def _type_of(view: View) -> type[BaseModel]:
    """Return the type of the inputs of a view in the query of a request."""

    def declared(given: Input) -> tuple[Any, Any]:
        kind: Any = str if given.required else str | None if given.default is None else type(given.default)
        limits: dict[str, Any] = {} if kind is bool else {"max_length": given.max_length}
        if kind is int:
            limits = {"ge": 0, "le": given.maximum}
        default = ... if given.required else given.default
        return kind, Field(default, alias=given.name, description=given.help, **limits)

    fields: Any = {name: declared(each) for name, each in view.inputs.items()}
    made: type[BaseModel] = create_model(view.title, **fields)
    return made


def _page(request: Request, run: Run, shown: dict[str, Any], status: HTTPStatus) -> Response:
    """Return the page of a view, with the texts to choose from in its form."""
    view: View = shown["view"]
    with open_recording(run.recording) as recording:
        choices = {each.name: each.choices(recording) for each in view.inputs.values() if each.choices}
    return run_page(request, run, view.name, "run_view.html", shown | {"choices": choices}, status)


for _view in VIEWS.values():
    _add_routes(_view)
