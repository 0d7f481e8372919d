"""Episodes as the pages replay them: actions, rewards, and what was observed at each step."""

from __future__ import annotations

from http import HTTPStatus
from typing import TYPE_CHECKING, Annotated, Any, Final

from fastapi import APIRouter, Path, Query, Response
from pydantic import BaseModel

from runner.export.reports.player_data import Playback
from runner.service import fragments
from runner.service.dependencies import CacheOf, ProcessesOf, RecordedRun, recording_state
from runner.service.problems import error_docs

if TYPE_CHECKING:
    from runner.runs.run import Run

router = APIRouter(
    prefix="/runs/{run}/replay",
    tags=["reading"],
    responses=error_docs(
        HTTPStatus.BAD_REQUEST,
        HTTPStatus.NOT_FOUND,
        HTTPStatus.CONFLICT,
        HTTPStatus.SERVICE_UNAVAILABLE,
        HTTPStatus.NOT_IMPLEMENTED,
    ),
)

STEPS: Final = 500
"""Steps in a response by default."""
MAX_STEPS: Final = 2000
LONG: Final = 3600.0
"""Seconds that a part is cached, unless the recording changes."""

Number = Annotated[int, Path(ge=0, lt=2**62, description="Counted from 0.")]
After = Annotated[
    int, Path(ge=0, lt=2**62, description="The evaluation after this number of training episodes.")
]
Start = Annotated[int, Query(ge=0, lt=2**62, description="The first step, from 0.")]
Steps = Annotated[int, Query(ge=1, le=MAX_STEPS, description="Maximum number of steps.")]


class Part(BaseModel):
    """A part of an episode, and the scene of its environment if it has one."""

    episode: Playback
    scene: dict[str, Any] | None


@router.get("/train/{episode}", response_model=Part, summary="A part of a training episode, to be replayed.")
async def training(
    run: RecordedRun,
    cache: CacheOf,
    processes: ProcessesOf,
    episode: Number,
    start: Start = 0,
    steps: Steps = STEPS,
) -> Response:
    """Return steps of a training episode: actions, rewards, and states or observations at each frame."""
    return _json(await part_of(run, cache, processes, (episode,), start, steps))


@router.get("/eval/{after}/{trial}", response_model=Part, summary="A part of a trial, to be replayed.")
async def trial(
    run: RecordedRun,
    cache: CacheOf,
    processes: ProcessesOf,
    after: After,
    trial: Number,
    start: Start = 0,
    steps: Steps = STEPS,
) -> Response:
    """Return steps of a trial of an evaluation, in the same form."""
    return _json(await part_of(run, cache, processes, (after, trial), start, steps))


async def part_of(
    run: Run, cache: CacheOf, processes: ProcessesOf, which: tuple[int, ...], start: int, steps: int = STEPS
) -> bytes:
    """Return a part of an episode as JSON.

    Args:
        run: the run.
        cache: the cached responses.
        processes: the pool that does the work.
        which: (episode,) of training, or (training episodes before, trial) of an evaluation.
        start: the first step.
        steps: the largest number of steps.

    Raises:
        RecordingError: there is no such episode or step.
    """
    key = ("replay part", recording_state(run), which, start, steps)
    return await cache.get_or_await(
        key, lambda: processes(fragments.episode_part, run.recording, which, start, steps), LONG
    )


def _json(body: bytes) -> Response:
    return Response(body, media_type="application/json")
