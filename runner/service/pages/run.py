"""The pages of a run: its status and metrics, its pictures and maps, how it was made; and what changes it."""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from http import HTTPStatus
from itertools import islice
from types import MappingProxyType
from typing import Annotated, Any, Final, Literal

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse
from fastapi.routing import APIRoute
from starlette.concurrency import run_in_threadpool

from runner.analysis.axes import EPISODES
from runner.analysis.contents import damage_of
from runner.analysis.episodes import TYPICAL
from runner.analysis.evaluations import loop_summary
from runner.analysis.sections import Grid, Link, Section
from runner.analysis.summary import describe_run, results_in_words
from runner.client.jobs import RunProgress
from runner.errors import ConfigError, RecordingError, RunnerError
from runner.export.film import FORMATS
from runner.export.reports.rendering import partials
from runner.recording import schema
from runner.recording.environment import composition_of
from runner.recording.labels import MAX_NOTE
from runner.recording.messages import log_level
from runner.recording.metrics import METRICS
from runner.recording.reader import open_recording
from runner.recording.run_file import EvaluationMetrics, Summary, has_environment
from runner.runs.catalogue.removal import clean, plan, remove
from runner.runs.run import Run, label
from runner.runs.shards import shards_in_words
from runner.service import computed
from runner.service.api import files, runs
from runner.service.api.reading import AxisOf
from runner.service.dependencies import (
    CatalogueOf,
    ComputationOf,
    FoundRun,
    JobsOf,
    ProcessesOf,
    RecordedRun,
    SettingsOf,
    WrittenRun,
)
from runner.service.jobs.queue import JobQueue
from runner.service.pages.rendering import Form, Page, StatusName, form_of, result_of, run_page, viewer_of
from runner.service.settings import ServiceSettings
from runner.util import humanize
from runner.util.extras import EXPORTS, plugin_names
from runner.util.values import Json, JsonView

router = APIRouter(prefix="/runs/{run}", include_in_schema=False)

MAX_LINES: Final = 500
"""Lines at the end of a run's log that its page shows."""
MAX_RESULTS: Final = 10
"""Means of training and logged values on the first page of a run."""
StateParts = Annotated[
    list[str] | None, Query(max_length=20, description="The parts of the name of a state.")
]


@dataclass(frozen=True)
class Status:
    """The results of a run so far, and its progress."""

    facts: Mapping[str, str]
    share: float | None
    """Share of the training that is done; None if the run is not running."""
    progress: str
    error: str
    job: int | None
    """Number of the job that makes the run."""
    is_live: bool
    """Whether all of this may change."""
    run_id: str
    stop: Literal["", "possible", "requested"]
    """Whether its loop can be requested to stop."""


@router.get("")
async def overview(request: Request, run: FoundRun) -> Response:
    """Show the status of a run and its metrics; what may take longer is loaded by the page."""
    return _overview(request, run)


class _Act(APIRoute):
    """A change of a run; if it is refused, the page of the run says why."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """Return the function that handles a request."""
        handle = super().get_route_handler()

        async def act(request: Request) -> Response:
            try:
                return await handle(request)
            except RunnerError as error:
                run = await run_in_threadpool(request.app.state.catalogue.find, request.path_params["run"])
                return _overview(request, run, error, await form_of(request))

        return act


acts = APIRouter(prefix="/runs/{run}", include_in_schema=False, route_class=_Act)


@acts.post("/labels")
def label_run(run: WrittenRun, form: Form, catalogue: CatalogueOf) -> Response:
    """Change the labels of a run."""
    tags = form.get("tags", "").split()
    label(run, form.get("name", "").strip(), form.get("note", ""), tags, sorted(set(run.tags) - set(tags)))
    catalogue.changed()
    return RedirectResponse(f"/runs/{run.run_id}#labels-title", HTTPStatus.SEE_OTHER)


@acts.post("/stop")
def stop(run: FoundRun) -> Response:
    """Request that the loop which records the run stops."""
    run.request_stop()
    return RedirectResponse(f"/runs/{run.run_id}", HTTPStatus.SEE_OTHER)


@acts.post("/remove")
def remove_run(run: FoundRun, form: Form, catalogue: CatalogueOf, settings: SettingsOf) -> Response:
    """Remove a run for good, once that was confirmed by its id."""
    if form.get("confirm", "").strip() != run.run_id:
        raise ConfigError(f"To remove the run and its recording for good, type its id, {run.run_id}.")
    remove(plan(run, settings.recordings[0]))
    catalogue.changed()
    clean(settings.recordings[0], [run.run_id])
    return RedirectResponse("/runs", HTTPStatus.SEE_OTHER)


@acts.post("/archive")
async def archive(
    run: FoundRun, form: Form, catalogue: CatalogueOf, settings: SettingsOf, processes: ProcessesOf
) -> Response:
    """Archive a run, and remove its recording if the form says so."""
    await runs.archive_run(run, catalogue, settings, processes, form.get("remove") == "yes")
    return RedirectResponse(f"/runs/{run.run_id}", HTTPStatus.SEE_OTHER)


@acts.post("/film")
async def film(run: RecordedRun, form: Form, compute: ComputationOf) -> Response:
    """Return a film of an episode as a download."""
    return await files.film(run, compute, form.get("at", "").strip() or TYPICAL, form.get("ending", ".mp4"))


@router.get("/status")
def status(
    run: FoundRun,
    jobs: JobsOf,
    settings: SettingsOf,
    status: StatusName = "running",
) -> Response:
    """Return the status of a run as a part of its page.

    204 if the page must be loaded again: the run no longer has this `status`, or is no longer live.
    """
    now = _status(run, jobs, settings)
    if run.status != status or not now.is_live:
        return Response(status_code=HTTPStatus.NO_CONTENT)
    return Page("run_status.html", {"status": now})


@router.get("/branches")
def branches(run: FoundRun, catalogue: CatalogueOf) -> Response:
    """Return the tree of branches that a run belongs to, as a part of its page; empty without any."""
    tree = catalogue.read(lambda index: index.branch_tree(run.run_id))
    return Page("run_branches.html", {"run": run.run_id, "branches": tree})


@router.get("/random-policy")
async def random_policy(run: FoundRun, compute: ComputationOf) -> Response:
    """Return what a random policy achieves, as a part of the run's page."""
    try:
        return HTMLResponse(await compute(computed.random_policy, run.recording))
    except (OSError, RunnerError):
        return HTMLResponse("")  # the page itself shows the problem of the recording


@router.get("/distributions")
async def distributions(run: RecordedRun, compute: ComputationOf, axis: AxisOf = EPISODES.name) -> Response:
    """Return the histograms of training, as a part of the run's page."""
    return HTMLResponse(await compute(computed.distributions, run.recording, axis))


@router.get("/pictures")
async def pictures(run: RecordedRun, compute: ComputationOf) -> Response:
    """Show the logged pictures."""
    body = (await compute(computed.pictures, run.recording)).decode()
    return run_page(run, "pictures", "run_body.html", {"body": body})


@router.get("/learned")
async def learned(run: RecordedRun, compute: ComputationOf, state: StateParts = None) -> Response:
    """Show the maps of what was learned, in the situation of a state."""
    body = (await compute(computed.maps, run.recording, tuple(state or ()))).decode()
    return run_page(run, "learned", "run_body.html", {"body": body})


@router.get("/config")
def config(request: Request, run: FoundRun, settings: SettingsOf) -> Response:
    """Show configuration, provenance and log."""
    lines, silence = list[tuple[str, ...]](), "The run logged no texts."
    details = describe_run(run, with_results=False)
    try:
        with open_recording(run.recording) as recording:
            lines = [
                (
                    f"{line['log_time'] // schema.STEP_NANOSECONDS:,}",
                    log_level(line["level"]).lower(),
                    line["message"],
                )
                for line in islice(recording.table(schema.LOG_TOPIC).newest(), MAX_LINES)
            ]
    except RecordingError as error:
        details = replace(details, damage=details.damage or str(error))
        silence = settings.without_folders(f"The log cannot be read: {error}")
    origin = [
        replace(section, facts={name: settings.without_folders(text) for name, text in section.facts.items()})
        for section in details.origin_sections()
    ]
    files = {
        "Download the recording": "recording",
        "For Rerun": "replay.rrd",
        "Report": "report.html",
        **{f"As {name}": f"exports/{name}" for name in plugin_names(EXPORTS)},
    }
    links = [Link(text, f"/api/v1/runs/{run.run_id}/{path}") for text, path in files.items()]
    if viewer_of(request).can_write and "made_by" not in run.file.config:  # a loop cannot be submitted
        links.insert(0, Link("Submit a variation", f"/submit?from={run.run_id}"))
    log = Grid(("step", "level", "message"), lines[::-1], left=("level", "message"))
    sections = [
        Section("", parts=origin, layout="tables"),
        Section("", links=links),
        Section("Log", grids=[log]) if lines else Section("Log", [silence]),
    ]
    return run_page(run, "config", "run_body.html", {"body": partials().answer(sections)})


def _overview(
    request: Request,
    run: Run,
    problem: RunnerError | None = None,
    form: Mapping[str, str] = MappingProxyType({}),
) -> Response:
    """Return the first page of a run; `problem` is why a request was refused, `form` what it sent."""

    def values() -> dict[str, object]:
        settings = request.app.state.settings
        return {
            "status": _status(run, request.app.state.jobs, settings),
            "problem": problem,
            "given": {"name": run.name, "tags": " ".join(run.tags), "note": run.note, **form},
            "max_note": MAX_NOTE,
            "removal": plan(run, settings.recordings[0]) if viewer_of(request).can_write else None,
            "film_endings": {ending: ending[1:].upper() for ending in FORMATS},
        }

    return run_page(run, "", "run_overview.html", values)


def _status(run: Run, jobs: JobQueue, settings: ServiceSettings) -> Status:
    status = run.status
    number, live = _job_of(run, jobs)
    done, results, environment, damage = _recorded(run)
    summary = live or done
    if run.can_train_again:
        results = Summary(last_evaluation=EvaluationMetrics.of(summary.get("last_evaluation") or {}))
    episodes = summary.get("episode", summary.get("episodes"))
    trial_steps = summary.get("eval_steps")
    taken = {
        "Training episodes": humanize.number(episodes, 0),
        "Training steps": humanize.number(summary.get("train_steps"), 0),
    }
    seconds = run.summary.seconds
    time = humanize.UNKNOWN if seconds is None else humanize.duration(seconds)
    if status == "running":
        time = f"{humanize.duration((datetime.now(UTC) - run.created).total_seconds())} so far"
    facts = {"Environment": environment} if environment else {}
    facts |= _results(run, results) | {
        **(taken if has_environment(run.file.config) else {}),
        **({"Evaluation steps": humanize.number(trial_steps, 0)} if trial_steps or live else {}),
        "Time": time,
        **({"Other processes": f"{others}, added at the end"} if (others := shards_in_words(run)) else {}),
        "Recording": humanize.size(summary["bytes"]) if summary.get("bytes") else humanize.UNKNOWN,
    }
    planned, share, progress = run.episodes_to_do, None, ""
    if status == "running" and planned is not None and episodes is not None:
        share = min(1.0, episodes / planned)
        progress = f"{episodes:,} of {planned:,} training episodes"
    error = run.problem or damage or run.summary.error
    stop: Literal["", "possible", "requested"] = ""
    if status == "running" and not run.can_train_again:
        stop = "requested" if run.is_stop_requested else "possible"
    return Status(
        facts=facts,
        share=share,
        progress=progress,
        error=settings.without_folders(error) if error else "",
        job=number,
        is_live=status == "running" or (number is not None and status != "finished"),
        run_id=run.run_id,
        stop=stop,
    )


def _recorded(run: Run) -> tuple[JsonView, Summary, str, str]:
    """Return how far a run is, a loop's last results, what its environment consists of, and its damage."""
    done: JsonView = run.summary
    results, environment = Summary(), ""
    try:
        with open_recording(run.recording) as recording:
            environment = str(composition_of(recording) or "")
            if not run.can_train_again:
                results = loop_summary(recording)
                if run.status == "running":
                    done = {**recording.done(), "bytes": recording.file.size}
            return done, results, environment, damage_of(run, recording)
    except RecordingError as error:
        return done, results, environment, str(error) if run.status == "finished" else ""


def _results(run: Run, results: Summary) -> dict[str, str]:
    """Return the last results of a run by name; of a loop, the known ones."""
    evaluation = results.last_evaluation or EvaluationMetrics()
    if run.can_train_again:
        return dict(result_of(metric, evaluation) for metric in METRICS if not metric.per_agent)
    measures = dict(result_of(metric, evaluation) for metric in METRICS)
    known = {name: text for name, text in measures.items() if humanize.UNKNOWN not in text}
    return known | dict(islice(results_in_words(results).items(), MAX_RESULTS))


def _job_of(run: Run, jobs: JobQueue) -> tuple[int | None, Json]:
    """Return the job that makes a run, or will resume it, and the run's progress in it."""
    for job in jobs.store.jobs():
        if not job.is_over and run.run_id in job.started_runs.values():
            progress = job.progress if job.state == "running" else None
            is_at_run = isinstance(progress, RunProgress) and progress.run_id == run.run_id
            return job.number, vars(progress) if is_at_run else {}
    return None, {}
