"""Episodes as the pages replay them, and where other actions lead."""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable
from dataclasses import fields
from functools import partial
from http import HTTPStatus
from typing import Annotated, Any, Final, get_type_hints

from fastapi import APIRouter, Depends, Path, Query, Request, Response
from pydantic import BaseModel, create_model
from starlette.concurrency import run_in_threadpool

from runner.analysis.episodes import EXPECTED, EpisodeRef
from runner.debugging.what_if import WhatIf
from runner.debugging.what_if import what_if as outcomes_of
from runner.export.pictures import encoded_pictures
from runner.export.reports.playback import Playback
from runner.recording.reader import open_recording
from runner.runs.run import Run
from runner.service import computed
from runner.service.api.files import OCTETS, IfNoneMatch, is_known, tag_of
from runner.service.dependencies import (
    EPISODES,
    CacheOf,
    ComputationOf,
    PicturesOf,
    RecordedRun,
    recording_state,
)
from runner.service.pictures import Block
from runner.service.problems import media_docs
from runner.util import __version__

router = APIRouter(
    prefix="/runs/{run}",
    tags=["reading"],
)

STEPS: Final = 500
"""Steps in a response by default."""
MAX_STEPS: Final = 2000
PICTURES: Final = 64
"""Pictures in a response by default."""

Start = Annotated[int, Query(ge=0, lt=2**62, description="The first step, from 0.")]
Steps = Annotated[int, Query(ge=1, le=MAX_STEPS, description="Maximum number of steps.")]
Pictures = Annotated[int, Query(ge=1, le=1000, description="Maximum number of pictures.")]


class ReplayPart(BaseModel):
    """A part of an episode, and the scene of its environment if it has one."""

    episode: Playback
    scene: dict[str, object] | None
    has_pictures: bool
    """Whether `/pictures` has some; of a scene the page draws them itself."""
    picture_note: str
    """Why there are none, or no better ones; may be empty."""


def _add_routes(path: str, episode: Callable[..., Awaitable[EpisodeRef]], kind: str) -> None:
    @router.get(
        f"/replay{path}", name=kind, response_model=ReplayPart, summary=f"A part of a {kind}, to be replayed."
    )
    async def part(
        run: RecordedRun,
        compute: ComputationOf,
        at: EpisodeRef = Depends(episode),  # noqa: B008 - as FastAPI reads it
        start: Start = 0,
        steps: Steps = STEPS,
    ) -> Response:
        """Return steps of an episode: actions, rewards, and states or observations at each frame."""
        return await compute.json(computed.episode_part, run.recording, at, start, steps)

    @router.get(
        f"/replay{path}/pictures",
        name=f"{kind} pictures",
        response_class=Response,
        responses=media_docs(OCTETS),
        summary=f"The pictures of a {kind}.",
    )
    async def pictures(
        request: Request,
        run: RecordedRun,
        streams: PicturesOf,
        cache: CacheOf,
        at: EpisodeRef = Depends(episode),  # noqa: B008
        start: Start = 0,
        steps: Pictures = PICTURES,
        if_none_match: IfNoneMatch = None,
    ) -> Response:
        """Return a block of pictures: recorded frames, or drawn by the environment, made again.

        The length of the head (32 bits, big-endian) is followed by the head, JSON, and by the pictures. In
        the head `sizes` has the bytes of each picture, and `shown` the number of the picture at each step
        from `start` on; `last` is the last step of the episode, `note` a sentence on all pictures, `problem`
        the reason why there are no further ones. A block may have fewer pictures than were asked for, if they
        take long to make. One that has them all has an ETag.
        """
        number, length = await run_in_threadpool(_number_and_length, run, at)
        stop = min(start + steps, length + 1)
        tag = f"{tag_of(run)}-{at.phase}-{number}-{__version__}-{start}-{stop}"
        if is_known(tag, if_none_match):
            return Response(status_code=HTTPStatus.NOT_MODIFIED, headers={"etag": f'"{tag}"'})
        if (body := cache.get(tag)) is None:
            key = recording_state(run), at.phase, number
            make = partial(encoded_pictures, run.recording, at.phase, number)
            block = await streams.block(key, make, start, stop, request.is_disconnected)
            body = _encoded(block, length)
            if len(block.shown) < stop - start or block.note:
                return Response(body, media_type=OCTETS)
            cache.keep(tag, body)
        return Response(body, media_type=OCTETS, headers={"etag": f'"{tag}"'})


for (_path, _episode), _kind in zip(EPISODES.items(), ("training episode", "trial"), strict=True):
    _add_routes(_path, _episode, _kind)


def _encoded(block: Block, last: int) -> bytes:
    """Return a block as a page takes it."""
    head = {"sizes": list(map(len, block.pictures)), "shown": block.shown, "last": last}
    encoded = json.dumps(head | {"note": block.note, "problem": block.problem}).encode()
    return b"".join([len(encoded).to_bytes(4, "big"), encoded, *block.pictures])


def _number_and_length(run: Run, at: EpisodeRef) -> tuple[int, int]:
    """Return the number of an episode in its phase, and its length."""
    with open_recording(run.recording) as recording:
        number = at.number_in(recording)
        return number, len(recording.phase(at.phase).episode(number))


MAX_ACTIONS: Final = 1000
StepPath = Annotated[str, Path(max_length=60, description=EXPECTED, examples=["eval:3000:17:5"])]
ActionPath = Annotated[str, Path(max_length=200, description="A joint action: its number or its name.")]


_KINDS = get_type_hints(WhatIf)
_FIELDS: Any = {field.name: (_KINDS[field.name], ...) for field in fields(WhatIf) if field.name != "mdp"}
WhatIfAnswer = create_model("WhatIfAnswer", __doc__=WhatIf.__doc__, **_FIELDS)


@router.get("/what-if/{at}", response_model=WhatIfAnswer, summary="Where each joint action at a step leads.")
async def what_if(
    run: RecordedRun,
    compute: ComputationOf,
    at: StepPath,
    action: Annotated[
        list[str] | None, Query(max_length=MAX_ACTIONS, description="Numbers or names; default: all.")
    ] = None,
) -> Response:
    """Return what `dualtaxi branch --action all --json` prints; of a run that was trained here."""
    return await compute.json(
        computed.answer,
        run.recording,
        outcomes_of,
        "json",
        (("at", at), ("actions", tuple(action or ()))),
    )


@router.get(
    "/what-if/{at}/{action}",
    response_model=ReplayPart,
    summary="A part of the episode to which an action leads.",
)
async def branch(
    run: RecordedRun,
    compute: ComputationOf,
    at: StepPath,
    action: ActionPath,
    start: Start = 0,
    steps: Steps = STEPS,
) -> Response:
    """Return steps in the form of a replay: those recorded up to the step, then those played."""
    return await compute.json(computed.branch_part, run.recording, at, action, start, steps)
