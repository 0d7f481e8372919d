"""Branching a run at one of its steps: a form, which queues a job."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from http import HTTPStatus
from pathlib import Path
from typing import Final, NamedTuple

from fastapi import APIRouter, Response

from runner.analysis.episodes import EpisodeRef
from runner.environments.naming import numbered_actions
from runner.errors import RunnerError
from runner.export.values import actions_at
from runner.loops.actions import space_in_words
from runner.recording.reader import Recording, open_recording
from runner.recording.spaces import Description
from runner.replay.makers import why_not_rerun
from runner.runs.run import Run
from runner.service.api.questions import queue_branch
from runner.service.dependencies import At, JobsOf, RecordedRun, require_written
from runner.service.jobs.checking import BranchQuestion, known_space
from runner.service.pages.frame import RunPage
from runner.service.pages.rendering import Form, to_job
from runner.service.problems import filled

MAX_CHOICES: Final = 200
"""More actions are typed, not listed."""
router = APIRouter(prefix="/runs/{run}/branch", include_in_schema=False)


class ActionField(NamedTuple):
    """The field of an agent's action."""

    agent: str
    """Empty for the only agent of a loop."""
    recorded: str
    """The recorded action; empty if it is not known."""
    names: list[str]
    """The actions to choose from; without any, the action is typed."""
    space: str
    """What may be typed."""


@router.get("")
def form(run: RecordedRun, jobs: JobsOf, at: At = "") -> Response:
    """Show the form for a step."""
    return _page(run, jobs.recordings, {"at": at})


@router.post("")
async def branch(run: RecordedRun, sent: Form, jobs: JobsOf) -> Response:
    """Queue the branch, or show what is wrong."""
    given = {name: text.strip() for name, text in sent.items()}
    try:
        job = await queue_branch(run, jobs, _question(given))
    except RunnerError as error:
        return _page(run, jobs.recordings, given, error)
    return to_job(job.number)


def _question(given: Mapping[str, str]) -> BranchQuestion:
    """Return the branch that the fields of the form describe."""
    prefix = "action."
    actions = {
        name.removeprefix(prefix): text for name, text in given.items() if name.startswith(prefix) and text
    }
    others = {name: text for name, text in given.items() if not name.startswith(prefix)}
    lines = tuple(filter(None, map(str.strip, given.get("overrides", "").splitlines())))
    return filled(BranchQuestion, {**others, "action": actions.get("", actions), "overrides": lines})


def _page(
    run: Run, recordings: Path, given: Mapping[str, str], problem: RunnerError | None = None
) -> Response:
    """Return the form with the fields as they were sent, or why the run cannot be branched here."""

    def values() -> dict[str, object]:
        with open_recording(run.recording) as recording:
            return {
                "given": given,
                "problem": problem,
                "actions": _action_fields(recording, given.get("at", "")),
                "is_trained": recording.can_train_again,
                "refusal": _refusal(run, recordings, recording),
            }

    status = HTTPStatus.UNPROCESSABLE_ENTITY if problem else None
    return RunPage(run, "replay", "run_branch.html", values, status)


def _refusal(run: Run, recordings: Path, recording: Recording) -> str:
    """Return why no step of the run can be branched here; empty if it can be tried."""
    try:
        require_written(run, recordings, "branch")
    except RunnerError as error:
        return str(error)
    return "" if recording.can_train_again else why_not_rerun(recording)


def _action_fields(recording: Recording, at: str) -> list[ActionField]:
    """Return the field of each agent's action at a step."""
    step, recorded = EpisodeRef(0), dict[str, str]()
    with contextlib.suppress(RunnerError):  # there is no such step, or it was not recorded
        step = EpisodeRef.parse(at).resolved(recording)
        recorded = actions_at(recording, step)
    if recording.can_train_again:
        named = zip(recording.mdp.agents, numbered_actions(recording.mdp), strict=True)
        return [ActionField(agent, recorded.get(agent, ""), names, "") for agent, names in named]
    space, steps = recording.spaces["action"], recording.phase(step.phase)
    is_of_agents = "acted" in (steps.steps.row_dtype.names or ())
    return [
        ActionField(agent, recorded.get(agent, ""), *_choices(part, steps.action_names(agent)))
        for agent, part in (space["spaces"] if is_of_agents else {"": space}).items()
    ]


def _choices(description: Description, names: tuple[str, ...]) -> tuple[list[str], str]:
    """Return the actions to choose from, if they are discrete and not many, and what may be typed."""
    first, count = description.get("start", 0), description["n"] if description["type"] == "Discrete" else 0
    choices = list(names or map(str, range(first, first + count))) if count <= MAX_CHOICES else []
    space = known_space(description)
    return choices, "" if space is None else space_in_words(space)
