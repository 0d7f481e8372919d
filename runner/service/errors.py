"""A request that is refused."""

from __future__ import annotations

from http import HTTPStatus

from runner.errors import RunnerError


class Refused(RunnerError):
    """A request is refused with a status of its own."""

    def __init__(self, status: HTTPStatus, message: str, headers: dict[str, str] | None = None) -> None:
        super().__init__(message)
        self.status, self.headers = status, headers or {}
