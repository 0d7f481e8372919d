"""The pages of a run: how it stands, its metrics, its evaluations, what it learned, what made it."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Mapping
from datetime import UTC, datetime
from http import HTTPStatus
from itertools import islice
from typing import TYPE_CHECKING, Annotated, Any, Final

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import RedirectResponse
from starlette.concurrency import run_in_threadpool

from runner.analysis.evaluations import evaluation_record, evaluation_records
from runner.environments.naming import event_in_words
from runner.errors import RecordingError, RunnerError
from runner.recording import schema
from runner.recording.labels import MAX_NOTE
from runner.recording.metrics import METRICS, EvaluationMetric
from runner.recording.reader import Recording, open_recording
from runner.runs.run import Run
from runner.service import played
from runner.service.api.replay import LONG
from runner.service.api.runs import Labels, relabelled
from runner.service.dependencies import (
    CacheOf,
    CatalogueOf,
    FoundRun,
    JobsOf,
    OpenRecording,
    ProcessesOf,
    RecordedRun,
    SettingsOf,
    recording_state,
)
from runner.service.pages.forms import Form
from runner.service.pages.frame import framed, is_loop, loop_results
from runner.service.pages.problems import message_of
from runner.service.pages.rendering import page
from runner.util import humanize

if TYPE_CHECKING:
    from runner.service.jobs.pool import JobPool
    from runner.service.processes import ProcessPool
    from runner.service.response_cache import ResponseCache
    from runner.service.settings import Settings

router = APIRouter(prefix="/runs/{run}", include_in_schema=False)

MOST_LINES: Final = 500
"""Lines of a run's log that its page shows: the last ones."""
MOST_EVALUATIONS: Final = 500
MOST_LOGGED: Final = 8
"""Logged values on the first page of a run."""
BROAD: Final = 60_000
"""A map of more characters than this is shown over the whole width."""
_LEVELS: Final = {1: "debug", 2: "info", 3: "warning", 4: "error", 5: "fatal"}


@router.get("")
async def overview(
    request: Request,
    run: FoundRun,
    jobs: JobsOf,
    settings: SettingsOf,
    cache: CacheOf,
    processes: ProcessesOf,
) -> Response:
    """Show how a run stands, and its metrics."""
    random = await _random_policy(run, cache, processes)
    return await run_in_threadpool(_overview, request, run, jobs, settings, random=random)


@router.post("/labels")
def label(
    request: Request, run: FoundRun, form: Form, jobs: JobsOf, catalogue: CatalogueOf, settings: SettingsOf
) -> Response:
    """Change what people say of a run."""
    tags = form.get("tags", "").split()
    changed = Labels.model_construct(
        name=form.get("name", "").strip(),
        tag=tags,
        untag=sorted(set(run.tags) - set(tags)),
        note=form.get("note", ""),
    )
    try:
        relabelled(run, changed, catalogue)
    except RunnerError as error:
        return _overview(request, run, jobs, settings, message_of(error, request))
    return RedirectResponse(f"/runs/{run.run_id}#labels-title", HTTPStatus.SEE_OTHER)


@router.get("/standing")
def standing(
    request: Request,
    run: FoundRun,
    jobs: JobsOf,
    settings: SettingsOf,
    status: Annotated[str, Query(max_length=20)] = "running",
) -> Response:
    """Return how a run stands, as a part of its page.

    204 when the page is another by now: the run has another `status` than it says, or is not live any more.
    """
    now = _standing(run, jobs, settings)
    if run.status != status or not now["is_live"]:
        return Response(status_code=HTTPStatus.NO_CONTENT)
    return page(request, "run_standing.html", standing=now)


@router.get("/evaluations")
def evaluations(request: Request, run: RecordedRun, recording: OpenRecording) -> Response:
    """Show the last evaluations."""
    is_job = recording.is_job
    learners, events = recording.agents, recording.event_names
    if is_job:
        last = deque(recording.iter_metrics("eval"), MOST_EVALUATIONS)
        shown = [evaluation_record(metrics, learners, events) for metrics in last]
        total = recording.count(recording.topic("/eval/metrics"))
    else:
        records = evaluation_records(recording)
        shown, total = records[-MOST_EVALUATIONS:], len(records)
    return page(
        request,
        "run_evaluations.html",
        **framed(run, "evaluations"),
        evaluations=shown,
        of=total,
        is_job=is_job,
        learners=learners,
        event_names=[event_in_words(name) for name in events],
    )


@router.get("/learned")
async def learned(request: Request, run: RecordedRun, cache: CacheOf, processes: ProcessesOf) -> Response:
    """Show policy and values at stages of learning."""
    key = ("learned", recording_state(run))
    maps = json.loads(await cache.get_or_await(key, lambda: processes(played.learned, run.recording), LONG))
    broad = any(len(row["svgs"][0][1]) > BROAD for row in maps if row["svgs"])
    return page(request, "run_learned.html", **framed(run, "learned"), maps=maps, broad=broad)


@router.get("/config")
def config(request: Request, run: FoundRun, settings: SettingsOf) -> Response:
    """Show configuration, provenance and log."""
    from runner.config.document import write_yaml

    facts, provenance, log = _recorded_facts(run, settings)
    return page(
        request,
        "run_config.html",
        **framed(run, "config"),
        yaml=write_yaml(run.file.config),
        facts=facts,
        provenance=provenance,
        log=log,
    )


# --- inside -------------------------------------------------------------------------------------------


async def _random_policy(run: Run, cache: ResponseCache, processes: ProcessPool) -> str:
    """Return what a random policy gets in a run's environment, as a sentence; empty if that is unknown."""
    try:
        key = ("random_policy", await run_in_threadpool(recording_state, run))
        sentence = await cache.get_or_await(key, lambda: processes(played.random_policy, run.recording), LONG)
    except (OSError, RunnerError):
        return ""  # the page itself says what is wrong with the recording
    return sentence.decode()


def _overview(
    request: Request, run: Run, jobs: JobPool, settings: Settings, problem: str = "", random: str = ""
) -> Response:
    """Return the first page of a run, with what is wrong with labels that were sent."""
    status = HTTPStatus.BAD_REQUEST if problem else HTTPStatus.OK
    shown = framed(run, "") | {"standing": _standing(run, jobs, settings)}
    return page(
        request, "run_overview.html", status, **shown, problem=problem, most_note=MAX_NOTE, random=random
    )


def _standing(run: Run, jobs: JobPool, settings: Settings) -> dict[str, Any]:
    """Return how a run stands: what it did, how far it is, which job makes it, whether that will change."""
    number, progress = _job_of(run, jobs)
    summary = progress or run.summary
    last = summary.get("last_evaluation") or {}
    done = summary.get("episode", summary.get("episodes"))
    to_do = run.episodes_to_do
    facts = _results(run, last) | {
        "Training episodes": humanize.UNKNOWN if done is None else f"{done:,}",
        "Steps of training": humanize.number(summary.get("train_steps"), 0),
        "Steps of evaluation": humanize.number(summary.get("eval_steps"), 0),
        "Time": _seconds(run),
        "Recording": humanize.size(summary["bytes"]) if summary.get("bytes") else humanize.UNKNOWN,
    }
    share, said = None, ""
    if run.status == "running" and to_do is not None and done is not None:
        share, said = min(1.0, done / to_do), f"{done:,} of {to_do:,} training episodes"
    return {
        "facts": list(facts.items()),
        "share": share,
        "said": said,
        "error": settings.without_folders(run.problem or run.summary.error or ""),
        "job": number,
        "is_live": run.status == "running" or (number is not None and run.status != "finished"),
    }


def _results(run: Run, last: Mapping[str, Any]) -> dict[str, str]:
    """Return the last results of a run by name: of a loop those that it has."""
    if not is_loop(run):
        return _of_evaluation({metric: last.get(metric.name) for metric in METRICS if not metric.per_agent})
    results = loop_results(run)
    evaluation, recent = results["last_evaluation"] or {}, results["recent_training"]
    episodes = f"the last {recent['episodes']:,} training episodes"
    measures = {
        **_of_evaluation({metric: evaluation.get(metric.name) for metric in METRICS}),
        f"Mean return of {episodes}": humanize.number(recent["mean_return"]),
        f"Mean length of {episodes}": humanize.number(recent["mean_length"]),
    }
    logged = {
        f"Logged last: {name}": "not finite" if value is None else f"{value:,.4g}"
        for name, value in islice(results["logged"].items(), MOST_LOGGED)
    }
    return {name: text for name, text in measures.items() if humanize.UNKNOWN not in text} | logged


def _of_evaluation(values: Mapping[EvaluationMetric, float | None]) -> dict[str, str]:
    return {
        f"{metric.heading.capitalize()} in the last evaluation": humanize.number(value)
        for metric, value in values.items()
    }


def _job_of(run: Run, jobs: JobPool) -> tuple[int | None, dict[str, Any]]:
    """Return the job that makes a run, or will go on with it, and how far the run is; None if none does."""
    for job in jobs.store.jobs():
        if not job.is_over and run.run_id in jobs.store.run_ids(job.number).values():
            progress = (jobs.progress(job.number) or {}) if job.state == "running" else {}
            return job.number, progress if progress.get("run_id") == run.run_id else {}
    return None, {}


def _seconds(run: Run) -> str:
    if run.status == "running":
        return f"{humanize.duration((datetime.now(UTC) - run.created).total_seconds())} so far"
    seconds = run.summary.seconds
    return humanize.UNKNOWN if seconds is None else humanize.duration(seconds)


def _recorded_facts(
    run: Run, settings: Settings
) -> tuple[dict[str, str], dict[str, str], list[dict[str, Any]]]:
    """Return what identifies a recording, where it was made, and what its run said; as far as it is there."""
    facts = {
        "Run": run.run_id,
        "Begun": f"{run.created:%Y-%m-%d %H:%M:%S} UTC",
        "Content digest": run.summary.content_digest or "none: told when a run ends properly",
        "Steps": f"{humanize.number(run.summary.get('train_steps'), 0)} of training, "
        f"{humanize.number(run.summary.get('eval_steps'), 0)} of evaluation",
    }
    try:
        with open_recording(run.recording) as recording:
            facts |= {"Job": recording.job, "Size": humanize.size(recording.size)}
            return facts, recording.provenance, _log(recording)
    except RecordingError as error:
        return facts | {"Recording": settings.without_folders(str(error))}, {}, []


def _log(recording: Recording) -> list[dict[str, Any]]:
    lines = deque(recording.decoded(schema.LOG_TOPIC), MOST_LINES)
    return [
        {
            "step": line["log_time"] // schema.STEP_NANOSECONDS,
            "level": _LEVELS.get(line["level"], str(line["level"])),
            "message": line["message"],
        }
        for line in lines
    ]
