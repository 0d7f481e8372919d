"""Episodes as the pages replay them: actions, rewards, and what was observed at each step."""

from __future__ import annotations

import contextlib
from collections.abc import Awaitable, Callable, Hashable
from functools import partial
from typing import Annotated, Final, NamedTuple

from fastapi import APIRouter, Depends, Query, Response
from fastapi.responses import StreamingResponse
from pydantic import BaseModel
from starlette.concurrency import run_in_threadpool

from runner.analysis.episodes import EpisodeRef
from runner.errors import RunnerError
from runner.export.encoded import encoded_pictures
from runner.export.reports.player_data import Playback
from runner.recording.reader import open_recording
from runner.runs.run import Run
from runner.service import fragments
from runner.service.dependencies import EPISODES, ComputationOf, PicturesOf, RecordedRun, recording_state
from runner.service.pictures import Make, PictureStreams
from runner.service.problems import BUSY_ERRORS, RUN_ERRORS, media_docs

router = APIRouter(
    prefix="/runs/{run}/replay",
    tags=["reading"],
    responses=RUN_ERRORS | BUSY_ERRORS,
)

STEPS: Final = 500
"""Steps in a response by default."""
MAX_STEPS: Final = 2000
OCTETS: Final = "application/octet-stream"
PICTURES: Final = 64
"""Pictures in a response by default."""

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


def _add_routes(path: str, episode: Callable[..., Awaitable[EpisodeRef]], kind: str) -> None:
    @router.get(path, name=kind, response_model=Part, summary=f"A part of a {kind}, to be replayed.")
    async def part(
        run: RecordedRun,
        compute: ComputationOf,
        at: EpisodeRef = Depends(episode),  # noqa: B008 - as FastAPI reads it
        start: Start = 0,
        steps: Steps = STEPS,
    ) -> Response:
        """Return steps of an episode: actions, rewards, and states or observations at each frame."""
        return await compute.json(fragments.episode_part, run.recording, at, start, steps)

    @router.get(
        f"{path}/pictures",
        name=f"{kind} pictures",
        response_class=Response,
        responses=media_docs(OCTETS),
        summary=f"The pictures of a {kind}.",
    )
    async def pictures(
        run: RecordedRun,
        streams: PicturesOf,
        at: EpisodeRef = Depends(episode),  # noqa: B008
        start: Start = 0,
        steps: Pictures = PICTURES,
    ) -> Response:
        """Return the pictures from a step on: recorded frames, or drawn by the environment, made again.

        Each is preceded by its length in bytes, 32 bits, big-endian; length 0 stands for the same as before.
        The length 2^32 - 1 is followed by the reason, as text, why there are no further pictures; 2^32 - 2 by
        the length and the text of a note on the pictures.
        """
        pictured = await run_in_threadpool(_pictured_episode, run, at)
        stop = min(start + steps, pictured.length + 1)
        stream = streams.open(pictured.key, pictured.make, start)
        return StreamingResponse(streams.send(stream, start, stop), media_type=OCTETS)


for (_path, _episode), _kind in zip(EPISODES.items(), ("training episode", "trial"), strict=True):
    _add_routes(_path, _episode, _kind)


async def prepare_pictures(run: Run, streams: PictureStreams, at: EpisodeRef) -> None:
    """Begin to make the pictures of an episode, whose page will request them soon."""
    with contextlib.suppress(RunnerError, OSError):  # its page shows the reason
        episode = await run_in_threadpool(_pictured_episode, run, at)
        if at.t <= episode.length:
            streams.prepare(episode.key, episode.make, at.t)


class _PicturedEpisode(NamedTuple):
    key: Hashable
    make: Make
    length: int
    """Steps of the episode."""


def _pictured_episode(run: Run, at: EpisodeRef) -> _PicturedEpisode:
    with open_recording(run.recording) as recording:
        number = at.number_in(recording)
        length = len(recording.phase(at.phase).episode(number))
    make = partial(encoded_pictures, run.recording, at.phase, number)
    return _PicturedEpisode((recording_state(run), at.phase, number), make, length)
