"""Episodes as the pages replay them: actions, rewards, and what was observed at each step."""

from __future__ import annotations

import contextlib
from collections.abc import Hashable
from functools import partial
from http import HTTPStatus
from typing import Annotated, Final, NamedTuple

from fastapi import APIRouter, Path, Query, Response
from fastapi.responses import StreamingResponse
from pydantic import BaseModel
from starlette.concurrency import run_in_threadpool

from runner.errors import RunnerError
from runner.export.encoded import encoded_pictures
from runner.export.episodes import place_of
from runner.export.reports.player_data import Playback
from runner.recording.reader import open_recording
from runner.runs.run import Run
from runner.service import fragments
from runner.service.dependencies import PicturesOf, RecordedRun, RunComputationOf, recording_state
from runner.service.pictures import Make, PictureStreams
from runner.service.problems import error_docs, media_docs

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
OCTETS: Final = "application/octet-stream"
PICTURES: Final = 64
"""Pictures in a response by default."""

Number = Annotated[int, Path(ge=0, lt=2**62, description="Counted from 0.")]
After = Annotated[
    int, Path(ge=0, lt=2**62, description="The evaluation after this number of training episodes.")
]
Start = Annotated[int, Query(ge=0, lt=2**62, description="The first step, from 0.")]
Steps = Annotated[int, Query(ge=1, le=MAX_STEPS, description="Maximum number of steps.")]


Pictures = Annotated[int, Query(ge=1, le=1000, description="Maximum number of pictures.")]


class Part(BaseModel):
    """A part of an episode, and the scene of its environment if it has one."""

    episode: Playback
    scene: dict[str, object] | None
    has_pictures: bool
    """Whether `/pictures` has some; of a scene the page draws them itself."""
    picture_note: str
    """Why there are none, or no better ones; may be empty."""


@router.get("/train/{episode}", response_model=Part, summary="A part of a training episode, to be replayed.")
async def training(
    compute: RunComputationOf, episode: Number, start: Start = 0, steps: Steps = STEPS
) -> Response:
    """Return steps of a training episode: actions, rewards, and states or observations at each frame."""
    return await compute.json(fragments.episode_part, (episode,), start, steps)


@router.get("/eval/{after}/{trial}", response_model=Part, summary="A part of a trial, to be replayed.")
async def trial(
    compute: RunComputationOf, after: After, trial: Number, start: Start = 0, steps: Steps = STEPS
) -> Response:
    """Return steps of a trial of an evaluation, in the same form."""
    return await compute.json(fragments.episode_part, (after, trial), start, steps)


@router.get(
    "/train/{episode}/pictures",
    response_class=Response,
    responses=media_docs(OCTETS),
    summary="The pictures of a training episode.",
)
async def training_pictures(
    run: RecordedRun, streams: PicturesOf, episode: Number, start: Start = 0, steps: Pictures = PICTURES
) -> Response:
    """Return the pictures from a step on: frames that were recorded, or drawn by the environment made again.

    Each is preceded by its length in bytes, 32 bits, big-endian; length 0 stands for the same as before. The
    length 2^32 - 1 is followed by the reason, as text, why there are no further pictures; 2^32 - 2 by the
    length and the text of a note on the pictures.
    """
    return await _pictures(run, streams, (episode,), start, steps)


@router.get(
    "/eval/{after}/{trial}/pictures",
    response_class=Response,
    responses=media_docs(OCTETS),
    summary="The pictures of a trial.",
)
async def trial_pictures(
    run: RecordedRun,
    streams: PicturesOf,
    after: After,
    trial: Number,
    start: Start = 0,
    steps: Pictures = PICTURES,
) -> Response:
    """Return the pictures of a trial of an evaluation, in the same form."""
    return await _pictures(run, streams, (after, trial), start, steps)


async def _pictures(
    run: Run, streams: PictureStreams, which: tuple[int, ...], start: int, steps: int
) -> Response:
    episode = await run_in_threadpool(_pictured_episode, run, which)
    stop = min(start + steps, episode.length + 1)
    stream = streams.open(episode.key, episode.make, start)
    return StreamingResponse(streams.send(stream, start, stop), media_type=OCTETS)


async def prepare_pictures(run: Run, streams: PictureStreams, which: tuple[int, ...], start: int) -> None:
    """Begin to make the pictures of an episode, whose page will request them soon."""
    with contextlib.suppress(RunnerError, OSError):  # its page shows the reason
        episode = await run_in_threadpool(_pictured_episode, run, which)
        if start <= episode.length:
            streams.prepare(episode.key, episode.make, start)


class _PicturedEpisode(NamedTuple):
    key: Hashable
    make: Make
    length: int
    """Steps of the episode."""


def _pictured_episode(run: Run, which: tuple[int, ...]) -> _PicturedEpisode:
    with open_recording(run.recording) as recording:
        place = place_of(recording, which)
        length = len(recording.episode_span(place.phase, place.number))
    make = partial(encoded_pictures, run.recording, place.phase, place.number)
    return _PicturedEpisode((recording_state(run), place.phase, place.number), make, length)
