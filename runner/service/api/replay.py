"""Episodes as a page plays them: where everything stands at each step, in words and in places."""

from __future__ import annotations

from http import HTTPStatus
from typing import TYPE_CHECKING, Annotated, Any

from fastapi import APIRouter, Path, Query, Response
from pydantic import BaseModel

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

STEPS = 500
"""Steps in an answer unless asked otherwise."""
MOST_STEPS = 2000
LONG = 3600.0
"""Seconds that a part is kept, unless the recording changes."""

Number = Annotated[int, Path(ge=0, lt=2**62, description="Counted from 0.")]
After = Annotated[int, Path(ge=0, lt=2**62, description="The evaluation after so many training episodes.")]
Start = Annotated[int, Query(ge=0, lt=2**62, description="The first step, from 0.")]
Steps = Annotated[int, Query(ge=1, le=MOST_STEPS, description="At most so many steps.")]


class PlayedEpisode(BaseModel, extra="allow"):
    """A part of an episode; frame k is the state after k steps."""

    title: str
    description: str
    length: int
    """Steps of the whole episode."""
    first: int
    """The step with which this part begins."""
    before: list[float]
    """What each learner's rewards before it sum to; nothing at the beginning."""
    states: list[str]
    """In words, each once."""
    places: list[list[int]]
    """Of each state: x, y (hundredths of a cell) and size (percent) of each thing of the scene."""
    state: list[int]
    """Which of the states each frame is."""
    action: list[int]
    reward: list[list[float]]
    event: list[int]
    """Bit i: the i-th of the events."""
    explored: list[int]
    values: list[dict[str, Any]]
    """For each learner the highest Q-values at each frame, and that of the action taken."""


class Part(BaseModel):
    """A part of an episode, and the words for what is in it."""

    actions: list[str]
    choices: list[list[str]]
    learners: list[str]
    events: list[str]
    trail: int
    scene: dict[str, Any] | None
    episode: PlayedEpisode


@router.get("/train/{episode}", response_model=Part, summary="A part of a training episode, to be played.")
async def training(
    run: RecordedRun,
    cache: CacheOf,
    processes: ProcessesOf,
    episode: Number,
    start: Start = 0,
    steps: Steps = STEPS,
) -> Response:
    """Return steps of a training episode with the states, places, rewards, events and Q-values at each."""
    return _json(await part_of(run, cache, processes, (episode,), start, steps))


@router.get("/eval/{after}/{trial}", response_model=Part, summary="A part of a trial, to be played.")
async def trial(
    run: RecordedRun,
    cache: CacheOf,
    processes: ProcessesOf,
    after: After,
    trial: Number,
    start: Start = 0,
    steps: Steps = STEPS,
) -> Response:
    """Return steps of a trial of an evaluation, as those of training."""
    return _json(await part_of(run, cache, processes, (after, trial), start, steps))


async def part_of(
    run: Run, cache: CacheOf, processes: ProcessesOf, which: tuple[int, ...], start: int, steps: int = STEPS
) -> bytes:
    """Return a part of an episode as JSON.

    Args:
        run: whose, its recording at hand.
        cache: the cached responses.
        processes: the pool that does the work.
        which: (episode,) of training, or (training episodes before, trial) of an evaluation.
        start: the first step.
        steps: at most so many.

    Raises:
        RecordingError: there is no such episode or step.
    """
    key = ("replay part", recording_state(run), which, start, steps)
    return await cache.get_or_await(
        key, lambda: processes(fragments.episode_part, run.recording, which, start, steps), LONG
    )


def _json(body: bytes) -> Response:
    return Response(body, media_type="application/json")
