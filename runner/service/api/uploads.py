"""Uploads: begun, sent in pieces, completed, and their results."""

from __future__ import annotations

import asyncio
import time
from dataclasses import replace
from http import HTTPStatus
from typing import Annotated, Final

from anyio.to_thread import run_sync
from fastapi import APIRouter, Depends, Header, Path, Query, Request, Response
from pydantic import BaseModel
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect

from runner.client.client import UploadState, UploadStatus
from runner.service.dependencies import UploadsOf
from runner.service.errors import Refused
from runner.service.problems import error_docs
from runner.service.tokens import Token
from runner.service.upload import Announcement, Completion

router = APIRouter(tags=["uploads"])

PIECE: Final = 1 << 20
"""Bytes that are collected before they are written."""
WRITERS: Final = 4
"""Threads that write to the disk."""
MAX_WAIT: Final = 30.0
POLL_SECONDS: Final = 0.1


class UploadsResponse(BaseModel):
    """All uploads."""

    uploads: list[UploadStatus]


def owner_of(request: Request) -> str:
    """Return the owner of a request's uploads: the id of its token, or nothing."""
    token: Token | None = request.state.token
    return token.id if token else ""


OwnerOf = Annotated[str, Depends(owner_of)]
UploadId = Annotated[str, Path(pattern="^[0-9a-f]{32}$", description="The id from the first response.")]
_IN_ORDER: Final = error_docs(HTTPStatus.NOT_FOUND, HTTPStatus.CONFLICT)
_BYTES: Final = {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}


@router.get("/uploads", summary="List uploads in progress and the results of others.")
def list_uploads(
    uploads: UploadsOf, owner: OwnerOf, state: Annotated[UploadState | None, Query()] = None
) -> UploadsResponse:
    """List uploads, the newest first; ids and problems only of one's own."""
    chosen = [upload for upload in uploads.all() if state in (None, upload.state)]
    return UploadsResponse(
        uploads=[each if each.owner == owner else replace(each, id="", problem="") for each in chosen]
    )


@router.post(
    "/uploads",
    status_code=HTTPStatus.CREATED,
    responses={
        200: {"model": UploadStatus, "description": "It had begun, or the run is there already."},
        **_IN_ORDER,
    },
    summary="Begin an upload, or find the one of the same bytes.",
)
def begin(
    uploads: UploadsOf, owner: OwnerOf, announced: Announcement, request: Request, response: Response
) -> UploadStatus:
    """Announce a recording; all of it may be unknown yet."""
    upload, is_new = uploads.begin(owner, announced)
    if not is_new or upload.state == "stored":
        response.status_code = HTTPStatus.OK
    response.headers["Location"] = f"{request.url.path}/{upload.id}"
    return upload


@router.get(
    "/uploads/{upload_id}",
    responses=error_docs(HTTPStatus.NOT_FOUND),
    summary="Return the state of an upload; wait for its verification.",
)
async def one(
    uploads: UploadsOf,
    owner: OwnerOf,
    upload_id: UploadId,
    request: Request,
    wait: Annotated[float, Query(ge=0, le=MAX_WAIT, description="Seconds.")] = 0.0,
) -> UploadStatus:
    """Return the state of an upload; while it is being verified, wait at most the given time."""
    end, stopping = time.monotonic() + wait, request.app.state.stopping
    upload = uploads.get(upload_id, owner)
    while upload.state == "verifying" and time.monotonic() < end and not stopping.is_set():
        await asyncio.sleep(POLL_SECONDS)
        upload = uploads.get(upload_id, owner)
    return await run_in_threadpool(uploads.alive, upload)


@router.patch(
    "/uploads/{upload_id}",
    responses=_IN_ORDER,
    openapi_extra={"requestBody": {"required": True, "content": _BYTES}},
    summary="Send bytes from an offset on.",
)
async def append(
    uploads: UploadsOf,
    owner: OwnerOf,
    upload_id: UploadId,
    request: Request,
    upload_offset: Annotated[int, Header(ge=0, lt=1 << 62)],
    content_length: Annotated[int | None, Header(ge=0, lt=1 << 62, include_in_schema=False)] = None,
) -> UploadStatus:
    """Append bytes; those that were received stay, even if the connection breaks."""
    offset, collected = upload_offset, bytearray()

    async def write(data: bytes | bytearray, more: int = 0) -> UploadStatus:
        writers = request.app.state.writers
        return await run_sync(uploads.append, upload_id, owner, offset, data, more, limiter=writers)

    await write(b"", content_length or 0)  # refused before anything is read
    try:
        async for data in request.stream():
            collected += data
            if len(collected) >= PIECE:
                piece, collected = collected, bytearray()
                offset = (await write(piece)).offset
    except ClientDisconnect:
        raise Refused(
            HTTPStatus.BAD_REQUEST, "the connection was closed; continue from the offset."
        ) from None
    finally:
        if collected:
            await write(collected)
    return uploads.get(upload_id, owner)


@router.post(
    "/uploads/{upload_id}/complete",
    status_code=HTTPStatus.ACCEPTED,
    responses=_IN_ORDER,
    summary="Complete an upload; then it is verified.",
)
async def complete(
    uploads: UploadsOf, owner: OwnerOf, upload_id: UploadId, completion: Completion, request: Request
) -> UploadStatus:
    """Sync an upload to disk, and queue it for verification, which makes it a run."""
    writers = request.app.state.writers
    return await run_sync(uploads.complete, upload_id, owner, completion, limiter=writers)


@router.delete(
    "/uploads/{upload_id}",
    status_code=HTTPStatus.NO_CONTENT,
    response_class=Response,
    responses=_IN_ORDER,
    summary="Delete an upload; a run that it became stays.",
)
def delete(uploads: UploadsOf, owner: OwnerOf, upload_id: UploadId) -> Response:
    """Forget an upload, and remove what was received."""
    uploads.delete(upload_id, owner)
    return Response(status_code=HTTPStatus.NO_CONTENT)
