"""The queue of jobs, a job, and the uploads that are not yet runs."""

from __future__ import annotations

from datetime import datetime
from http import HTTPStatus
from typing import Annotated, Final

from fastapi import APIRouter, Query, Response
from fastapi.responses import RedirectResponse

from runner.analysis.sections import Paging
from runner.client.jobs import JobStatus
from runner.debugging.explanation_files import explanations_in
from runner.service.api.jobs import Number
from runner.service.api.uploads import list_uploads
from runner.service.dependencies import JobsOf, OwnerOf, UploadsOf
from runner.service.jobs.queue import JobQueue
from runner.service.pages.frame import StatusName
from runner.service.pages.rendering import Page, to_job

router = APIRouter(prefix="/queue", include_in_schema=False)

ROWS: Final = 50
MAX_LINES: Final = 1000
"""Lines of a job's log that its page shows."""
After = Annotated[int, Query(ge=0, lt=2**53)]
PageNumber = Annotated[int, Query(alias="page", ge=1, lt=10**6)]


@router.get("")
def queue(jobs: JobsOf, uploads: UploadsOf, owner: OwnerOf, number: PageNumber = 1) -> Response:
    """Show the jobs, the newest first, and the uploads that are not yet runs."""
    pending = [upload for upload in list_uploads(uploads, owner).uploads if upload.state != "stored"]
    return Page("queue.html", {**_rows(jobs, number), "uploads": pending[:ROWS]})


@router.get("/status")
def queue_status(jobs: JobsOf, number: PageNumber = 1) -> Response:
    """Return the jobs as a part of their page; 204 if all are over."""
    rows = _rows(jobs, number)
    no_change = Response(status_code=HTTPStatus.NO_CONTENT)
    return Page("queue_rows.html", rows) if rows["is_active"] else no_change


@router.get("/{number}")
def job(jobs: JobsOf, number: Number) -> Response:
    """Show a job: its progress, its log, its runs."""
    events = jobs.store.last_events(number, MAX_LINES)
    status = jobs.store.job(number).status()  # read after its log: the page receives later events
    is_answered = status.kind == "explain" and status.is_over
    answers = explanations_in(jobs.recordings) if is_answered else []
    values = {
        "job": status,
        "log": events,
        "submitted": jobs.store.submitted(number),
        "seconds": _seconds(status),
        "explanations": [name for name in answers if name.startswith(f"{status.name}/")],
    }
    return Page("job.html", values)


@router.get("/{number}/status")
def job_status(jobs: JobsOf, number: Number, state: StatusName) -> Response:
    """Return the progress and the runs of a job as a part of its page; 204 once it has another state."""
    status = jobs.store.job(number).status()
    if status.state != state:
        return Response(status_code=HTTPStatus.NO_CONTENT)
    return Page("job_status.html", {"job": status})


@router.get("/{number}/log")
def job_log(jobs: JobsOf, number: Number, after: After) -> Response:
    """Return the lines of a job's log after an event as a part of its page."""
    return Page("job_log.html", {"log": jobs.store.events(number, after)[0]})


@router.post("/{number}/cancel")
def cancel(jobs: JobsOf, number: Number, page: PageNumber | None = None) -> Response:
    """Cancel a job; a page of the queue is shown again."""
    jobs.cancel(number)
    return to_job(number) if page is None else RedirectResponse(f"/queue?page={page}", HTTPStatus.SEE_OTHER)


@router.post("/{number}/resume")
def resume(jobs: JobsOf, number: Number) -> Response:
    """Resume a job."""
    jobs.resume(number)
    return to_job(number)


def _rows(jobs: JobQueue, number: int) -> dict[str, object]:
    """Return a page of the table of jobs."""
    newest_first = list(reversed(jobs.store.jobs()))
    return {
        "jobs": [job.status() for job in newest_first[(number - 1) * ROWS : number * ROWS]],
        "status": jobs.status(),
        "is_active": any(job.state in ("queued", "running") for job in newest_first),
        "paging": Paging(number, len(newest_first), ROWS, "/queue"),
    }


def _seconds(job: JobStatus) -> float | None:
    """Return the duration of a job from its first start; None if it is not over, or never started."""
    if not (job.is_over and job.started and job.ended):
        return None
    return (datetime.fromisoformat(job.ended) - datetime.fromisoformat(job.started)).total_seconds()
