"""Jobs: submitted, or asked about runs; listed, watched, cancelled, resumed."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from http import HTTPStatus
from typing import Annotated, Final

from anyio.to_thread import run_sync
from fastapi import APIRouter, Depends, Header, HTTPException, Path, Query, Request, Response
from fastapi.sse import EventSourceResponse, ServerSentEvent
from pydantic import Field

from runner.client.jobs import JobEvent, JobsPage, JobState, JobStatus
from runner.config.document import write_yaml
from runner.errors import ConfigError
from runner.runs.run import Run
from runner.service.dependencies import JobsOf, RecordedRun, require_written
from runner.service.errors import JobNotFound, LimitReached, expecting
from runner.service.jobs.checking import (
    DEFAULT_SOURCE,
    BranchQuestion,
    ExplainQuestion,
    check_branch,
    check_explanation,
)
from runner.service.jobs.queue import JobQueue
from runner.service.jobs.store import CheckedJob, JobEstimate, QueuedJob
from runner.service.problems import media_docs

POLL_SECONDS: Final = 0.25
"""Time between two looks for new events."""
RETRY_MILLISECONDS: Final = 1000
"""Time after which a watcher that was cut off reconnects."""
MAX_WATCHERS: Final = 200

router = APIRouter(tags=["jobs"])


Number = Annotated[int, Path(ge=1, lt=2**31, description="The number of a job.")]
Source = Annotated[
    str,
    Field(max_length=200, pattern=r"^[^/\\\x00-\x1f]+$"),
    expecting("the name of a file, without its folder, of 200 characters at most"),
    Query(description="The file's name, for messages; the default name of the job."),
]
Workers = Annotated[
    int | None,
    Query(ge=1, le=1024, description="How many workers a sweep may hold; default: all of the server."),
]
_YAML: Final[dict[str, object]] = {
    "requestBody": {
        "required": True,
        "description": "A configuration or a sweep, as a YAML file has it; a sweep contains its base.",
        "content": {"application/yaml": {"schema": {"type": "string"}}},
    }
}


async def text_of(request: Request) -> str:
    """Return the text in the body of a request, whatever its media type.

    Raises:
        ConfigError: it is not UTF-8.
    """
    content = await request.body()
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise ConfigError(
            f"line {line}: found the byte 0x{content[error.start]:02x}, expected text in UTF-8",
        ) from error


Text = Annotated[str, Depends(text_of)]


@router.post(
    "/jobs",
    status_code=HTTPStatus.CREATED,
    openapi_extra=_YAML,
    summary="Submit a configuration or a sweep.",
)
async def submit(
    jobs: JobsOf,
    text: Text,
    response: Response,
    request: Request,
    source: Source = DEFAULT_SOURCE,
    workers: Workers = None,
) -> JobStatus:
    """Check the text, and queue it; each mistake is reported with its line and key."""
    checked = await jobs.checker.check(text, source)  # may take long, so no thread waits for it
    return created(await run_sync(jobs.add, text, checked, workers), request, response)


@router.post(
    "/jobs/check",
    openapi_extra=_YAML,
    summary="Check a configuration or a sweep.",
)
async def check(jobs: JobsOf, text: Text, source: Source = DEFAULT_SOURCE) -> JobEstimate:
    """Check the text without queueing it."""
    return await jobs.checker.check(text, source)


@router.get("/jobs", summary="List the jobs, the newest first.")
def list_jobs(
    jobs: JobsOf,
    state: Annotated[list[JobState] | None, Query(description="Only those in one of these states.")] = None,
    limit: Annotated[int, Query(ge=0, le=1000)] = 50,
    offset: Annotated[int, Query(ge=0, lt=2**31)] = 0,
) -> JobsPage:
    """List the jobs, and return the state of the queue."""
    matching = [job for job in reversed(jobs.store.jobs()) if not state or job.state in state]
    return JobsPage(
        jobs=[job.status() for job in matching[offset : offset + limit]],
        total=len(matching),
        offset=offset,
        limit=limit,
        queue=jobs.status(),
    )


@router.get(
    "/jobs/{number}",
    summary="One job.",
)
def one(jobs: JobsOf, number: Number) -> JobStatus:
    """Return a job."""
    return jobs.store.job(number).status()


@router.get(
    "/jobs/{number}/submitted",
    response_class=Response,
    responses=media_docs("text/plain"),
    summary="The text of a job, as it was submitted.",
)
def submitted(jobs: JobsOf, number: Number) -> Response:
    """Return the YAML that was submitted."""
    return Response(jobs.store.submitted(number), media_type="text/plain")


@router.post(
    "/jobs/{number}/cancel",
    summary="Cancel a job; what it has recorded is kept.",
)
def cancel(jobs: JobsOf, number: Number) -> JobStatus:
    """Cancel a job; its worker closes its recording."""
    return jobs.cancel(number).status()


@router.post(
    "/jobs/{number}/resume",
    summary="Resume a job that failed or was cancelled.",
)
def resume(
    jobs: JobsOf,
    number: Number,
    accept_changes: Annotated[
        bool, Query(description="Resume runs that were started by other code.")
    ] = False,
) -> JobStatus:
    """Queue a job again: it continues where it stopped, and ends as if it never had."""
    return jobs.resume(number, accept_changes).status()


async def last_event(
    jobs: JobsOf,
    number: Number,
    last_event_id: Annotated[str, Header(description="The id of the last event received.")] = "",
    after: Annotated[int, Query(ge=0, lt=2**53, description="The same, for a first connection.")] = 0,
) -> int:
    """Return the id of the last event that a watcher has.

    Raises:
        HTTPException: 204, as the job is over and it has them all; this stops a browser from reconnecting.
        LimitReached: too many watch.
    """
    last = int(last_event_id) if last_event_id.isdecimal() and len(last_event_id) < 16 else after
    if jobs.store.job(number).is_over and last == jobs.store.log_size(number):
        raise HTTPException(HTTPStatus.NO_CONTENT)
    if jobs.watchers >= MAX_WATCHERS:
        raise LimitReached(f"the maximum of {MAX_WATCHERS} event streams is open; try again.")
    return last


@router.get(
    "/jobs/{number}/events",
    response_class=EventSourceResponse,
    responses={204: {"description": "The job is over, and all its events were sent."}},
    summary="Watch a job: its states, runs, log and progress, as server-sent events.",
)
async def watch(
    request: Request, jobs: JobsOf, number: Number, last: Annotated[int, Depends(last_event)]
) -> AsyncIterator[ServerSentEvent]:
    """Send a job's events until it is over: all of them, or those after `Last-Event-ID` or `after`.

    `state`, `run` and `log` have ids; `progress` has none, because only the latest counts.
    """
    jobs.watchers += 1
    try:
        yield ServerSentEvent(retry=RETRY_MILLISECONDS)
        progress = None
        while not request.app.state.stopping.is_set():
            job = jobs.store.job(number)
            events = list[JobEvent]()
            if last != jobs.store.log_size(number):
                events, last = await run_sync(jobs.store.events, number, last)
            before, progress = progress, job.progress
            if progress is not None and progress is not before:
                events.insert(0, JobEvent(progress))
            for event in events:
                data = json.dumps(event.as_json(), ensure_ascii=False)
                yield ServerSentEvent(raw_data=data, event=event.kind, id=event.id or None)
            if job.is_over and not events:
                return
            await asyncio.sleep(0 if events else POLL_SECONDS)
    except JobNotFound:  # it was forgotten in the meantime
        return
    finally:
        jobs.watchers -= 1


def created(job: QueuedJob, request: Request, response: Response) -> JobStatus:
    """Return the response about a new job, with its address in the header `location`."""
    response.headers["location"] = f"{request.app.url_path_for('list_jobs')}/{job.number}"
    return job.status()


@router.post(
    "/runs/{run}/branch",
    status_code=HTTPStatus.CREATED,
    summary="Branch the training of a run: another action at a step, or other settings from it on.",
)
async def branch(
    run: RecordedRun, jobs: JobsOf, sent: BranchQuestion, request: Request, response: Response
) -> JobStatus:
    """Queue a branch of training, as `dualtaxi branch` records it; of a run that was trained here."""
    job = await queue_branch(run, jobs, sent)
    return created(job, request, response)


@router.post(
    "/explanations",
    status_code=HTTPStatus.CREATED,
    summary="Find which settings make the difference between two runs or configurations.",
)
async def explain(jobs: JobsOf, sent: ExplainQuestion, request: Request, response: Response) -> JobStatus:
    """Queue an explanation, as `dualtaxi explain` computes it."""
    job = await queue_explanation(jobs, sent)
    return created(job, request, response)


async def queue_explanation(jobs: JobQueue, question: ExplainQuestion) -> QueuedJob:
    """Check an explanation, and queue it."""
    what = f"{question.a} and {question.b}"
    checked = await jobs.checker.call(what, check_explanation, question, jobs.recordings)
    return await _queue(jobs, checked, question.workers)


async def queue_branch(run: Run, jobs: JobQueue, question: BranchQuestion) -> QueuedJob:
    """Check a branch of training, and queue it."""
    require_written(run, jobs.recordings, "branch")
    return await _queue(jobs, await jobs.checker.call(f"run {run.run_id}", check_branch, run, question))


async def _queue(jobs: JobQueue, checked: CheckedJob, workers: int | None = None) -> QueuedJob:
    return await run_sync(jobs.add, write_yaml(checked.values), checked, workers)
