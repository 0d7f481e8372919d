"""Errors as pages, for whoever asked for a page."""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request, Response

from runner.errors import RunnerError
from runner.service import problems
from runner.service.pages.rendering import page
from runner.service.problems import error_body

Handler = Callable[[Request, Exception], Awaitable[Response]]


def add_error_handlers(app: FastAPI) -> None:
    """Have errors outside of the API answered by a page that says the same."""
    for kind, handler in list(app.exception_handlers.items()):
        app.add_exception_handler(kind, _as_page(handler))


def message_of(error: RunnerError, request: Request) -> str:
    """Return what a page says of an error: what the API would."""
    return error_body(error, request.app.state.settings).message


def refused(request: Request, error: RunnerError) -> Response:
    """Return the answer to a request that is refused before its route is looked for."""
    return _in_form(request, problems.refused(request, error))


def _as_page(handler: Any) -> Handler:
    async def answer(request: Request, error: Exception) -> Response:
        return _in_form(request, await handler(request, error))

    return answer


def _in_form(request: Request, response: Response) -> Response:
    """Return an answer that is an error as a page, if the request is a browser's for a page."""
    if "text/html" not in request.headers.get("accept", "") or request.url.path.startswith("/api/"):
        return response
    status = HTTPStatus(response.status_code)
    message = json.loads(bytes(response.body))["error"]["message"]
    found = page(request, "problem.html", status, title=status.phrase.capitalize(), message=message)
    found.headers.update(
        {key: value for key, value in response.headers.items() if not key.startswith("content-")}
    )
    return found
