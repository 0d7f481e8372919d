"""The errors of the service, each with the status of its response."""

from __future__ import annotations

from http import HTTPStatus
from typing import Final

from pydantic import ValidationError, ValidatorFunctionWrapHandler, WrapValidator
from pydantic_core import PydanticCustomError

from runner.errors import RunnerError

EXPECTED: Final = "expected"
"""The type of the errors of `expecting`."""


def expecting(text: str) -> WrapValidator:
    """Return the annotation of a value: if it is wrong, the message says only that this was expected.

    Without it, the message has what Pydantic expects: of a union every type, of a text its pattern.
    """

    def check(value: object, handler: ValidatorFunctionWrapHandler) -> object:
        try:
            return handler(value)
        except ValidationError:
            raise PydanticCustomError(EXPECTED, "{expected}", {"expected": text}) from None

    return WrapValidator(check)


class RequestError(RunnerError):
    """A request cannot be answered; the response has this status and these headers."""

    status = HTTPStatus.BAD_REQUEST
    headers: dict[str, str] = {}  # noqa: RUF012 - replaced, never changed


class Refused(RequestError):
    """A request is refused with a status that is given for it alone."""

    def __init__(self, status: HTTPStatus, message: str, headers: dict[str, str] | None = None) -> None:
        super().__init__(message)
        self.status = status
        self.headers = headers or {}


class Unauthorized(RequestError):
    """A token or session is missing or wrong."""

    status = HTTPStatus.UNAUTHORIZED
    headers = {"www-authenticate": "Bearer"}  # noqa: RUF012


class Busy(RequestError):
    """Too many calls wait for a child process."""

    status = HTTPStatus.SERVICE_UNAVAILABLE
    headers = {"retry-after": "5"}  # noqa: RUF012

    def __init__(self, message: str = "the service is busy; try again.") -> None:
        super().__init__(message)


class JobNotFound(RequestError):
    """No job has this number."""

    status = HTTPStatus.NOT_FOUND


class UploadTooLarge(RequestError):
    """More bytes than the server accepts, or than were announced."""

    status = HTTPStatus.REQUEST_ENTITY_TOO_LARGE


class StateConflict(RequestError):
    """A job or an upload is in another state than the request assumes; look at it, and ask again."""

    status = HTTPStatus.CONFLICT


class LimitReached(RequestError):
    """The maximum number of unfinished jobs, open uploads or event streams is reached; try again later."""

    status = HTTPStatus.TOO_MANY_REQUESTS
