"""Branching a run at one of its steps: a form, which queues a job."""

from __future__ import annotations

from collections.abc import Mapping
from http import HTTPStatus
from typing import Final

from fastapi import APIRouter, Response
from fastapi.exceptions import RequestValidationError
from pydantic import ValidationError

from runner.environments.naming import numbered_actions
from runner.errors import RunnerError
from runner.recording.reader import Recording, open_recording
from runner.replay.makers import why_not_rerun
from runner.runs.run import Run
from runner.service.api.questions import queue_branch
from runner.service.dependencies import At, JobsOf, RecordedRun
from runner.service.jobs.checking import BranchQuestion
from runner.service.pages.frame import RunPage
from runner.service.pages.rendering import Form, number_in, to_job

MAX_CHOICES: Final = 200
"""More actions are typed, not listed."""
router = APIRouter(prefix="/runs/{run}/branch", include_in_schema=False)


@router.get("")
def form(run: RecordedRun, at: At = "") -> Response:
    """Show the form for a step."""
    return _page(run, {"at": at})


@router.post("")
async def branch(run: RecordedRun, sent: Form, jobs: JobsOf) -> Response:
    """Queue the branch, or show what is wrong."""
    given = {name: text.strip() for name, text in sent.items()}
    try:
        job = await queue_branch(run, jobs, _question(given))
    except RunnerError as error:
        return _page(run, given, error)
    return to_job(job.number)


def _question(given: Mapping[str, str]) -> BranchQuestion:
    """Return the branch that the fields of the form describe."""
    prefix = "action."
    actions: dict[str, str | int] = {
        name.removeprefix(prefix): text for name, text in given.items() if name.startswith(prefix) and text
    }
    fields = {
        "at": given.get("at", ""),
        "action": actions.get("", actions or None),
        "overrides": tuple(filter(None, map(str.strip, given.get("overrides", "").splitlines()))),
        "episodes": number_in(given, "episodes"),
        "policy": given.get("policy") or "recorded",
        "seed": number_in(given, "seed") or 0,
        "name": given.get("name") or None,
    }
    try:
        return BranchQuestion.model_validate(fields)
    except ValidationError as error:  # the form itself offers nothing else
        raise RequestValidationError(error.errors()) from error


def _page(run: Run, fields: Mapping[str, str], problem: RunnerError | None = None) -> Response:
    """Return the form with the fields as they were sent, or why an episode of a loop cannot be played on."""

    def values() -> dict[str, object]:
        phase = "eval" if fields.get("at", "").startswith("eval:") else "train"
        with open_recording(run.recording) as recording:
            return {
                "form": fields,
                "problem": problem,
                "actions": _choices(recording, phase),
                "max_choices": MAX_CHOICES,
                "is_trained": recording.can_train_again,
                "refusal": "" if recording.can_train_again else why_not_rerun(recording),
            }

    status = HTTPStatus.UNPROCESSABLE_ENTITY if problem else None
    return RunPage(run, "replay", "run_branch.html", values, status)


def _choices(recording: Recording, phase: str) -> dict[str, list[str]]:
    """Return the actions of each agent, in a space that is not discrete none; of one agent alone by ""."""
    if recording.can_train_again:
        return dict(zip(recording.mdp.agents, numbered_actions(recording.mdp), strict=True))
    space, steps = recording.spaces["action"], recording.phase(phase)
    is_of_agents = "acted" in (steps.steps.row_dtype.names or ())
    choices = {}
    for agent, part in (space["spaces"] if is_of_agents else {"": space}).items():
        first, count = part.get("start", 0), part["n"] if part["type"] == "Discrete" else 0
        numbers = map(str, range(first, first + count)) if count <= MAX_CHOICES else ()
        choices[agent] = list(steps.action_names(agent) or numbers)
    return choices
