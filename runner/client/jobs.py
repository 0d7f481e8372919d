"""Jobs on a server, as its clients see them."""

from __future__ import annotations

import functools
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final, Literal

from pydantic import TypeAdapter

from runner.errors import RunnerError
from runner.util.values import Json, JsonView

JobState = Literal["queued", "running", "interrupted", "finished", "failed", "cancelled"]
OVER: Final = ("finished", "failed", "cancelled")
"""The states of a job in which nothing more happens unless a user resumes it."""


@dataclass(frozen=True)
class StateEvent:
    """A job's state changed."""

    state: str
    error: str | None = None
    """Why the job failed."""
    time: str | None = None


@dataclass(frozen=True)
class RunEvent:
    """A run of a job started, for the first time or again."""

    run_id: str
    seed: int
    time: str | None = None


@dataclass(frozen=True)
class LogEvent:
    """A line of a job's log."""

    text: str
    run_id: str | None = None
    """The run that it comes from; None for the job itself."""
    seed: int | None = None
    """The seed of that run."""
    time: str | None = None


@dataclass(frozen=True)
class RunProgress:
    """The progress of a configuration's job: the run that it is at."""

    run_id: str
    seed: int
    run: int = 1
    """The place of the run among those of the job, from 1."""
    runs: int = 1
    episode: int = 0
    episodes: int = 0
    """Training episodes of the run; 0 of an episode that is played on, whose steps are counted."""
    train_steps: int = 0
    eval_steps: int = 0
    bytes: int = 0
    """Size of its recording."""
    last_evaluation: dict[str, object] | None = None
    """Its episode, and the value of each metric by name; None before the first."""

    @property
    def share(self) -> float:
        """Share of the job's work that is done."""
        return (self.run - 1 + self.episode / max(1, self.episodes)) / self.runs

    @property
    def text(self) -> str:
        """The work that is done, as pages write it."""
        run = f", run {self.run} of {self.runs}" if self.runs > 1 else ""
        if not self.train_steps + self.eval_steps:
            return f"preparing{run}"
        if not self.episodes:
            return f"{self.train_steps:,} steps"
        return f"{self.episode:,} of {self.episodes:,} episodes{run}"


@dataclass(frozen=True)
class BestTrial:
    """The best trial of a sweep so far."""

    trial: int
    value: float | None
    """None for a level that was never reached."""
    values: Json
    """The parameters of the trial."""


@dataclass(frozen=True)
class SweepProgress:
    """The progress of a sweep's job, in runs."""

    done: int
    runs: int
    running: int = 0
    pruned: int = 0
    failed: int = 0
    bytes: int = 0
    best: BestTrial | None = None

    @property
    def share(self) -> float:
        """Share of the runs that are done."""
        return self.done / max(1, self.runs)

    @property
    def text(self) -> str:
        """The runs that are done, as pages write it."""
        return f"{self.done:,} of {self.runs:,} runs"


JobProgress = RunProgress | SweepProgress
EventData = StateEvent | RunEvent | LogEvent | JobProgress
_TYPES: Final[Mapping[str, Any]] = {
    "state": StateEvent,
    "run": RunEvent,
    "log": LogEvent,
    "progress": JobProgress,
}
"""The types of events, as they are named in a stream of events and in the server's logs."""


@functools.cache
def _adapter(kind: str) -> TypeAdapter[Any]:
    return TypeAdapter(_TYPES[kind])  # takes milliseconds


@dataclass(frozen=True)
class JobEvent:
    """An event of a job. Only the latest progress counts, so no log has it."""

    data: EventData
    id: str = ""
    """Where to continue from; empty for progress."""

    @property
    def kind(self) -> str:
        """The name of its type."""
        return next(kind for kind, types in _TYPES.items() if isinstance(self.data, types))

    def as_json(self) -> dict[str, object]:
        """Return its data as a JSON object, without what is unknown; `from_json` is the reverse."""
        values = asdict(self.data)
        if self.kind == "progress":
            return values
        return {key: value for key, value in values.items() if value is not None}

    def as_line(self) -> str:
        """Return the event as a line of a job's log, without the line break; `from_line` is the reverse."""
        return json.dumps({"kind": self.kind, "values": self.as_json()})

    @classmethod
    def from_line(cls, line: str | bytes, event_id: str = "") -> JobEvent:
        """Return the event of a line of a job's log.

        Raises:
            RunnerError: it has none.
        """
        try:
            return cls.from_json(**json.loads(line), event_id=event_id)
        except (TypeError, ValueError) as error:
            raise RunnerError("found a line of a job's log that is no event.") from error

    @classmethod
    def from_json(cls, kind: str, values: JsonView, event_id: str = "") -> JobEvent:
        """Return an event from a stream or a log.

        Raises:
            RunnerError: it is none.
        """
        try:
            return cls(_adapter(kind).validate_python(values), event_id)
        except (KeyError, ValueError) as error:
            raise RunnerError(f"found an event {kind[:20]!r} of a job that is not as expected.") from error


@dataclass(frozen=True, kw_only=True)
class JobFacts:
    """A submitted job and its state. Times are in UTC, as ISO 8601; empty if they have not come."""

    number: int
    kind: str
    name: str
    state: JobState = "queued"
    runs: int
    """Number of runs: a configuration's seeds; a sweep's trials, times its seeds."""
    workers: int = 1
    """How many workers of the server it holds while it is running."""
    created: str
    started: str = ""
    ended: str = ""
    error: str = ""
    """Why it failed; empty if it did not."""
    progress: JobProgress | None = None
    """The last progress that its worker reported; clients see it while the job is running."""

    @property
    def is_over(self) -> bool:
        """Whether nothing more happens unless a user resumes it."""
        return self.state in OVER


@dataclass(frozen=True)
class RunOfJob:
    """A run that a job has started."""

    seed: int
    run_id: str


@dataclass(frozen=True, kw_only=True)
class JobStatus(JobFacts):
    """A job on a server."""

    begun: list[RunOfJob]
    """Its started runs; empty for a sweep, whose runs have the tag sweep=NAME."""


@dataclass(frozen=True)
class QueueStatus:
    """The state of a queue."""

    workers: int
    """How many processes may train at once."""
    running: int
    queued: int
    free_bytes: int
    """Free space on the disk of the recordings."""
    waiting_for: str
    """Why no further job is started although there is a worker; empty if one would be."""


@dataclass(frozen=True)
class JobsPage:
    """Some of the jobs, the newest first."""

    jobs: list[JobStatus]
    total: int
    """The number of matching jobs."""
    offset: int
    limit: int
    queue: QueueStatus


def parse_events(lines: Iterable[str]) -> Iterator[JobEvent]:
    """Yield the server-sent events of a stream's lines, apart from an incomplete last one."""
    parts: dict[str, str] = {}
    for line in lines:
        if line:
            key, _, value = line.partition(":")
            parts[key] = value.removeprefix(" ")
            continue
        if "data" in parts:
            yield JobEvent.from_json(parts.get("event", ""), json.loads(parts["data"]), parts.get("id", ""))
        parts = {}
