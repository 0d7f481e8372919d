"""What is wrong with a request, in words that say what to do.

The body of a response about an error:

    {"error": {"message": "...", "problems": [{"path": "query.limit", "line": null, "message": "..."}]}}
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from http import HTTPStatus
from typing import Final, TypeVar

from fastapi import Request
from fastapi.dependencies.utils import get_flat_params
from fastapi.exceptions import RequestValidationError
from fastapi.params import Header
from fastapi.params import Path as InPath
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from runner.config.schema import found
from runner.errors import (
    ConfigError,
    ConfigProblem,
    Diverged,
    EnvironmentNotUsable,
    MissingExtra,
    NotInRecording,
    RecordingError,
    RunnerError,
    RunNotFound,
    StorageError,
    full_message,
    nearest,
    shortened,
)
from runner.service.errors import EXPECTED, RequestError
from runner.service.settings import ServiceSettings
from runner.util.processes import CallFailed

Question = TypeVar("Question", bound=BaseModel)

_STATUS: Final[dict[type[RunnerError], HTTPStatus]] = {
    CallFailed: HTTPStatus.SERVICE_UNAVAILABLE,
    ConfigError: HTTPStatus.UNPROCESSABLE_ENTITY,
    Diverged: HTTPStatus.CONFLICT,
    EnvironmentNotUsable: HTTPStatus.UNPROCESSABLE_ENTITY,
    MissingExtra: HTTPStatus.NOT_IMPLEMENTED,
    NotInRecording: HTTPStatus.NOT_FOUND,
    RecordingError: HTTPStatus.CONFLICT,
    RunNotFound: HTTPStatus.NOT_FOUND,
    StorageError: HTTPStatus.INSUFFICIENT_STORAGE,
}
_MAX_UNKNOWN: Final = 10
"""Unknown parameters that an error names."""
_EXPECTED: Final = {
    **dict.fromkeys(("int_parsing", "int_parsing_size", "int_type", "int_from_float"), "a whole number"),
    **dict.fromkeys(("float_parsing", "float_type", "finite_number"), "a number"),
    **dict.fromkeys(("bool_parsing", "bool_type"), "true or false"),
    "dict_type": "a mapping",
    "enum": "{expected}",
    EXPECTED: "{expected}",
    "greater_than": "more than {gt}",
    "greater_than_equal": "{ge} or more",
    "json_invalid": "JSON ({error})",
    "less_than": "less than {lt:,}",
    "less_than_equal": "{le:,} or less",
    "list_type": "a list",
    "literal_error": "{expected}",
    "model_attributes_type": "a mapping",
    "string_too_long": "{max_length:,} characters at most",
    "string_too_short": "{min_length} characters at least",
    "string_type": "text",
    "too_long": "{max_length:,} values at most",
    "too_short": "{min_length} values at least",
}
"""What was expected, by the type of an error of Pydantic."""


class HttpProblem(BaseModel):
    """One thing that is wrong."""

    path: str | None = None
    """The key, parameter or field that has it."""
    line: int | None = None
    """The line of a configuration."""
    message: str


class ErrorBody(BaseModel):
    """What is wrong, and what to do."""

    message: str
    problems: list[HttpProblem] = []


class ErrorResponse(BaseModel):
    """The body of every error response."""

    error: ErrorBody


ERROR_DOCS: Final[dict[int | str, dict[str, object]]] = {
    int(status): {"model": ErrorResponse, "description": status.phrase}
    for status in (
        HTTPStatus.BAD_REQUEST,
        HTTPStatus.UNAUTHORIZED,
        HTTPStatus.FORBIDDEN,
        HTTPStatus.NOT_FOUND,
        HTTPStatus.REQUEST_TIMEOUT,
        HTTPStatus.CONFLICT,
        HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
        HTTPStatus.MISDIRECTED_REQUEST,
        HTTPStatus.UNPROCESSABLE_ENTITY,
        HTTPStatus.TOO_MANY_REQUESTS,
        HTTPStatus.NOT_IMPLEMENTED,
        HTTPStatus.SERVICE_UNAVAILABLE,
        HTTPStatus.INSUFFICIENT_STORAGE,
    )
}
"""The OpenAPI documentation of the errors of every route of the API."""


def media_docs(*media: str) -> dict[int | str, dict[str, object]]:
    """Return the OpenAPI documentation of the media types of a route's response."""
    return {200: {"content": {kind: {} for kind in media}}}


def requests_page(request: Request) -> bool:
    """Return whether a browser requests a page, so that errors are pages, too."""
    path = request.scope["path"]  # a URL would be made with the Host header, which may be the problem
    return "text/html" in request.headers.get("accept", "") and not path.startswith("/api/")


def status_of(error: RunnerError) -> HTTPStatus:
    """Return the status of the response to an error."""
    if isinstance(error, RequestError):
        return error.status
    kinds = (kind for kind in type(error).__mro__ if kind in _STATUS)
    return next((_STATUS[kind] for kind in kinds), HTTPStatus.BAD_REQUEST)


def error_body(error: RunnerError, settings: ServiceSettings) -> ErrorBody:
    """Return an error's message, and the problems of a configuration with their lines and keys."""
    message = settings.without_folders(full_message(error))
    if not isinstance(error, ConfigError):
        return ErrorBody(message=message)
    problems = [
        HttpProblem(
            path=detail.path or None,
            line=detail.line or None,
            message=settings.without_folders(detail.message),
        )
        for detail in error.problems
    ]
    return ErrorBody(message=message, problems=problems)


def filled(kind: type[Question], fields: Mapping[str, object]) -> Question:
    """Return what the fields of a form ask that are not empty.

    Raises:
        ConfigError: one is wrong, or is missing.
    """
    try:
        return kind.model_validate({name: value for name, value in fields.items() if value})
    except ValidationError as error:
        raise as_config_error(error) from error


def as_config_error(error: ValidationError | RequestValidationError) -> ConfigError:
    """Return the error with what is wrong in a request, each with the parameter or field."""
    return _wrong((".".join(map(str, detail["loc"])), _in_words(detail)) for detail in error.errors())


def _wrong(messages: Iterable[tuple[str, str]]) -> ConfigError:
    """Return the error of parameters or fields, each with a message."""
    problems = tuple(ConfigProblem(path, 0, 0, message) for path, message in messages)
    return ConfigError("; ".join(f"{problem.path}: {problem.message}" for problem in problems), problems)


async def known_query(request: Request) -> None:
    """Refuse a query with parameters that the route does not have: a mistyped one would be ignored.

    Raises:
        ConfigError: there are some; the message has the nearest name of each, or all names.
    """
    fields = get_flat_params(request.scope["route"].dependant) if request.query_params else []
    known = [field.alias for field in fields if not isinstance(field.field_info, InPath | Header)]
    hint = f" Known: {', '.join(known) or 'none'}"
    if unknown := [name for name in request.query_params if name not in known][:_MAX_UNKNOWN]:
        names = [shortened(name, 60) for name in unknown]
        raise _wrong((f"query.{name}", f"unknown parameter.{nearest(name, known) or hint}") for name in names)


def _in_words(detail: ErrorDetails) -> str:
    """Return what was found in a parameter or a field, and what was expected."""
    if detail["type"] == "missing":
        return "missing"
    if detail["type"] == "extra_forbidden":
        return "unknown key"
    known = _EXPECTED.get(detail["type"])
    expected = detail["msg"] if known is None else known.format_map(detail.get("ctx", {}))
    if detail["type"] == "json_invalid":
        return f"expected {expected}"
    value = detail["input"]
    given = "a body without the type application/json" if isinstance(value, bytes) else found(value)
    return f"found {given}, expected {expected}"
