"""Files of runs: recordings and checkpoints, exports made on demand, and uploads."""

from __future__ import annotations

import pathlib
from dataclasses import replace
from functools import partial
from http import HTTPStatus
from typing import Annotated, Final
from urllib.parse import quote

from anyio.to_thread import run_sync
from fastapi import APIRouter, Header, Path, Query, Request, Response
from fastapi.responses import FileResponse
from pydantic import BaseModel

from runner.analysis.episodes import TYPICAL, EpisodeRef
from runner.client.client import UploadState, UploadStatus
from runner.errors import ConfigError, RunNotFound
from runner.export.film import FORMATS
from runner.export.plugin import installed_export
from runner.export.rerun.selection import Request as Selection
from runner.runs.run import Run
from runner.service import computed
from runner.service.dependencies import (
    ComputationOf,
    InTurn,
    OwnerOf,
    ProcessesOf,
    RecordedRun,
    SettingsOf,
    UploadsOf,
    recording_state,
)
from runner.service.tokens import Digest
from runner.service.uploads import UploadSource
from runner.util.extras import EXPORTS, plugin_names
from runner.util.processes import CallFailed
from runner.util.values import Ranges, ranges_in

router = APIRouter(
    prefix="/runs/{run}",
    tags=["files"],
)
OCTETS: Final = "application/octet-stream"
DRAW_SECONDS: Final = 120.0
"""Time for an export whose pictures an environment draws; then it is made without them."""
BLOCK: Final = 256 << 10
"""Bytes of a file that are read at a time."""
FILE: Final[dict[int | str, dict[str, object]]] = {
    200: {"description": "All of it.", "content": {OCTETS: {}}},
    206: {"description": "The requested ranges.", "content": {OCTETS: {}}},
    304: {"description": "The client has it already."},
    416: {"description": "There is no such range.", "content": {"text/plain": {}}},
}

IfNoneMatch = Annotated[str | None, Header(max_length=1000)]


class CheckpointResponse(BaseModel):
    """A checkpoint of a loop, after `step` steps of its phase."""

    name: str
    phase: str
    step: int
    episode: int
    format: str
    size: int
    digest: str
    here: bool


class CheckpointsResponse(BaseModel):
    """The checkpoints of a run, in order."""

    checkpoints: list[CheckpointResponse]


@router.get(
    "/recording",
    response_class=Response,
    responses=FILE,
    summary="The recording; ranges of it too.",
    dependencies=[InTurn],
)
@router.head("/recording", response_class=Response, responses=FILE, include_in_schema=False)
def recording(run: RecordedRun, if_none_match: IfNoneMatch = None) -> Response:
    """Return the MCAP file. Its ETag holds the content digest, and changes with every byte of the file."""
    return _file(run.recording, f"{run.file_stem}.mcap", tag_of(run), if_none_match)


@router.get("/checkpoints", summary="The checkpoints of a loop.")
def checkpoints(run: RecordedRun) -> CheckpointsResponse:
    """Return the checkpoints in order, with their digests; `here` says whether the content is."""
    return CheckpointsResponse.model_validate(
        {"checkpoints": [checkpoint.as_json() for checkpoint in run.checkpoints()]}
    )


@router.get(
    "/checkpoints/{digest}", response_class=Response, responses=FILE, summary="The content of a checkpoint."
)
def checkpoint(
    run: RecordedRun,
    digest: Annotated[Digest, Path(description="Its BLAKE3.")],
    if_none_match: IfNoneMatch = None,
) -> Response:
    """Return the bytes of a checkpoint of this run."""
    for kept in run.checkpoints():
        if kept.digest == digest and kept.is_here:
            return _file(kept.path, f"{run.file_stem}-{kept.step}.{kept.format}", digest, if_none_match)
    raise RunNotFound(
        f"run {run.run_id} has no checkpoint of the digest {digest[:16]}… here; /checkpoints lists them."
    )


@router.get(
    "/replay.rrd",
    response_class=Response,
    responses=FILE,
    summary="The run for the Rerun viewer, made on demand.",
)
async def replay(
    run: RecordedRun,
    processes: ProcessesOf,
    episodes: Annotated[
        str, Query(max_length=1000, description="Training episodes, such as `0..20,49980..`.")
    ] = "",
    evaluations: Annotated[
        list[int] | None,
        Query(max_length=100, description="Trials of the evaluation after this number of training episodes."),
    ] = None,
    every: Annotated[int, Query(ge=0, lt=2**31, description="One of this number of training episodes.")] = 0,
    trials: Annotated[
        list[int] | None,
        Query(
            max_length=100, description="Evaluation episodes of a loop to open at, counted over the phase."
        ),
    ] = None,
    frames: Annotated[
        bool, Query(description="Whether the environment of a loop draws the selected episodes.")
    ] = False,
    if_none_match: IfNoneMatch = None,
) -> Response:
    """Return what `dualtaxi export rerun` writes; cached, so that a second request is answered at once.

    By default it has the steps of 20 training episodes and of the last evaluation.
    """
    selection = Selection(
        _ranges(episodes), tuple(evaluations or ()), every, frames=frames, trials=tuple(trials or ())
    )
    seconds = DRAW_SECONDS if frames else None
    try:
        path = await processes(computed.replay, [run], selection, seconds=seconds)
    except CallFailed:
        if not frames:
            raise
        # The environment hangs, crashes or needs too much memory.
        path = await processes(computed.replay, [run], replace(selection, frames=False))
    return _file(path, f"{run.file_stem}.rrd", path.stem, if_none_match)


@router.get("/report.html", response_class=Response, responses=FILE, summary="The report of the run.")
async def report(run: RecordedRun, compute: ComputationOf, settings: SettingsOf) -> Response:
    """Return what `dualtaxi report` writes, as a download."""
    body = await compute(computed.report, run.recording, settings)
    return attachment(body, f"{run.file_stem}.html")


@router.post("/film", response_class=Response, responses=FILE, summary="A film of an episode of the run.")
async def film(
    run: RecordedRun,
    compute: ComputationOf,
    at: Annotated[str, Query(max_length=60, description="The episode, and its first step.")] = TYPICAL,
    ending: Annotated[str, Query(max_length=20, description=f"Of its name: {', '.join(FORMATS)}.")] = ".mp4",
) -> Response:
    """Return what `dualtaxi export film` writes, as a download."""
    body = await compute(computed.film, run.recording, run.title, EpisodeRef.parse(at), ending, alone=True)
    return attachment(body, f"{run.file_stem}{ending}")


@router.get(
    "/exports/{name}",
    response_class=Response,
    responses=FILE,
    summary="The run as an export of an installed package writes it.",
)
async def installed(
    run: RecordedRun, compute: ComputationOf, name: Annotated[str, Path(max_length=100)]
) -> Response:
    """Return what `dualtaxi export NAME` writes."""
    if name not in plugin_names(EXPORTS):
        raise RunNotFound(
            f"no installed package adds an export {name!r}; `dualtaxi export --help` lists them."
        )
    body = await compute(computed.installed_file, run.recording, name, alone=True)
    return attachment(body, f"{run.file_stem}{installed_export(name).ending}")


def attachment(body: bytes, name: str) -> Response:
    """Return a file to be saved under a name, which a browser never shows as a page of the service."""
    headers = {"content-disposition": f"attachment; filename*=utf-8''{quote(name)}"}
    return Response(body, media_type=OCTETS, headers=headers)


def tag_of(run: Run) -> str:
    """Return the ETag of a recording, which changes with every byte."""
    _, size, changed = recording_state(run)
    return f"{run.summary.get('content_digest') or 'unfinished'}-{size:x}-{changed:x}"


def is_known(tag: str, if_none_match: str | None) -> bool:
    """Return whether a client has what has this ETag."""
    tags = [part.strip().removeprefix("W/") for part in (if_none_match or "").split(",")]
    return f'"{tag}"' in tags or "*" in tags


def _file(path: pathlib.Path, name: str, tag: str, if_none_match: str | None) -> Response:
    headers = {"etag": f'"{tag}"', "accept-ranges": "bytes"}
    if is_known(tag, if_none_match):
        return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=headers)
    response = FileResponse(path, media_type=OCTETS, filename=name, headers=headers)
    response.chunk_size = BLOCK
    return response


def _ranges(text: str) -> Ranges:
    try:
        return ranges_in(text) if text else ()
    except ValueError as error:
        raise ConfigError(
            f"query.episodes: found {text!r}, expected START..STOP or N, such as 0..20,49980..",
        ) from error


WRITE_BYTES: Final = 1 << 20
"""Bytes that are collected before they are written."""
WRITERS: Final = 4
"""Threads that write to the disk."""
_BYTES: Final = {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}
_BODY: Final = {"requestBody": {"required": True, "content": _BYTES}}
_ID_IS: Final = "64 hexadecimal digits: the BLAKE3 of the file, or random ones while it is growing."
UploadId = Annotated[Digest, Path(description=_ID_IS)]

uploads_router = APIRouter(prefix="/uploads", tags=["uploads"])


class UploadsResponse(BaseModel):
    """All uploads."""

    uploads: list[UploadStatus]


@uploads_router.get("", summary="List uploads in progress and the results of others.")
def list_uploads(
    uploads: UploadsOf, owner: OwnerOf, state: Annotated[UploadState | None, Query()] = None
) -> UploadsResponse:
    """List uploads, the newest first; ids and problems only of one's own."""
    listed: list[UploadStatus] = [
        upload if upload.owner == owner else replace(upload, id="", problem="")
        for upload in uploads.all()
        if state in (None, upload.state)
    ]
    return UploadsResponse(uploads=listed)


@uploads_router.put("/{upload_id}", summary="Begin an upload, or continue it; return its state.")
def put(uploads: UploadsOf, owner: OwnerOf, upload_id: UploadId, source: UploadSource) -> UploadStatus:
    """Announce a file: it is verified when its digest is known and all of its bytes are here.

    The response has the offset of the next bytes. After the last, send the same again until it is stored or
    refused.
    """
    return uploads.put(owner, upload_id, source)


@uploads_router.patch("/{upload_id}", openapi_extra=_BODY, summary="Send bytes from an offset on.")
async def append(
    uploads: UploadsOf,
    owner: OwnerOf,
    upload_id: UploadId,
    request: Request,
    upload_offset: Annotated[int, Header(ge=0, lt=1 << 62)],
    content_length: Annotated[int, Header(ge=0, lt=1 << 62, include_in_schema=False)] = 0,
) -> UploadStatus:
    """Append bytes; those that were received stay, even if the connection breaks."""
    append_here = partial(uploads.append, owner, upload_id)
    write = partial(run_sync, append_here, limiter=request.app.state.writers)
    upload = await write(upload_offset, b"", content_length)  # refused before anything is read
    collected = bytearray()
    try:
        async for data in request.stream():
            collected += data
            if len(collected) >= WRITE_BYTES:
                piece = bytes(collected)
                collected = bytearray()
                upload = await write(upload.offset, piece)
    finally:
        if collected:
            upload = await write(upload.offset, bytes(collected))
    return upload


@uploads_router.delete(
    "/{upload_id}", status_code=HTTPStatus.NO_CONTENT, summary="Delete an upload; its run stays."
)
def delete(uploads: UploadsOf, owner: OwnerOf, upload_id: UploadId) -> None:
    """Forget an upload, and remove what was received."""
    uploads.delete(owner, upload_id)
