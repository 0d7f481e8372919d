"""Uploads over HTTP: begun, sent in pieces, and their results."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from http import HTTPStatus
from typing import Annotated, Final

from anyio.to_thread import run_sync
from fastapi import APIRouter, Header, Path, Query, Request
from pydantic import BaseModel

from runner.client.uploads import UploadState, UploadStatus
from runner.service.dependencies import OwnerOf, UploadsOf
from runner.service.tokens import Digest
from runner.service.uploads import UploadSource

WRITE_BYTES: Final = 1 << 20
"""Bytes that are collected before they are written."""
WRITERS: Final = 4
"""Threads that write to the disk."""
_BYTES: Final = {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}
_BODY: Final = {"requestBody": {"required": True, "content": _BYTES}}
_ID_IS: Final = "64 hexadecimal digits: the BLAKE3 of the file, or random ones while it is growing."
UploadId = Annotated[Digest, Path(description=_ID_IS)]

router = APIRouter(prefix="/uploads", tags=["uploads"])


class UploadsResponse(BaseModel):
    """All uploads."""

    uploads: list[UploadStatus]


@router.get("", summary="List uploads in progress and the results of others.")
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


@router.put("/{upload_id}", summary="Begin an upload, or continue it; return its state.")
def put(uploads: UploadsOf, owner: OwnerOf, upload_id: UploadId, source: UploadSource) -> UploadStatus:
    """Announce a file: it is verified when its digest is known and all of its bytes are here.

    The response has the offset of the next bytes. After the last, send the same again until it is stored or
    refused.
    """
    return uploads.put(owner, upload_id, source)


@router.patch("/{upload_id}", openapi_extra=_BODY, summary="Send bytes from an offset on.")
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


@router.delete("/{upload_id}", status_code=HTTPStatus.NO_CONTENT, summary="Delete an upload; its run stays.")
def delete(uploads: UploadsOf, owner: OwnerOf, upload_id: UploadId) -> None:
    """Forget an upload, and remove what was received."""
    uploads.delete(owner, upload_id)
