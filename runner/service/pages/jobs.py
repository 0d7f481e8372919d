"""The forms that queue jobs, the queue, a job, and the uploads that are not yet runs."""

from __future__ import annotations

import contextlib
import functools
import json
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from http import HTTPStatus
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Final, NamedTuple

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import RedirectResponse
from pydantic import BaseModel
from starlette.concurrency import run_in_threadpool

from runner.analysis.episodes import EpisodeRef
from runner.analysis.sections import Paging
from runner.client.jobs import JobStatus
from runner.config.document import write_yaml
from runner.config.schema import branches, expected, json_schema, without_references
from runner.debugging.explanation import explanations_in
from runner.environments.naming import numbered_actions
from runner.errors import RunnerError
from runner.export.values import actions_at
from runner.loops.actions import space_in_words
from runner.recording.reader import Recording, open_recording
from runner.recording.spaces import Description, least_number
from runner.replay.makers import why_not_rerun
from runner.runs.run import Run
from runner.service.api.files import list_uploads
from runner.service.api.jobs import Number, Workers, queue_branch, queue_explanation
from runner.service.dependencies import (
    At,
    CatalogueOf,
    JobsOf,
    OwnerOf,
    RecordedRun,
    UploadsOf,
    require_written,
)
from runner.service.errors import Refused
from runner.service.jobs.checking import SWEEP_KEYS, BranchQuestion, ExplainQuestion, known_space
from runner.service.jobs.queue import JobQueue
from runner.service.jobs.store import CheckedJob
from runner.service.pages.rendering import Form, Page, StatusName, run_page, to_job, viewer_of
from runner.service.problems import HttpProblem, error_body, filled
from runner.sweep.model import SweepFile
from runner.util.values import Json, JsonView, is_whole

router = APIRouter(include_in_schema=False)

ROWS: Final = 50
MAX_LINES: Final = 1000
"""Lines of a job's log that its page shows."""
After = Annotated[int, Query(ge=0, lt=2**53)]
PageNumber = Annotated[int, Query(alias="page", ge=1, lt=10**6)]


@router.get("/queue")
def queue(jobs: JobsOf, uploads: UploadsOf, owner: OwnerOf, number: PageNumber = 1) -> Response:
    """Show the jobs, the newest first, and the uploads that are not yet runs."""
    pending = [upload for upload in list_uploads(uploads, owner).uploads if upload.state != "stored"]
    return Page("queue.html", {**_rows(jobs, number), "uploads": pending[:ROWS]})


@router.get("/queue/status")
def queue_status(jobs: JobsOf, number: PageNumber = 1) -> Response:
    """Return the jobs as a part of their page; 204 if all are over."""
    rows = _rows(jobs, number)
    no_change = Response(status_code=HTTPStatus.NO_CONTENT)
    return Page("queue_rows.html", rows) if rows["is_active"] else no_change


@router.get("/queue/{number}")
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


@router.get("/queue/{number}/status")
def job_status(jobs: JobsOf, number: Number, state: StatusName) -> Response:
    """Return the progress and the runs of a job as a part of its page; 204 once it has another state."""
    status = jobs.store.job(number).status()
    if status.state != state:
        return Response(status_code=HTTPStatus.NO_CONTENT)
    return Page("job_status.html", {"job": status})


@router.get("/queue/{number}/log")
def job_log(jobs: JobsOf, number: Number, after: After) -> Response:
    """Return the lines of a job's log after an event as a part of its page."""
    return Page("job_log.html", {"log": jobs.store.events(number, after)[0]})


@router.post("/queue/{number}/cancel")
def cancel(jobs: JobsOf, number: Number, page: PageNumber | None = None) -> Response:
    """Cancel a job; a page of the queue is shown again."""
    jobs.cancel(number)
    return to_job(number) if page is None else RedirectResponse(f"/queue?page={page}", HTTPStatus.SEE_OTHER)


@router.post("/queue/{number}/resume")
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


FIRST: Final = """\
# A first look: one agency learns to drive both taxis, in a second or two.
name: first
mode: cooperative
episodes: 3000
seed: 0
step_size: 1.0
discount: 0.99
epsilon: {schedule: linear, start: 1.0, end: 0.1, over: 3000}
evaluation: {every: 200, trials: 100}
"""
SWEEP: Final = """\
# Several values, several seeds each: what of it matters?
name: which-discount
base:
  name: quick
  mode: cooperative
  episodes: 1000
  step_size: 1.0
  epsilon: {schedule: linear, start: 1.0, end: 0.1, over: 1000}
  evaluation: {every: 200, trials: 50}
parameters:
  discount: [0.9, 0.95, 0.99]
strategy: grid
seeds: [0, 1]
"""


class _Options(BaseModel):
    """The fields of the form besides the text."""

    workers: Workers = None


class Key(NamedTuple):
    """A key of a configuration or a sweep, as the schema describes it."""

    name: str
    description: str
    expected: str
    """What it takes, as in messages about it."""
    default: str
    inner: list[Key]


@router.get("/submit")
def submit_form(
    request: Request,
    catalogue: CatalogueOf,
    origin: Annotated[str, Query(alias="from", max_length=200)] = "",
    sweep: Annotated[bool, Query()] = False,
) -> Response:
    """Show the form, with a configuration to start from."""
    if not viewer_of(request).can_write:
        raise Refused(
            HTTPStatus.FORBIDDEN, "token: found one for reading, expected one for writing: log in with that."
        )
    text = SWEEP if sweep else FIRST
    if origin:
        text = write_yaml(catalogue.find(origin).file.config)
    return Page("submit.html", _submit_values(text))


@router.post("/submit")
async def submit(request: Request, sent: Form, jobs: JobsOf) -> Response:
    """Queue the text of the form, or show its mistakes."""
    text = sent.get("text", "")
    try:
        checked = await jobs.checker.check(text)
        if sent.get("action") == "check":
            return Page("submit.html", _submit_values(text, sent, checked=checked))
        options = filled(_Options, {"workers": sent.get("workers")})
        job = await run_in_threadpool(jobs.add, text, checked, options.workers)
    except RunnerError as error:
        values = _submit_values(text, sent, _problems(request, text, error))
        return Page("submit.html", values, HTTPStatus.UNPROCESSABLE_ENTITY)
    return to_job(job.number)


def _problems(request: Request, text: str, error: RunnerError) -> list[tuple[HttpProblem, str]]:
    """Return the mistakes in a text, each with the text of its line."""
    body = error_body(error, request.app.state.settings)
    lines = dict(enumerate(text.splitlines(), 1))
    problems = body.problems or [HttpProblem(message=body.message)]
    return [(problem, lines.get(problem.line or 0, "")) for problem in problems]


def _submit_values(
    text: str,
    sent: Mapping[str, str] = MappingProxyType({}),
    problems: Sequence[tuple[HttpProblem, str]] = (),
    checked: CheckedJob | None = None,
) -> dict[str, object]:
    """Return the values of the page.

    `problems` are mistakes, each with the text of its line; `checked` is what the text means, if it was
    checked and is valid.
    """
    is_sweep = any(line.startswith(f"{key}:") for line in text.splitlines() for key in SWEEP_KEYS)
    return {
        "text": text,
        "workers": sent.get("workers", ""),
        "problems": problems,
        "checked": checked,
        "keys": config_keys(),
        "sweep_keys": sweep_keys() if is_sweep else [],
    }


@functools.cache
def config_keys() -> list[Key]:
    """Return the keys of a configuration."""
    return list(_keys(without_references(json_schema())["properties"]))


@functools.cache
def sweep_keys() -> list[Key]:
    """Return the keys of a sweep."""
    return list(_keys(without_references(SweepFile.model_json_schema())["properties"]))


def _keys(properties: JsonView) -> Iterator[Key]:
    for name, node in properties.items():
        inner: Json = {}
        for option in branches(node):
            inner |= option.get("properties", {})
        default = json.dumps(node["default"]) if "default" in node else ""
        yield Key(name, node.get("description", ""), expected(node), default, list(_keys(inner)))


MAX_CHOICES: Final = 200
"""More actions are typed, not listed."""


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


@router.get("/runs/{run}/branch")
def branch_form(run: RecordedRun, jobs: JobsOf, at: At = "") -> Response:
    """Show the form for a step."""
    return _branch_page(run, jobs.recordings, {"at": at})


@router.post("/runs/{run}/branch")
async def branch(run: RecordedRun, sent: Form, jobs: JobsOf) -> Response:
    """Queue the branch, or show what is wrong."""
    given = {name: text.strip() for name, text in sent.items()}
    try:
        job = await queue_branch(run, jobs, _question(given))
    except RunnerError as error:
        return _branch_page(run, jobs.recordings, given, error)
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


def _branch_page(
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
    return run_page(run, "replay", "run_branch.html", values, status)


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
    first, count = least_number(description), description.get("n") if description["type"] == "Discrete" else 0
    choices: list[str] = []
    if is_whole(count, 0, MAX_CHOICES):  # a recording of others may state anything
        choices = list(names or map(str, range(first, first + count)))
    space = known_space(description)
    return choices, "" if space is None else space_in_words(space)


SourceName = Annotated[str, Query(max_length=200)]


@router.get("/explain")
def explain_form(a: SourceName = "", b: SourceName = "") -> Response:
    """Show the form."""
    return Page("explain.html", {"given": {"a": a, "b": b}, "problem": ""})


@router.post("/explain")
async def explain(sent: Form, jobs: JobsOf) -> Response:
    """Queue the explanation, or show what is wrong."""
    given = {name: text.strip() for name, text in sent.items()}
    try:
        job = await queue_explanation(jobs, filled(ExplainQuestion, given))
    except RunnerError as error:
        values = {"given": given, "problem": error}
        return Page("explain.html", values, HTTPStatus.UNPROCESSABLE_ENTITY)
    return to_job(job.number)
