"""The queue of jobs, a job, and the uploads that are not yet runs."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from http import HTTPStatus
from typing import Annotated, ClassVar, Final

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import RedirectResponse

from runner.client.jobs import JobEvent, SweepProgress
from runner.client.uploads import UploadStatus
from runner.debugging.explanation_files import explanations_in
from runner.export.reports.rendering import View
from runner.service.addresses import Paging
from runner.service.api.jobs import JobResponse, Number, job_response
from runner.service.api.uploads import list_uploads
from runner.service.dependencies import JobsOf, OwnerOf, UploadsOf
from runner.service.jobs.queue import JobQueue, QueueStatus
from runner.service.jobs.store import Job
from runner.service.pages.rendering import page

router = APIRouter(prefix="/queue", include_in_schema=False)

ROWS: Final = 50
MAX_LINES: Final = 1000
"""Lines of a job's log that its page shows."""
PageNumber = Annotated[int, Query(alias="page", ge=1, lt=10**6)]


@dataclass(frozen=True)
class ShownJob:
    """A job with its progress."""

    facts: JobResponse
    share: float | None
    """Share of the work that is done; None if it is unknown."""
    progress: str
    """The same as text, as `job.js` writes it."""


@dataclass(frozen=True)
class _QueueRowsView(View):
    TEMPLATE: ClassVar = "queue_rows.html"
    jobs: list[ShownJob]
    status: QueueStatus
    is_active: bool
    """Whether a job is running or queued."""
    paging: Paging


@dataclass(frozen=True)
class _QueueView(_QueueRowsView):
    TEMPLATE: ClassVar = "queue.html"
    uploads: list[UploadStatus]


@dataclass(frozen=True)
class _JobView(View):
    TEMPLATE: ClassVar = "job.html"
    job: ShownJob
    log: list[JobEvent]
    place: int
    """Number of the first event after the log."""
    submitted: str
    is_over: bool
    seconds: float | None
    explanations: list[str]
    """Names of the explanations that it has computed."""


@router.get("")
def queue(
    request: Request, jobs: JobsOf, uploads: UploadsOf, owner: OwnerOf, number: PageNumber = 1
) -> Response:
    """Show the jobs, the newest first, and the uploads that are not yet runs."""
    pending = [upload for upload in list_uploads(uploads, owner).uploads if upload.state != "stored"]
    return page(request, _QueueView(*_rows(jobs, number), pending[:ROWS]))


@router.get("/status")
def queue_status(request: Request, jobs: JobsOf, number: PageNumber = 1) -> Response:
    """Return the jobs as a part of their page; 204 if all are over."""
    view = _QueueRowsView(*_rows(jobs, number))
    return page(request, view) if view.is_active else Response(status_code=HTTPStatus.NO_CONTENT)


@router.get("/{number}")
def job(request: Request, jobs: JobsOf, number: Number) -> Response:
    """Show a job: its progress, its log, its runs."""
    events, place = jobs.store.last_events(number, MAX_LINES)
    own_job = jobs.store.job(number)  # read after its log: the script of the page receives later events
    view = _JobView(
        job=shown_job(own_job, jobs),
        log=events,
        place=place,
        submitted=jobs.store.submitted(number),
        is_over=own_job.is_over,
        seconds=_seconds(own_job),
        explanations=[
            name
            for name in (
                explanations_in(jobs.recordings) if own_job.kind == "explain" and own_job.is_over else ()
            )
            if name.startswith(f"{own_job.name}/")
        ],
    )
    return page(request, view)


@router.post("/{number}/cancel")
def cancel(jobs: JobsOf, number: Number) -> Response:
    """Cancel a job."""
    jobs.cancel(number)
    return RedirectResponse(f"/queue/{number}", HTTPStatus.SEE_OTHER)


@router.post("/{number}/resume")
def resume(jobs: JobsOf, number: Number) -> Response:
    """Resume a job."""
    jobs.resume(number)
    return RedirectResponse(f"/queue/{number}", HTTPStatus.SEE_OTHER)


def shown_job(job: Job, jobs: JobQueue) -> ShownJob:
    """Return a job with its progress."""
    facts = job_response(job, jobs)
    now = facts.progress
    if not now or job.state != "running":
        return ShownJob(facts, None, "")
    if isinstance(now, SweepProgress):
        return ShownJob(facts, now.done / max(1, now.runs), f"{now.done:,} of {now.runs:,} runs")
    share = (now.run - 1 + now.episode / max(1, now.episodes)) / now.runs
    run = f", run {now.run} of {now.runs}" if now.runs > 1 else ""
    return ShownJob(facts, share, f"{now.episode:,} of {now.episodes:,} episodes{run}")


def _rows(jobs: JobQueue, number: int) -> tuple[list[ShownJob], QueueStatus, bool, Paging]:
    """Return the fields of `_QueueRowsView`."""
    newest_first = list(reversed(jobs.store.jobs()))
    shown = [shown_job(job, jobs) for job in newest_first[(number - 1) * ROWS : number * ROWS]]
    is_active = any(job.state in ("queued", "running") for job in newest_first)
    return shown, jobs.status(), is_active, Paging(number, len(newest_first), ROWS, "/queue")


def _seconds(job: Job) -> float | None:
    """Return the duration of a job from its first start; None if it is not over, or never started."""
    if not job.is_over or not job.started or not job.ended:
        return None
    return (datetime.fromisoformat(job.ended) - datetime.fromisoformat(job.started)).total_seconds()
