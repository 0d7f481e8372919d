"""Jobs on a server, as its clients see them: how they stand, and what happens to them."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from http import HTTPStatus
from typing import TYPE_CHECKING, Any, Final

from runner.client.backoff import FIRST_PAUSE, ServerUnavailable
from runner.errors import RunnerError

if TYPE_CHECKING:
    from runner.client.connection import Connection

OVER: Final = ("finished", "failed", "cancelled")
"""The states of a job in which nothing more happens unless somebody asks for it."""


@dataclass(frozen=True)
class RemoteJob:
    """A job on a server."""

    number: int
    kind: str
    name: str
    state: str
    runs: int
    """How many it makes."""
    error: str
    progress: dict[str, Any] | None
    """How far it is, if it is running and its worker has said so."""
    begun: dict[int, str]
    """Seed to the id of its run; empty for a sweep, whose runs have the tag sweep=NAME."""

    @property
    def is_over(self) -> bool:
        """Whether nothing more happens unless somebody asks for it."""
        return self.state in OVER

    @classmethod
    def of(cls, told: Mapping[str, Any]) -> RemoteJob:
        """Return the job that a server tells of.

        Raises:
            RunnerError: it tells something else.
        """
        known = ("number", "kind", "name", "state", "runs", "error", "progress")
        try:
            begun = {int(run["seed"]): str(run["run_id"]) for run in told["begun"]}
            return cls(**{key: told[key] for key in known}, begun=begun)
        except (KeyError, TypeError, ValueError) as error:
            raise RunnerError("found another answer than a dualtaxi server gives of a job.") from error


@dataclass(frozen=True)
class JobEvent:
    """Something that happened to a job: its kind (`state`, `run`, `log`, `progress`), and more of it."""

    kind: str
    data: dict[str, Any]
    place: str = ""
    """What to come back to; empty for progress."""


def watch(client: Connection, number: int) -> Iterator[JobEvent]:
    """Yield what happens to a job until it is over, whatever the connection does meanwhile.

    Args:
        client: of the server.
        number: which job.

    Raises:
        ServerError: there is no such job, or the server refuses.
        ServerUnavailable: the server did not answer for too long.
    """
    place, patience = "", client.patience()
    while True:
        try:
            with client.stream(f"/jobs/{number}/events", {"Last-Event-ID": place}) as answer:
                patience.moved()
                if answer.status_code == HTTPStatus.NO_CONTENT:
                    return
                for happened in events_in(answer.iter_lines()):
                    place = happened.place or place
                    yield happened
            if RemoteJob.of(client.ask("GET", f"/jobs/{number}").json()).is_over:
                return
            time.sleep(FIRST_PAUSE)
        except ServerUnavailable as error:
            patience.wait(error)


def events_in(lines: Iterable[str]) -> Iterator[JobEvent]:
    """Yield the server-sent events of a stream's lines; one that was cut off is left out."""
    fields: dict[str, str] = {}
    for line in lines:
        if line:
            key, _, value = line.partition(":")
            fields[key] = value.removeprefix(" ")
            continue
        if "data" in fields:
            yield JobEvent(fields.get("event", ""), json.loads(fields["data"]), fields.get("id", ""))
        fields = {}
