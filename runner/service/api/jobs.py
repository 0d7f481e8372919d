"""JobPool: submitted, listed, watched, cancelled, resumed."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator, Mapping
from http import HTTPStatus
from typing import Annotated, Any, Final

from anyio.to_thread import run_sync
from fastapi import APIRouter, Depends, Header, Path, Query, Request, Response
from fastapi.responses import StreamingResponse
from pydantic import BaseModel, Field

from runner.service.dependencies import JobsOf
from runner.service.errors import JobNotFound, Refused
from runner.service.jobs.checking import DEFAULT_SOURCE
from runner.service.jobs.pool import JobPool, QueueStatus
from runner.service.jobs.store import Job, Kind, State
from runner.service.problems import error_docs, media_docs

LOOK_SECONDS: Final = 0.25
"""Between two looks at what is new; a look costs next to nothing."""
QUIET_SECONDS: Final = 15.0
"""After which a watcher is told that the connection lives."""
RETRY_MILLISECONDS: Final = 1000
"""After which a watcher that was cut off comes again."""
MOST_WATCHERS: Final = 200

router = APIRouter(tags=["jobs"])


class RunOfJob(BaseModel):
    """A run that a job has begun."""

    seed: int
    run_id: str


class JobResponse(BaseModel):
    """A job, and how far it is."""

    number: int
    kind: Kind
    name: str
    state: State
    runs: int = Field(description="How many it makes.")
    created: str
    started: str
    ended: str
    error: str
    progress: dict[str, Any] | None = Field(description="As its worker last said, while it is running.")
    begun: list[RunOfJob] = Field(description="A sweep's are those with the tag sweep=NAME.")


class QueueResponse(BaseModel):
    """How the queue stands."""

    workers: int = Field(description="How many processes may learn at once.")
    running: int
    queued: int
    free_bytes: int = Field(description="Of the disk of the recordings.")
    waiting_for: str = Field(description="Why no further job is begun, but for want of workers.")


class JobsPage(BaseModel):
    """Some of the jobs, the newest first."""

    jobs: list[JobResponse]
    total: int = Field(description="How many fit.")
    offset: int
    limit: int
    queue: QueueResponse


class CheckResponse(BaseModel):
    """What a text means that was checked, but not submitted."""

    kind: Kind
    name: str
    runs: int
    bytes: int = Field(description="About what its recordings will take; 0 if nobody knows.")


Number = Annotated[int, Path(ge=1, lt=2**31, description="The number of a job.")]
Source = Annotated[
    str,
    Query(
        max_length=200,
        pattern=r"^[^/\\\x00-\x1f]+$",
        description="The file's name, for messages; it names what has no name of its own.",
    ),
]
_YAML: Final[dict[str, Any]] = {
    "requestBody": {
        "required": True,
        "description": "A configuration or a sweep, as a YAML file has it; a sweep's base is written out.",
        "content": {"application/yaml": {"schema": {"type": "string"}}},
    }
}


async def text_of(request: Request) -> str:
    """Return the text that a request brings, whatever it calls it.

    Raises:
        Refused: it is not UTF-8.
    """
    content = await request.body()
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise Refused(
            HTTPStatus.UNPROCESSABLE_ENTITY,
            f"line {line}: found the byte 0x{content[error.start]:02x}, expected text in UTF-8",
        ) from error


Text = Annotated[str, Depends(text_of)]


@router.post(
    "/jobs",
    status_code=HTTPStatus.CREATED,
    response_model=JobResponse,
    responses=error_docs(HTTPStatus.CONFLICT),
    openapi_extra=_YAML,
    summary="Submit a configuration or a sweep.",
)
async def submit(
    jobs: JobsOf, text: Text, response: Response, request: Request, source: Source = DEFAULT_SOURCE
) -> JobResponse:
    """Check the text, and queue it; a mistake is told with its line and key."""
    checked = await jobs.checker.check(text, source)  # may take long, so no thread of the server waits for it

    def add() -> JobResponse:
        return told(jobs.add(text, checked), jobs)

    answer = await run_sync(add)
    response.headers["location"] = f"{request.url.path}/{answer.number}"
    return answer


@router.post(
    "/jobs/check",
    response_model=CheckResponse,
    openapi_extra=_YAML,
    summary="Check a configuration or a sweep.",
)
async def check(jobs: JobsOf, text: Text, source: Source = DEFAULT_SOURCE) -> CheckResponse:
    """Check the text as submitting it does, without queueing it."""
    found = await jobs.checker.check(text, source)
    return CheckResponse(kind=found.kind, name=found.name, runs=found.runs, bytes=found.bytes)


@router.get("/jobs", response_model=JobsPage, summary="List the jobs, the newest first.")
def list_jobs(
    jobs: JobsOf,
    state: Annotated[list[State] | None, Query(description="Only those in one of these states.")] = None,
    limit: Annotated[int, Query(ge=0, le=1000)] = 50,
    offset: Annotated[int, Query(ge=0, lt=2**31)] = 0,
) -> JobsPage:
    """List the jobs of the queue, and tell how it stands."""
    found = [job for job in reversed(jobs.store.jobs()) if not state or job.state in state]
    return JobsPage(
        jobs=[told(job, jobs) for job in found[offset : offset + limit]],
        total=len(found),
        offset=offset,
        limit=limit,
        queue=queue_response(jobs.status()),
    )


@router.get(
    "/jobs/{number}",
    response_model=JobResponse,
    responses=error_docs(HTTPStatus.NOT_FOUND),
    summary="One job.",
)
def one(jobs: JobsOf, number: Number) -> JobResponse:
    """Tell of a job."""
    return told(jobs.store.job(number), jobs)


@router.get(
    "/jobs/{number}/submitted",
    response_class=Response,
    responses=media_docs("text/plain") | error_docs(HTTPStatus.NOT_FOUND),
    summary="The text of a job, as it was submitted.",
)
def submitted(jobs: JobsOf, number: Number) -> Response:
    """Return the YAML that was submitted."""
    return Response(jobs.store.submitted(number), media_type="text/plain")


@router.post(
    "/jobs/{number}/cancel",
    response_model=JobResponse,
    responses=error_docs(HTTPStatus.NOT_FOUND, HTTPStatus.CONFLICT),
    summary="Cancel a job; what it has recorded is kept.",
)
def cancel(jobs: JobsOf, number: Number) -> JobResponse:
    """Have a job not be done, or its worker close its recording."""
    return told(jobs.cancel(number), jobs)


@router.post(
    "/jobs/{number}/resume",
    response_model=JobResponse,
    responses=error_docs(HTTPStatus.NOT_FOUND, HTTPStatus.CONFLICT),
    summary="Go on with a job that failed or was cancelled.",
)
def resume(
    jobs: JobsOf,
    number: Number,
    accept_changes: Annotated[bool, Query(description="Go on with runs that other code began.")] = False,
) -> JobResponse:
    """Queue a job again: it goes on where it was, and ends as if it had never stopped."""
    return told(jobs.resume(number, accept_changes), jobs)


@router.get(
    "/jobs/{number}/events",
    response_class=StreamingResponse,
    responses={
        **error_docs(HTTPStatus.NOT_FOUND),
        200: {"content": {"text/event-stream": {"schema": {"type": "string"}}}},
        204: {"description": "The job is over, and everything was told."},
    },
    summary="Watch a job: its states, runs, log and progress, as server-sent events.",
)
async def watch(
    request: Request,
    jobs: JobsOf,
    number: Number,
    last_event_id: Annotated[str, Header(description="The id of the last event that was seen.")] = "",
    after: Annotated[int, Query(ge=0, lt=2**53, description="The same, for a first connection.")] = 0,
) -> Response:
    """Send a job's events from the first on, or behind `Last-Event-ID` or `after`, until it is over.

    `state`, `run` and `log` have ids; `progress` has none, as only the latest counts.
    """
    place = int(last_event_id) if last_event_id.isdecimal() and len(last_event_id) < 16 else after
    if jobs.store.job(number).is_over and place and not jobs.store.events(number, place)[0]:
        return Response(status_code=HTTPStatus.NO_CONTENT)  # which ends a browser's coming again
    if jobs.watchers >= MOST_WATCHERS:
        raise Refused(
            HTTPStatus.TOO_MANY_REQUESTS, f"{MOST_WATCHERS} watch jobs already; expected fewer: try again."
        )
    stopping: asyncio.Event = request.app.state.stopping
    headers = {"cache-control": "no-store", "x-accel-buffering": "no"}
    return StreamingResponse(
        _events(jobs, number, place, stopping), media_type="text/event-stream", headers=headers
    )


async def _events(jobs: JobPool, number: int, place: int, stopping: asyncio.Event) -> AsyncIterator[str]:
    jobs.watchers += 1
    try:
        yield f"retry: {RETRY_MILLISECONDS}\n\n"
        progress, spoken = None, time.monotonic()
        while not stopping.is_set():
            job = jobs.store.job(number)  # before its events, so that none of them is missed
            before, progress = progress, jobs.progress(number)
            found, place = await run_sync(jobs.store.events, number, place)
            has_moved = progress is not None and progress is not before
            if progress is not None and has_moved:
                yield _event("progress", progress)
            for event in found:
                yield _event(event.kind, event.data, event.id)
            if not found and job.is_over:
                return
            if not (found or has_moved):
                if time.monotonic() - spoken < QUIET_SECONDS:
                    await asyncio.sleep(LOOK_SECONDS)
                    continue
                yield ": still here\n\n"
            spoken = time.monotonic()
            await asyncio.sleep(0 if found else LOOK_SECONDS)
    except JobNotFound:  # it was forgotten meanwhile
        return
    finally:
        jobs.watchers -= 1


def _event(kind: str, data: Mapping[str, Any], place: int | None = None) -> str:
    """Return an event as it is sent."""
    head = "" if place is None else f"id: {place}\n"
    return f"{head}event: {kind}\ndata: {json.dumps(data, ensure_ascii=False)}\n\n"


def told(job: Job, jobs: JobPool) -> JobResponse:
    """Return what is told of a job."""
    begun = jobs.store.run_ids(job.number)
    return JobResponse(
        number=job.number,
        kind=job.kind,
        name=job.name,
        state=job.state,
        runs=job.runs,
        created=job.created,
        started=job.started,
        ended=job.ended,
        error=job.error,
        progress=jobs.progress(job.number) if job.state == "running" else None,
        begun=[RunOfJob(seed=seed, run_id=run_id) for seed, run_id in begun.items()],
    )


def queue_response(standing: QueueStatus) -> QueueResponse:
    """Return what is told of the queue."""
    return QueueResponse(
        workers=standing.workers,
        running=standing.running,
        queued=standing.queued,
        free_bytes=standing.free_bytes,
        waiting_for=standing.waiting_for,
    )
