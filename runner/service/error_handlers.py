"""The responses to errors: JSON in one form, or a page where a browser requested one."""

from __future__ import annotations

import errno
from collections.abc import Mapping
from http import HTTPStatus
from types import MappingProxyType
from typing import Final

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from runner.errors import RunnerError
from runner.service.errors import RequestError
from runner.service.logs import LOG
from runner.service.pages.rendering import Page
from runner.service.problems import ErrorBody, as_config_error, error_body, requests_page, status_of

_NONE: Final[Mapping[str, str]] = MappingProxyType({})


def add_error_handlers(app: FastAPI) -> None:
    """Make every error of the application a response in the one form."""
    app.add_exception_handler(RunnerError, _runner_error)
    app.add_exception_handler(HTTPException, _http_error)
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_exception_handler(OSError, _system_error)
    app.add_exception_handler(ClientDisconnect, _disconnected)
    app.add_exception_handler(Exception, _unexpected)


def error_response(request: Request, error: RunnerError) -> Response:
    """Return the response to a request that raised one of the project's errors."""
    headers = error.headers if isinstance(error, RequestError) else _NONE
    return _response(request, status_of(error), error_body(error, request.app.state.settings), headers)


def _response(
    request: Request, status: HTTPStatus, body: ErrorBody, headers: Mapping[str, str] = _NONE
) -> Response:
    if not requests_page(request):
        return JSONResponse({"error": body.model_dump()}, status, headers)
    page = Page("problem.html", {"title": status.phrase.capitalize(), "message": body.message}, status)
    page.headers.update(headers)
    return page


async def _runner_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, RunnerError)
    return error_response(request, error)


async def _http_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    status = HTTPStatus(error.status_code)
    if status == HTTPStatus.NO_CONTENT:
        return Response(status_code=status)
    messages = {
        HTTPStatus.NOT_FOUND: f"there is nothing at {request.url.path}.",
        HTTPStatus.METHOD_NOT_ALLOWED: f"{request.method} is not supported at {request.url.path}.",
    }
    message = messages.get(status, str(error.detail))
    return _response(request, status, ErrorBody(message=message), error.headers or _NONE)


async def _invalid(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    return error_response(request, as_config_error(error))


async def _disconnected(request: Request, error: Exception) -> Response:  # noqa: ARG001
    message = "the client closed the connection."
    return _response(request, HTTPStatus.BAD_REQUEST, ErrorBody(message=message))


async def _system_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, OSError)
    if error.errno in (errno.ENOSPC, getattr(errno, "EDQUOT", None)):
        message = f"the disk is full ({error.strerror}); free some of it: `dualtaxi du` lists what uses it."
        return _response(request, HTTPStatus.INSUFFICIENT_STORAGE, ErrorBody(message=message))
    return await _unexpected(request, error)


async def _unexpected(request: Request, error: Exception) -> Response:
    LOG.error("error", exc_info=error, extra={"path": request.url.path, "method": request.method})
    message = "something unexpected went wrong; see the service's log."
    return _response(request, HTTPStatus.INTERNAL_SERVER_ERROR, ErrorBody(message=message))
