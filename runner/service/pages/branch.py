"""Branching the training of a run at one of its steps: a form, which queues a job."""

from __future__ import annotations

from collections.abc import Mapping
from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from starlette.concurrency import run_in_threadpool

from runner.environments.naming import numbered_actions
from runner.errors import RunnerError
from runner.recording.reader import open_recording
from runner.runs.run import Run
from runner.service.api.questions import queue_branch
from runner.service.dependencies import JobsOf, RecordedRun
from runner.service.jobs.checking import BranchQuestion
from runner.service.pages.frame import run_page
from runner.service.pages.rendering import Form, message_of, number_in, to_job

router = APIRouter(prefix="/runs/{run}/branch", include_in_schema=False)


@router.get("")
def form(request: Request, run: RecordedRun, at: Annotated[str, Query(max_length=60)] = "") -> Response:
    """Show the form for a step."""
    return _page(request, run, {"at": at})


@router.post("")
async def branch(request: Request, run: RecordedRun, sent: Form, jobs: JobsOf) -> Response:
    """Queue the branch, or show what is wrong."""
    given = {name: text.strip() for name, text in sent.items()}
    try:
        job = await queue_branch(run, jobs, _question(given))
    except RunnerError as error:
        return await run_in_threadpool(_page, request, run, given, message_of(error, request))
    return to_job(job.number)


def _question(given: Mapping[str, str]) -> BranchQuestion:
    """Return the branch that the fields of the form describe."""
    prefix = "action."
    own: dict[str, str | int] = {
        name.removeprefix(prefix): text for name, text in given.items() if name.startswith(prefix) and text
    }
    return BranchQuestion(
        at=given.get("at", ""),
        action=own or None,
        overrides=tuple(filter(None, map(str.strip, given.get("overrides", "").splitlines()))),
        episodes=number_in(given, "episodes"),
        name=given.get("name") or None,
    )


def _page(request: Request, run: Run, fields: Mapping[str, str], problem: str = "") -> Response:
    """Return the form with the fields as they were sent, and the names of each agent's own actions."""
    with open_recording(run.recording) as recording:
        recording.require_job("a branch of training", "`dualtaxi branch` plays an episode of a loop on.")
        mdp = recording.mdp
    actions = dict(zip(mdp.agents, numbered_actions(mdp), strict=True))
    values = {"form": fields, "actions": actions, "problem": problem}
    status = HTTPStatus.UNPROCESSABLE_ENTITY if problem else HTTPStatus.OK
    return run_page(request, run, "replay", "run_branch.html", values, status)
