"""What is done and where it goes: the queue of jobs, sweeps, the disk."""

from __future__ import annotations

import json
import math
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from fastapi import APIRouter, Query, Request, Response
from fastapi import Path as InPath
from fastapi.responses import RedirectResponse

from runner.catalogue.columns import with_originals
from runner.catalogue.filters import Filter, parse
from runner.catalogue.usage import freeable_of, totals, usages
from runner.errors import RunnerError, RunNotFound
from runner.service import played
from runner.service.api.jobs import Number, queue_told, told
from runner.service.api.uploads import OwnerOf, UploadsOf, list_uploads
from runner.service.dependencies import ApartOf, CatalogueOf, JobsOf, KeptOf, SettingsOf
from runner.service.pages.problems import message_of
from runner.service.pages.rendering import link, page, picture_address
from runner.sweep.state import read_sweep, sweeps_in, tag_of

if TYPE_CHECKING:
    from runner.catalogue.index import Index
    from runner.service.queue import Job
    from runner.service.work import Jobs

router = APIRouter(include_in_schema=False)

ROWS: Final = 50
MOST_LINES: Final = 1000
"""Lines of a job's log that its page shows."""
SWEEP_SECONDS: Final = 20.0
"""So old may what is told of a sweep be."""
Name = Annotated[str, InPath(max_length=100)]

FREED_BY: Final = {
    "same_content": ("Recorded before", "The same content is there already: `dualtaxi rm` removes runs."),
    "unfinished": (
        "Unfinished",
        "`dualtaxi prune --status interrupted --status failed`, if not to be resumed.",
    ),
    "left_over": ("Left over", "Damaged originals that a repair kept, and what interrupted commands left."),
    "cached": ("Cached", "Made again when needed."),
    "half_removed": ("Half removed", "The next `dualtaxi rm` or `prune` removes the rest."),
}


@router.get("/queue")
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


@router.get("/queue/standing")
def queue_standing(
    request: Request, jobs: JobsOf, number: Annotated[int, Query(alias="page", ge=1, lt=10**6)] = 1
) -> Response:
    """Return the jobs as a part of their page; 204 when none is under way."""
    shown = _queue(jobs, number)
    if not shown["active"]:
        return Response(status_code=HTTPStatus.NO_CONTENT)
    return page(request, "queue_rows.html", **shown)


@router.get("/queue/{number}")
def job(request: Request, jobs: JobsOf, number: Number) -> Response:
    """Show a job: how far it is, what it said, its runs."""
    log, place = _log(jobs, number)
    found = jobs.queue.job(number)  # not older than its log: what comes behind that, the page's script hears
    return page(
        request,
        "job.html",
        job=_told(found, jobs),
        log=log,
        place=place,
        submitted=jobs.queue.submitted(number),
        runs=_runs(found, jobs),
    )


@router.post("/queue/{number}/cancel")
def cancel(jobs: JobsOf, number: Number) -> Response:
    """Cancel a job."""
    jobs.cancel(number)
    return RedirectResponse(f"/queue/{number}", HTTPStatus.SEE_OTHER)


@router.post("/queue/{number}/resume")
def resume(jobs: JobsOf, number: Number) -> Response:
    """Go on with a job."""
    jobs.resume(number)
    return RedirectResponse(f"/queue/{number}", HTTPStatus.SEE_OTHER)


@router.get("/sweeps")
def sweeps(request: Request, settings: SettingsOf, catalogue: CatalogueOf) -> Response:
    """Show the sweeps."""
    found: list[dict[str, Any]] = []
    for folder in settings.recordings:
        for name in sweeps_in(folder):
            try:
                sweep = read_sweep(name, folder)
            except RunnerError as error:
                found.append({"name": name, "problem": message_of(error, request)})
                continue
            found.append(
                {
                    "name": name,
                    "problem": "",
                    "strategy": sweep.file.strategy,
                    "parameters": ", ".join(sweep.file.parameters),
                    "objective": sweep.objective.described,
                    "runs": _runs_tagged(catalogue, name),
                }
            )
    return page(request, "sweeps.html", sweeps=found)


@router.get("/sweeps/{name}")
async def sweep(
    request: Request, name: Name, settings: SettingsOf, kept: KeptOf, apart: ApartOf, jobs: JobsOf
) -> Response:
    """Show what came of a sweep."""
    folder = _folder_of(name, settings.recordings)
    key = ("sweep", name, folder)
    body = await kept.awaited(key, lambda: apart(played.sweep, name, folder), SWEEP_SECONDS)
    made_by = [job.number for job in jobs.queue.jobs() if job.kind == "sweep" and job.name == name]
    found = json.loads(body)
    pictures = [picture_address(picture) for picture in found["pictures"]]
    shown = {"told": found, "pictures": pictures, "jobs": made_by[-1:], "tag": tag_of(name)}
    return page(request, "sweep.html", name=name, **shown)


@router.get("/disk")
def disk(request: Request, catalogue: CatalogueOf, settings: SettingsOf, jobs: JobsOf) -> Response:
    """Show what uses the disk, and what could be freed."""

    def work(index: Index) -> list[dict[str, Any]]:
        return with_originals(index.select(Filter(None)), index)

    found = usages(catalogue.read(work))
    freeable = freeable_of(found, settings.recordings)
    return page(
        request,
        "disk.html",
        total=totals(found),
        free=jobs.standing().free_bytes,
        freeable=[(*FREED_BY[kind], size) for kind, size in freeable.items() if size],
        rows=[{"row": usage.row, "sizes": totals([usage])} for usage in found[:ROWS]],
        left=len(found) - ROWS,
        folders=[str(folder) for folder in settings.recordings],
    )


# --- inside -------------------------------------------------------------------------------------------


def _queue(jobs: Jobs, number: int) -> dict[str, Any]:
    found = list(reversed(jobs.queue.jobs()))
    shown = found[(number - 1) * ROWS : number * ROWS]
    return {
        "jobs": [_told(job, jobs) for job in shown],
        "standing": queue_told(jobs.standing()),
        "active": any(job.state in ("queued", "running") for job in found),
        "page": number,
        "pages": max(1, math.ceil(len(found) / ROWS)),
        "turned": lambda to: link("/queue", {"page": to}),
    }


def _told(job: Job, jobs: Jobs) -> dict[str, Any]:
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


def _log(jobs: Jobs, number: int) -> tuple[list[dict[str, Any]], int]:
    """Return the last events of a job, and the place behind them."""
    lines: list[dict[str, Any]] = []
    place = 0
    while True:
        found, place = jobs.queue.events(number, place)
        if not found:
            return lines[-MOST_LINES:], place
        lines += [{"kind": event.kind, **event.data} for event in found]


def _runs(job: Job, jobs: Jobs) -> list[dict[str, Any]]:
    return [{"seed": seed, "id": run_id} for seed, run_id in jobs.queue.runs_of(job.number).items()]


def _runs_tagged(catalogue: CatalogueOf, name: str) -> int:
    chosen = parse(f'tag:"{tag_of(name)}"')
    return catalogue.read(lambda index: index.count(chosen))


def _folder_of(name: str, folders: tuple[Path, ...]) -> Path:
    for folder in folders:
        if name in sweeps_in(folder):
            return folder
    raise RunNotFound(f"no sweep {name!r}: the page of sweeps lists those there are.")
