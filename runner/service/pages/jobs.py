"""The queue of jobs, a job, and the uploads that are no runs yet."""

from __future__ import annotations

import math
from datetime import datetime
from http import HTTPStatus
from typing import TYPE_CHECKING, Annotated, Any, Final

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import RedirectResponse

from runner.service.api.jobs import Number, queue_response, told
from runner.service.api.uploads import OwnerOf, UploadsOf, list_uploads
from runner.service.dependencies import JobsOf
from runner.service.pages.rendering import link, page

if TYPE_CHECKING:
    from runner.service.jobs.pool import JobPool
    from runner.service.jobs.store import Job

router = APIRouter(prefix="/queue", include_in_schema=False)

ROWS: Final = 50
MOST_LINES: Final = 1000
"""Lines of a job's log that its page shows."""


@router.get("")
def queue(
    request: Request,
    jobs: JobsOf,
    uploads: UploadsOf,
    owner: OwnerOf,
    number: Annotated[int, Query(alias="page", ge=1, lt=10**6)] = 1,
) -> Response:
    """Show the jobs, the newest first, and the uploads that are no runs yet."""
    coming = [upload for upload in list_uploads(uploads, owner).uploads if upload.state != "stored"]
    return page(request, "queue.html", uploads=coming[:ROWS], **_queue(jobs, number))


@router.get("/standing")
def queue_standing(
    request: Request, jobs: JobsOf, number: Annotated[int, Query(alias="page", ge=1, lt=10**6)] = 1
) -> Response:
    """Return the jobs as a part of their page; 204 when none is under way."""
    shown = _queue(jobs, number)
    if not shown["active"]:
        return Response(status_code=HTTPStatus.NO_CONTENT)
    return page(request, "queue_rows.html", **shown)


@router.get("/{number}")
def job(request: Request, jobs: JobsOf, number: Number) -> Response:
    """Show a job: how far it is, what it said, its runs."""
    log, place = _log(jobs, number)
    found = jobs.store.job(number)  # not older than its log: what comes behind that, the page's script hears
    return page(
        request,
        "job.html",
        job=shown_job(found, jobs),
        log=log,
        place=place,
        submitted=jobs.store.submitted(number),
        runs=_runs(found, jobs),
        is_over=found.is_over,
        seconds=_seconds(found),
    )


@router.post("/{number}/cancel")
def cancel(jobs: JobsOf, number: Number) -> Response:
    """Cancel a job."""
    jobs.cancel(number)
    return RedirectResponse(f"/queue/{number}", HTTPStatus.SEE_OTHER)


@router.post("/{number}/resume")
def resume(jobs: JobsOf, number: Number) -> Response:
    """Go on with a job."""
    jobs.resume(number)
    return RedirectResponse(f"/queue/{number}", HTTPStatus.SEE_OTHER)


# --- inside -------------------------------------------------------------------------------------------


def _queue(jobs: JobPool, number: int) -> dict[str, Any]:
    found = list(reversed(jobs.store.jobs()))
    shown = found[(number - 1) * ROWS : number * ROWS]
    return {
        "jobs": [shown_job(job, jobs) for job in shown],
        "standing": queue_response(jobs.status()),
        "active": any(job.state in ("queued", "running") for job in found),
        "page": number,
        "pages": max(1, math.ceil(len(found) / ROWS)),
        "turned": lambda to: link("/queue", {"page": to}),
    }


def shown_job(job: Job, jobs: JobPool) -> dict[str, Any]:
    """Return what is shown of a job."""
    facts = told(job, jobs).model_dump()
    progress = facts["progress"] or {}
    return facts | {"share": _share(job, progress), "said": _said(job, progress)}


def _share(job: Job, progress: dict[str, Any]) -> float | None:
    """Return how much of a job is done; None if nobody knows."""
    if job.state != "running" or not progress:
        return None
    if job.kind == "sweep":
        return float(progress["done"] / max(1, progress["runs"]))
    own = progress["episode"] / max(1, progress["episodes"])
    return float((progress["run"] - 1 + own) / progress["runs"])


def _said(job: Job, progress: dict[str, Any]) -> str:
    """Return how far a job is in words; `job.js` says the same."""
    if job.state != "running" or not progress:
        return ""
    if job.kind == "sweep":
        return f"{progress['done']:,} of {progress['runs']:,} runs"
    run = f", run {progress['run']} of {progress['runs']}" if progress["runs"] > 1 else ""
    return f"{progress['episode']:,} of {progress['episodes']:,} episodes{run}"


def _log(jobs: JobPool, number: int) -> tuple[list[dict[str, Any]], int]:
    """Return the last events of a job, and the place behind them."""
    found, place = jobs.store.last_events(number, MOST_LINES)
    return [{"kind": event.kind, **event.data} for event in found], place


def _seconds(job: Job) -> float | None:
    """Return how long a job took, from its first start; None if it is not over, or never started."""
    if not job.is_over or not job.started or not job.ended:
        return None
    return (datetime.fromisoformat(job.ended) - datetime.fromisoformat(job.started)).total_seconds()


def _runs(job: Job, jobs: JobPool) -> list[dict[str, Any]]:
    return [{"seed": seed, "id": run_id} for seed, run_id in jobs.store.run_ids(job.number).items()]
