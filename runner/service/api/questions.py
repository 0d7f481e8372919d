"""Questions about runs that are answered by training: jobs of the queue."""

from __future__ import annotations

from http import HTTPStatus

from fastapi import APIRouter, Request, Response
from starlette.concurrency import run_in_threadpool

from runner.client.jobs import JobStatus
from runner.runs.run import Run
from runner.service.api.jobs import created
from runner.service.dependencies import JobsOf, RecordedRun, require_written
from runner.service.jobs.checking import BranchQuestion, ExplainQuestion, check_branch, check_explanation
from runner.service.jobs.queue import JobQueue
from runner.service.jobs.store import CheckedJob, QueuedJob
from runner.util.yaml_text import write_yaml

router = APIRouter(tags=["jobs"])


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
    return await run_in_threadpool(jobs.add, write_yaml(checked.values), checked, workers)
