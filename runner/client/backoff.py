"""A server that refuses, or is away; and how long one waits for it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

from runner.errors import RunnerError

FIRST_PAUSE: Final = 0.2
LONGEST_PAUSE: Final = 5.0
TOLD_PAUSE: Final = 1.0
"""What is waited for is told before a pause as long as this."""


_MAY_PASS: Final = (408, 425, 429)
"""Refusals that say nothing against the request: too slow, too early, too many."""


class ServerError(RunnerError):
    """A server refuses what was asked of it; its own words stand in the message.

    Args:
        message: what is wrong.
        status: of its answer; 0 if there was none.
        retry_seconds: after which it said to try again; 0 if it did not say.
    """

    exit_code = 1

    def __init__(self, message: str, status: int = 0, retry_seconds: float = 0.0) -> None:
        super().__init__(message)
        if 400 <= status < 500 and status not in _MAY_PASS:
            self.exit_code = RunnerError.exit_code  # the request was wrong, not the server
        self.status, self.retry_seconds = status, retry_seconds


class ServerUnavailable(ServerError):
    """A server does not answer, or cannot do what was asked at present."""


class Backoff:
    """Waits ever longer while a server is away, as long as the server says, and has an end.

    Args:
        seconds: how long it may be away.
        tell: told what is waited for.
    """

    def __init__(self, seconds: float, tell: Callable[[str], object] = lambda _: None) -> None:
        self._seconds, self._tell = seconds, tell
        self.moved()

    def moved(self) -> None:
        """Say that something moved: the server is there."""
        self._end: float | None = None
        self._pause, self._told = FIRST_PAUSE, ""

    def wait(self, error: ServerError) -> None:
        """Wait a while after an error; raise it when there was enough of that."""
        now = time.monotonic()
        self._end = now + self._seconds if self._end is None else self._end
        pause = max(self._pause, error.retry_seconds)
        if now + pause > self._end:
            raise error
        if pause >= TOLD_PAUSE and str(error) != self._told:
            self._told = str(error)
            self._tell(f"{error} Trying again, for {self._end - now:.0f} s at most.")
        time.sleep(pause)
        self._pause = min(2 * self._pause, LONGEST_PAUSE)
