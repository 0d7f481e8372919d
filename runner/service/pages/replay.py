"""The replay of a run in its page: any step of any episode, and where other actions lead from there."""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, replace
from http import HTTPStatus
from itertools import islice
from typing import Annotated, Any, Final

from fastapi import APIRouter, Depends, Query, Response
from fastapi.responses import RedirectResponse
from pydantic import Field
from starlette.concurrency import run_in_threadpool

from runner.analysis.episodes import TYPICAL, EpisodeRef, mark, reference_to, unmark
from runner.analysis.evaluations import evaluations_of
from runner.analysis.sections import Link
from runner.drawing import svg
from runner.errors import RunnerError
from runner.export.pictures import picture_note
from runner.recording.reader import Recording, open_recording
from runner.recording.steps import EpisodeSteps
from runner.runs.branches import BranchOrigin, Origin, origin_in
from runner.runs.run import Run
from runner.service import computed
from runner.service.api.replay import STEPS, StepPath
from runner.service.catalogue import Catalogue
from runner.service.computed import link
from runner.service.dependencies import (
    EPISODES,
    At,
    CatalogueOf,
    Computation,
    ComputationOf,
    RecordedRun,
    WrittenRun,
)
from runner.service.pages.rendering import Form, Page, run_page
from runner.service.problems import status_of
from runner.util.humanize import counted
from runner.util.values import JsonView

router = APIRouter(prefix="/runs/{run}", include_in_schema=False)

MAX_BRANCHES: Final = 20
"""Branches of a run that a page lists, the newest."""
BEFORE: Final = 250
"""Steps before the requested one in the part that a page shows first, as in `player.js`."""

T = Annotated[int, Query(ge=0, lt=2**62)]
Action = Annotated[str, Field(max_length=200)]


@dataclass(frozen=True)
class ReplayPanel:
    """One of several replays on a page, which one slider moves."""

    label: str
    number: int | None
    """Number of its colour, if it has one."""
    source: str
    """Address of the episode's data; that of its pictures is below it."""
    scene: str
    """The grid, as SVG, whose things the script moves; empty without a scene."""
    has_pictures: bool = False
    """Whether pictures are fetched."""
    note: str = ""
    """Why there is no picture, or no better one."""
    offset: int = 0
    """The common step at which the episode begins."""
    address: str = ""
    """Address of the page of its replay alone."""
    episode: str = ""
    """Path of the episode below the run's replays, where another one may follow it."""


@dataclass(frozen=True)
class ReplayStage:
    """What a page shows of an episode before its script fills in the step."""

    title: str
    description: str
    length: int
    """Steps of the episode."""
    t: int
    """The step that the script shows first."""
    scene: str
    """The grid, as SVG, whose things the script moves; empty without a scene."""
    key: str
    broad: bool
    note: str
    """Why there is no picture, or no better one."""
    has_pictures: bool
    """Whether pictures are fetched."""


@router.get("/replay")
async def chosen_replay(
    run: RecordedRun,
    compute: ComputationOf,
    catalogue: CatalogueOf,
    episode: str | None = None,
    after: str = "",
    trial: str = "",
    at: At = "",
) -> Response:
    """Redirect to the step `at`, to the episode or trial that a form names, or to a typical one."""
    reference = at or TYPICAL
    if after:
        reference = f"eval:{after}:{trial or 0}"
    elif episode is not None:
        reference = episode or "0"
    try:
        step = await step_of(run, compute, reference)
    except RunnerError as error:
        return _page(run, catalogue, EpisodeRef(), error)
    address = link(f"/runs/{run.run_id}/replay/{step.episode_path}", {"t": step.t or ""})
    return RedirectResponse(address, HTTPStatus.FOUND)


async def step_of(run: Run, compute: Computation, text: str) -> EpisodeRef:
    """Return the step of a run that an address names, with an episode in place of a word.

    Raises:
        RunnerError: the text is no reference, or the run has no episode for the word.
    """
    step = EpisodeRef.parse(text)
    return await compute.shown(EpisodeRef, computed.resolved_step, run.recording, step) if step.word else step


@router.get("/replay/thumbnail")
async def thumbnail(run: RecordedRun, compute: ComputationOf, at: At = TYPICAL) -> Response:
    """Return a small picture of an episode, which takes no environment."""
    picture = await compute(computed.episode_thumbnail, run.recording, EpisodeRef.parse(at))
    return Response(picture, media_type="image/svg+xml")


@router.get("/replay/latest")
async def latest(
    run: RecordedRun,
    compute: ComputationOf,
    shown: Annotated[str, Query(max_length=40)] = "",
) -> Response:
    """Return the replay of the latest whole training episode as a part of a page.

    204 if there is none after the one `shown`; with a header if there will be none, as the run is over.
    """
    path = (await compute(computed.latest_episode, run.recording)).decode()
    if path in ("", shown):
        over = {} if run.status == "running" else {"X-Run-Over": "true"}
        return Response(status_code=HTTPStatus.NO_CONTENT, headers=over)

    def show() -> dict[str, object]:
        address = f"/runs/{run.run_id}/replay/{path}"
        label = f"{run.title}: training episode {int(path.partition('/')[2]):,}"
        with open_recording(run.recording) as recording:
            panel = panel_of(
                recording, "train", f"/api/v1{address}", label, None, address=address, episode=path
            )
        return {"panel": panel}

    return Page("latest.html", show)


async def _replay(
    run: Run,
    compute: Computation,
    catalogue: Catalogue,
    at: EpisodeRef,
    refused: RunnerError | None = None,
    form: Mapping[str, str] = {},
) -> Response:
    """Return the page of a step of an episode; see `_page`."""
    part: bytes | RunnerError
    start = max(0, at.t - BEFORE)
    step = at if start else replace(at, t=0)  # one part, cached once, for all of the first steps
    try:
        part = await compute(computed.episode_part, run.recording, step, start, STEPS)
    except RunnerError as error:
        part = error
    return _page(run, catalogue, at, part, refused, form)


def _page(
    run: Run,
    catalogue: Catalogue,
    at: EpisodeRef,
    part: bytes | RunnerError,
    refused: RunnerError | None = None,
    form: Mapping[str, str] = {},
) -> Response:
    """Return the page of a step of an episode.

    Args:
        part: the part of the episode around the step, or why there is none.
        refused: why the step was not marked.
        form: what was sent then.
    """

    def show() -> dict[str, object]:
        stage, problem = (
            (None, part) if isinstance(part, RunnerError) else (stage_of(json.loads(part), at.t), "")
        )
        with open_recording(run.recording) as recording:
            shown = _values(recording, run, replace(at, t=0), catalogue)
        return shown | {"stage": stage, "problem": problem, "refused": str(refused or ""), "given": form}

    wrong = refused or part
    status = status_of(wrong) if isinstance(wrong, RunnerError) else None
    return run_page(run, "replay", "run_replay.html", show, status)


def _add_route(path: str, episode: Callable[..., Awaitable[EpisodeRef]]) -> None:
    @router.get(f"/replay{path}")
    async def replay(
        run: RecordedRun,
        compute: ComputationOf,
        catalogue: CatalogueOf,
        at: EpisodeRef = Depends(episode),  # noqa: B008 - as FastAPI reads it
        t: T = 0,
    ) -> Response:
        """Show a step of an episode."""
        return await _replay(run, compute, catalogue, replace(at, t=t))

    @router.get(f"/replay{path}/environments")
    def environments(
        run: RecordedRun,
        at: EpisodeRef = Depends(episode),  # noqa: B008
        t: T = 0,
    ) -> Response:
        """Show all environments of a vector during an episode of one of them."""
        return run_page(run, "replay", "run_environments.html", _environments(run, replace(at, t=t)))


for _path, _episode in EPISODES.items():
    _add_route(_path, _episode)


@router.post("/replay/mark")
async def mark_step(run: WrittenRun, form: Form, compute: ComputationOf, catalogue: CatalogueOf) -> Response:
    """Mark the step of a replay, or remove a mark, and show the replay again."""
    step = EpisodeRef.parse(form.get("at", ""))
    try:
        if removed := form.get("remove"):
            await run_in_threadpool(unmark, run, removed)
        else:
            tags = form.get("tags", "").split()
            await run_in_threadpool(mark, run, step, form.get("text", ""), tags=tags)
    except RunnerError as error:
        return await _replay(run, compute, catalogue, step, error, form)
    address = link(f"/runs/{run.run_id}/replay/{step.episode_path}", {"t": step.t or ""})
    return RedirectResponse(f"{address}#marks", HTTPStatus.SEE_OTHER)


@router.get("/what-if/{at}")
@router.get("/what-if/{at}/{action}")
async def what_if(
    run: RecordedRun,
    compute: ComputationOf,
    at: StepPath,
    action: Action | None = None,
    t: T | None = None,
) -> Response:
    """Show where each joint action leads, and the replay of one: the recorded one unless it is named."""
    step = await step_of(run, compute, at)
    shown_t = step.t if t is None else t
    start = max(0, shown_t - BEFORE)
    found = json.loads(await compute(computed.what_if_page, run.recording, step, action, start, STEPS))
    return run_page(
        run,
        "replay",
        "run_what_if.html",
        lambda: {"step": step, "found": found, "stage": stage_of(found, shown_t)},
    )


def _values(recording: Recording, run: Run, at: EpisodeRef, catalogue: Catalogue) -> dict[str, object]:
    """Return the values of the page of an episode but its stage."""
    episodes, is_job = recording.train.known_episodes(), recording.can_train_again
    evaluations = {evaluation.after: evaluation.trials for evaluation in evaluations_of(recording)}
    count = episodes if at.after is None else evaluations.get(at.after, 0)
    base = f"/runs/{run.run_id}"

    def neighbour(other: int) -> str:
        path = replace(at, episode=other).episode_path
        return f"{base}/replay/{path}" if 0 <= other < max(count, at.episode) else ""

    return {
        "at": at,
        "episodes": episodes,
        "evaluations": {after: counted(after, "episode") for after in evaluations},
        "before": neighbour(at.episode - 1),
        "after": neighbour(at.episode + 1),
        "source": f"/api/v1{base}/replay/{at.episode_path}",
        "environments": recording.environments,
        "what_if": f"{base}/what-if/{at.episode_text}" if is_job else "",
        "branch": "" if is_job and at.after is not None else f"{base}/branch?at={at.episode_text}",
        "branches": _branches(recording, run, catalogue),
        "marks": [mark for mark in run.marks if EpisodeRef.parse(mark.at).episode_path == at.episode_path],
    }


def _branches(recording: Recording, run: Run, catalogue: Catalogue) -> list[Link]:
    """Return links to the comparisons of a run with its parent, if it is a branch, and with its branches."""

    def comparison(parent: str, branch: str, origin: Origin) -> str:
        at = origin.at if isinstance(origin, BranchOrigin) else str(reference_to(recording, origin.step))
        return link("/compare/replay", {"run": [parent, branch], "at": at})

    origin = origin_in(run.file.config)
    links = []
    if origin is not None:
        links.append(Link(f"Branch of {origin.run} {origin}", comparison(origin.run, run.run_id, origin)))
    branches = catalogue.read(lambda index: index.branches(run.run_id))
    for name, branched in islice(branches.items(), MAX_BRANCHES):
        links.append(Link(f"Branch {name} {branched}", comparison(run.run_id, name, branched)))
    return links


def stage_of(part: JsonView, t: int) -> ReplayStage:
    """Return the stage of a part of an episode, see `computed.episode_part`."""
    episode = part["episode"]
    at = min(t, episode["length"])
    drawing = svg.SvgDrawing(part["scene"]) if episode["grid"] else None
    return ReplayStage(
        title=episode["title"],
        description=episode["description"],
        length=episode["length"],
        t=at,
        scene=drawing.frame(None, f"The grid after {at} steps", style="") if drawing else "",
        key=drawing.key() if drawing else "",
        broad=drawing is not None and drawing.width > svg.BROAD,
        note="" if drawing else part["picture_note"],
        has_pictures=part["has_pictures"] and not drawing,
    )


def panel_of(
    recording: Recording, phase: str, source: str, label: str, number: int | None = None, **more: Any
) -> ReplayPanel:
    """Return the replay of an episode of a phase, whose data has the address `source`."""
    drawing = svg.drawing_of(recording.mdp) if recording.tabular else None
    has_pictures, note = picture_note(recording, phase)
    scene = "" if drawing is None else drawing.frame(None, f"The grid of {label}", style="")
    return ReplayPanel(label, number, source, scene, has_pictures, note, **more)


MAX_PANELS: Final = 8
"""Environments of a vector that a page shows side by side."""


def _environments(run: Run, at: EpisodeRef) -> dict[str, object]:
    """Return the values of the page: an episode, and the other environments' episodes at its first step."""
    base = f"/runs/{run.run_id}/replay"
    with open_recording(run.recording) as recording:
        shown_number = at.number_in(recording)
        steps = recording.phase(at.phase).episode(shown_number)
        turns = steps.table.round_of(steps.first)
        # The first trial of the evaluation, within which trials are numbered.
        first = shown_number - at.episode
        panels = []
        for environment, number in _episodes_at(recording, at.phase, steps, shown_number)[:MAX_PANELS]:
            begun = steps.table.round_of(recording.phase(at.phase).episode(number).first)
            path = replace(at, episode=number - first, t=0).episode_path
            name = "trial" if at.after is not None else "episode"
            panel = panel_of(
                recording,
                at.phase,
                f"/api/v1{base}/{path}",
                f"Environment {environment}: {name} {number - first:,}",
                offset=(begun.start - turns.start) // len(turns),
                address=f"{base}/{path}",
            )
            panels.append(panel)
        return {
            "title": at.heading,
            "alone": f"{base}/{at.episode_path}",  # the replay of the episode alone
            "shown": panels,
            "length": len(steps),
            "t": min(at.t, len(steps)),
            "left_out": max(0, recording.environments - len(panels)),
        }


def _episodes_at(
    recording: Recording, phase: str, steps: EpisodeSteps, episode: int
) -> list[tuple[int, int]]:
    """Return each environment and the number of its episode at the first step of another one, if it ended."""
    episodes, begin = recording.phase(phase).episodes, steps.table.round_of(steps.first).start
    by_environment = {steps.environment: episode}
    if not steps.table.have_turns:
        return list(by_environment.items())
    names = ("environment", "episode", "last_step")
    for block in episodes.blocks(episodes.first_from("last_step", begin)):
        for environment, number, last in zip(*(block[name].tolist() for name in names), strict=True):
            if last >= begin:
                by_environment.setdefault(environment, number)
        if len(by_environment) == recording.environments:
            break
    return sorted(by_environment.items())
