"""Pages and the forms that they send: filled templates."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from http import HTTPStatus
from importlib.resources import files
from typing import Annotated, Final
from urllib.parse import parse_qsl

import jinja2
from fastapi import Depends, Request, Response
from fastapi.responses import RedirectResponse
from markupsafe import Markup
from starlette.concurrency import run_in_threadpool
from starlette.types import Receive, Scope, Send

from runner.errors import RunnerError
from runner.export.reports.rendering import TEMPLATES as REPORT_TEMPLATES
from runner.export.reports.rendering import code, environment_of
from runner.service.computed import link
from runner.service.pages import static
from runner.service.problems import error_body
from runner.util import humanize

TEMPLATES: Final = files("runner.service.pages") / "templates"
SECTIONS: Final = (
    ("/runs", "Runs"),
    ("/find", "Find"),
    ("/sql", "SQL"),
    ("/sweeps", "Sweeps"),
    ("/queue", "Queue"),
    ("/submit", "Submit"),
    ("/disk", "Disk"),
)
MAX_FIELDS: Final = 100
"""Fields of a form."""


Values = Mapping[str, object] | Callable[[], Mapping[str, object]]


@dataclass(frozen=True)
class Viewer:
    """The user of a page, who decides what it offers."""

    name: str
    """Name of the token; empty where none is needed."""
    can_write: bool


class Page(Response):
    """A template, filled with values in a thread when it is sent; a function makes them there.

    The value `problem` is why a request was refused, an error or its message; the status is then 400 by
    default.
    """

    media_type = "text/html"

    def __init__(self, template: str, values: Values, status: HTTPStatus | None = None) -> None:
        super().__init__()
        self._template, self._values, self._status = template, values, status

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the page."""
        self.body = await run_in_threadpool(self._render, Request(scope))
        self.headers["content-length"] = str(len(self.body))
        await super().__call__(scope, receive, send)

    def _render(self, request: Request) -> bytes:
        values = dict(made(self._values))
        problem = values.get("problem")
        self.status_code = self._status or (HTTPStatus.BAD_REQUEST if problem else HTTPStatus.OK)
        if isinstance(problem, RunnerError):
            values["problem"] = message_of(problem, request)
        return render(request.url.path, viewer_of(request), self._template, values)


def made(values: Values) -> Mapping[str, object]:
    """Return the values of a page."""
    return values() if callable(values) else values


def to_job(number: int) -> Response:
    """Return the redirection to the page of a job."""
    return RedirectResponse(f"/queue/{number}", HTTPStatus.SEE_OTHER)


def render(path: str, viewer: Viewer, template: str, values: Mapping[str, object]) -> bytes:
    """Return the HTML of a page at a path."""
    return templates().get_template(template).render(values, path=path, viewer=viewer).encode()


def viewer_of(request: Request) -> Viewer:
    """Return the user who sent a request."""
    token = getattr(request.state, "token", None)
    if token is None:
        return Viewer("", not request.app.state.settings.needs_token)
    return Viewer(token.name, token.can_write)


@functools.cache
def templates() -> jinja2.Environment:
    """Return the templates of pages, which use partial templates of reports."""
    environment = environment_of((TEMPLATES, REPORT_TEMPLATES))
    environment.filters |= {
        "size": humanize.size,
        "age": _age,
        "problem": _problem,
    }
    environment.globals |= {"static": static.address, "sections": SECTIONS, "link": link}
    return environment


def _problem(message: str) -> Markup:
    """Return an error as HTML; lines with a caret have a fixed width, so that it points at its place."""
    text, _, marked = message.partition("\n")
    if not marked.rstrip().endswith("^"):
        return Markup("<p>{}</p>").format(code(humanize.sentence(message)))
    return Markup("<p>{}</p><pre>{}</pre>").format(code(humanize.sentence(text)), marked)


def _age(moment: datetime | str) -> str:
    """Return the time since a moment as text."""
    return humanize.ago(datetime.fromisoformat(moment) if isinstance(moment, str) else moment)


async def form_of(request: Request) -> dict[str, str]:
    """Return the fields of a form as text, with the line ends of files.

    Raises:
        RunnerError: the body is not a form.
    """
    body = await request.body()
    try:
        pairs = parse_qsl(
            body.decode("ascii"), keep_blank_values=True, max_num_fields=MAX_FIELDS, errors="strict"
        )
    except ValueError as error:
        raise RunnerError(f"body: found no form ({error}).") from error
    return {name: value.replace("\r\n", "\n") for name, value in pairs}


Form = Annotated[dict[str, str], Depends(form_of)]


def message_of(error: RunnerError, request: Request) -> str:
    """Return the message of an error, as in the API."""
    return error_body(error, request.app.state.settings).message
