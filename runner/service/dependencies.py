"""Dependencies of routes: the parts of the service, and the run that a path names."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from functools import partial
from http import HTTPStatus
from pathlib import Path
from typing import Annotated, Final, TypeVar

from fastapi import Depends, Query, Request, Response
from fastapi import Path as InPath
from pydantic import TypeAdapter
from starlette.requests import ClientDisconnect

from runner.analysis.episodes import EpisodeRef
from runner.archive.places import at_hand
from runner.errors import RecordingError
from runner.recording.labels import LABELS_FILE
from runner.recording.marks import MARKS_FILE
from runner.recording.reader import Recording, open_recording
from runner.runs.run import Run
from runner.service.catalogue import Catalogue
from runner.service.errors import Refused
from runner.service.jobs.queue import JobQueue
from runner.service.pictures import PictureStreams
from runner.service.processes import ProcessPool
from runner.service.response_cache import ResponseCache
from runner.service.settings import ServiceSettings
from runner.service.uploads import Uploads

Shown = TypeVar("Shown")


def _state(name: str) -> object:
    """Return the dependency on a part of the service, as `app.state` has it.

    Dependencies that only look something up are `async`: FastAPI calls others in threads, and waits for one.
    """

    async def get(request: Request) -> object:
        return getattr(request.app.state, name)

    return Depends(get)


SettingsOf = Annotated[ServiceSettings, _state("settings")]
CatalogueOf = Annotated[Catalogue, _state("catalogue")]
ProcessesOf = Annotated[ProcessPool, _state("processes")]
SweepProcesses = Annotated[ProcessPool, _state("sweep_processes")]
PicturesOf = Annotated[PictureStreams, _state("pictures")]
CacheOf = Annotated[ResponseCache, _state("cache")]
JobsOf = Annotated[JobQueue, _state("jobs")]
UploadsOf = Annotated[Uploads, _state("uploads")]


async def owner_of(request: Request) -> str:
    """Return the owner of a request's uploads: the id of its token, or nothing."""
    return request.state.token.id if request.state.token else ""


OwnerOf = Annotated[str, Depends(owner_of)]
_LOOK_SECONDS: Final = 0.5
"""How often a request that waits for an exclusive call looks whether its client is still there."""
RunName = Annotated[
    str,
    InPath(
        max_length=200,
        description="A run: its id, the beginning of it, its name, `@latest` or `NAME@latest`.",
        examples=["@latest"],
    ),
]


def found_run(run: RunName, catalogue: CatalogueOf) -> Run:
    """Return the run that the path names."""
    return catalogue.find(run)


FoundRun = Annotated[Run, Depends(found_run)]


def recorded_run(run: FoundRun) -> Run:
    """Return the run that the path names, its recording restored if it is archived.

    Raises:
        RecordingError: it has no recording, or its archive is damaged or missing.
    """
    restored = at_hand(run)
    if not restored.recording.is_file():
        raise RecordingError(f"run {run.run_id} has no recording: it ended before there was one.")
    return restored


RecordedRun = Annotated[Run, Depends(recorded_run)]


def require_written(run: Run, recordings: Path, act: str) -> None:
    """Refuse to change a run outside the folder that the service writes to; `act` is a verb.

    Raises:
        Refused: the run is in another folder.
    """
    if run.folder.resolve().parent != recordings.resolve():
        raise Refused(
            HTTPStatus.CONFLICT,
            f"run {run.run_id} is in a folder that this service only reads; {act} it where it was recorded.",
        )


def written_run(run: FoundRun, settings: SettingsOf) -> Run:
    """Return the run that the path names, if it is in the folder that the service writes to."""
    require_written(run, settings.recordings[0], "change")
    return run


WrittenRun = Annotated[Run, Depends(written_run)]


def opened_recording(run: RecordedRun) -> Iterator[Recording]:
    """Yield the opened recording of the run that the path names."""
    with open_recording(run.recording) as recording:
        yield recording


OpenRecording = Annotated[Recording, Depends(opened_recording)]
At = Annotated[str, Query(max_length=60)]
"""A reference to an episode or step, in a query."""
EpisodeNumber = Annotated[int, InPath(ge=0, lt=2**62, description="Counted from 0.")]
After = Annotated[
    int, InPath(ge=0, lt=2**62, description="The evaluation after this number of training episodes.")
]


async def training_episode(episode: EpisodeNumber) -> EpisodeRef:
    """Return the training episode that the path names."""
    return EpisodeRef(episode)


async def trial_of_evaluation(after: After, trial: EpisodeNumber) -> EpisodeRef:
    """Return the trial that the path names."""
    return EpisodeRef(trial, after=after)


EPISODES: Final[dict[str, Callable[..., Awaitable[EpisodeRef]]]] = {
    "/train/{episode}": training_episode,
    "/eval/{after}/{trial}": trial_of_evaluation,
}
"""The ends of paths that name an episode, and the dependencies that return it."""


async def in_turn(request: Request) -> AsyncIterator[None]:
    """Let few downloads look for their file at a time, so that a page does not wait for all of many."""
    async with request.app.state.downloads:
        yield


InTurn: Final = Depends(in_turn, scope="function")


def recording_state(run: Run) -> tuple[str, int, int]:
    """Return the path, size and time of a run's recording, which change with its contents."""
    stat = run.recording.stat()
    return str(run.recording), stat.st_size, stat.st_mtime_ns


def _state_of(argument: object) -> object:
    """Return what changes with an argument of a computation: with the contents of recordings and runs."""
    if isinstance(argument, Run):  # `run.json` may get the duration after the recording is closed
        return _state_of(argument.recording), argument.summary.seconds
    if isinstance(argument, Path):  # a recording, whose name and marks are in files next to it
        stat = argument.stat()
        changed = [stat.st_mtime_ns]
        for name in (LABELS_FILE, MARKS_FILE):
            with contextlib.suppress(FileNotFoundError):
                changed.append(argument.with_name(name).stat().st_mtime_ns)
        return str(argument), stat.st_size, *changed
    return tuple(map(_state_of, argument)) if isinstance(argument, list | tuple) else argument


class Computation:
    """Functions of runs and recordings, called in a child process for a request, their results cached."""

    def __init__(
        self, cache: ResponseCache, processes: ProcessPool, exclusive: ProcessPool, request: Request
    ) -> None:
        self._cache = cache
        self._processes = processes
        self._exclusive = exclusive
        self._request = request

    async def __call__(self, function: Callable[..., bytes], *args: object, alone: bool = False) -> bytes:
        """Return the result of a function.

        With `alone` it writes large temporary files: one such call runs at a time, and it ends when nobody
        waits for it any more.

        Raises:
            ClientDisconnect: the client of an `alone` call has gone.
        """
        pool = self._exclusive if alone else self._processes
        key = (function, *map(_state_of, args))
        response = self._cache.get_or_await(key, partial(pool, function, *args))
        return await (self._unless_gone(response) if alone else response)

    async def uncached(self, function: Callable[..., bytes], *args: object) -> bytes:
        """Return the result of a function that reads more than the recordings it takes."""
        return await self._processes(function, *args)

    async def _unless_gone(self, response: Awaitable[bytes]) -> bytes:
        waiting = asyncio.ensure_future(response)
        try:
            while not (await asyncio.wait({waiting}, timeout=_LOOK_SECONDS))[0]:
                if await self._request.is_disconnected():
                    raise ClientDisconnect
            return waiting.result()
        finally:
            waiting.cancel()

    async def shown(self, kind: type[Shown], function: Callable[..., bytes], *args: object) -> Shown:
        """Return the dataclass whose fields a function returns as JSON."""
        return TypeAdapter(kind).validate_json(await self(function, *args))

    async def json(self, function: Callable[..., bytes], *args: object) -> Response:
        """Return the JSON that a function returns as a response."""
        return json_response(await self(function, *args))


async def computation_for(request: Request) -> Computation:
    """Return what computes for a request."""
    state = request.app.state
    return Computation(state.cache, state.processes, state.exclusive, request)


ComputationOf = Annotated[Computation, Depends(computation_for)]


def json_response(body: bytes) -> Response:
    """Return a response of JSON that is encoded already."""
    return Response(body, media_type="application/json")
