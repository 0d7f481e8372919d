"""Uploads: begun, sent in pieces, completed, and told what became of them."""

from __future__ import annotations

import asyncio
import hashlib
import time
from collections.abc import AsyncIterator
from http import HTTPStatus
from typing import Annotated, Final, Literal

from anyio import CapacityLimiter
from anyio.to_thread import run_sync
from fastapi import APIRouter, Depends, Header, Path, Query, Request, Response
from fastapi.concurrency import contextmanager_in_threadpool
from pydantic import BaseModel
from starlette.requests import ClientDisconnect

from runner.service.errors import Refused
from runner.service.problems import answers
from runner.service.receiving.appending import Appending
from runner.service.receiving.model import Announcement, Completion, State, Upload
from runner.service.receiving.uploads import Uploads
from runner.service.security import Token

router = APIRouter(tags=["uploads"])

PIECE: Final = 1 << 20
"""So much is gathered before it is written."""
WRITERS: Final = 4
"""Threads that write to the disk."""
MOST_WAIT: Final = 30.0
_LOOKS_A_SECOND: Final = 10
OCTETS: Final = "application/octet-stream"


class UploadResponse(BaseModel):
    """An upload as it stands."""

    id: str
    state: State
    """`receiving`, `verifying`, `stored` as a run, or `refused`."""
    offset: int
    """Bytes that are there: the next ones begin here."""
    size: int | None
    """Bytes that it has in the end, if that is known."""
    name: str
    run_id: str
    """The run that it is said to be; once it is stored, the run that it is."""
    already: bool
    """Whether that run was there before."""
    problem: str
    """Why it was refused; of one that is being received again, why it could not be stored."""
    created: str


class UploadsResponse(BaseModel):
    """The uploads there are."""

    uploads: list[UploadResponse]


def uploads_of(request: Request) -> Uploads:
    """Return the uploads of the service."""
    found: Uploads = request.app.state.uploads
    return found


def owner_of(request: Request) -> str:
    """Return whose uploads a request may continue: the hash of its token, hashed once more, or nothing."""
    token: Token | None = request.state.token
    return hashlib.sha256(b"owner of uploads " + token.sha256.encode()).hexdigest() if token else ""


UploadsOf = Annotated[Uploads, Depends(uploads_of)]
OwnerOf = Annotated[str, Depends(owner_of)]
UploadId = Annotated[str, Path(pattern="^[0-9a-f]{32}$", description="As it was told when it began.")]
_KNOWN: Final = answers(HTTPStatus.NOT_FOUND)
_IN_ORDER: Final = answers(HTTPStatus.NOT_FOUND, HTTPStatus.CONFLICT)
_POSITION: Final = {
    "Upload-Offset": {"description": "Bytes that are there.", "schema": {"type": "integer"}},
    "Upload-Length": {"description": "Bytes in the end, if known.", "schema": {"type": "integer"}},
}


@router.get("/uploads", summary="List what is being received and verified, and what became of it.")
def list_uploads(
    uploads: UploadsOf,
    owner: OwnerOf,
    state: Annotated[Literal["receiving", "verifying", "stored", "refused"] | None, Query()] = None,
) -> UploadsResponse:
    """List uploads, the newest first; of others' ones the id is left out, and why they were refused."""
    chosen = [upload for upload in uploads.all() if state in (None, upload.state)]
    return UploadsResponse(uploads=[_answer(uploads, upload, owner) for upload in chosen])


@router.post(
    "/uploads",
    status_code=HTTPStatus.CREATED,
    response_model=UploadResponse,
    responses={
        200: {"model": UploadResponse, "description": "It had begun before, or the run is there already."}
    },
    summary="Begin an upload, or find the one that had begun of the same bytes.",
)
def begin(
    uploads: UploadsOf, owner: OwnerOf, announced: Announcement, request: Request, response: Response
) -> UploadResponse:
    """Announce a recording, as far as is known: all of it may be unknown yet."""
    upload, new = uploads.begin(owner, announced)
    if not new or upload.state == "stored":
        response.status_code = HTTPStatus.OK
    response.headers["Location"] = f"{request.url.path}/{upload.upload_id}"
    return _answer(uploads, upload, owner)


@router.get(
    "/uploads/{upload_id}", responses=_KNOWN, summary="Tell how an upload stands; wait for its verification."
)
async def tell(
    uploads: UploadsOf,
    owner: OwnerOf,
    upload_id: UploadId,
    request: Request,
    wait: Annotated[float, Query(ge=0, le=MOST_WAIT, description="Seconds.")] = 0.0,
) -> UploadResponse:
    """Tell how an upload stands, at the latest after some seconds, at once if it is not being verified."""
    end, stopping = time.monotonic() + wait, request.app.state.stopping
    upload = uploads.get(upload_id, owner)
    while upload.state == "verifying" and time.monotonic() < end and not stopping.is_set():
        await asyncio.sleep(1 / _LOOKS_A_SECOND)
        upload = uploads.get(upload_id, owner)
    return await run_sync(_answer, uploads, upload, owner, limiter=request.app.state.writers)


@router.head(
    "/uploads/{upload_id}",
    responses=_KNOWN | {200: {"description": "In the headers.", "headers": _POSITION}},
    summary="Tell how many bytes are there.",
)
def position(uploads: UploadsOf, owner: OwnerOf, upload_id: UploadId) -> Response:
    """Tell from where to go on."""
    return Response(headers=_position(uploads, uploads.get(upload_id, owner)))


@router.patch(
    "/uploads/{upload_id}",
    status_code=HTTPStatus.NO_CONTENT,
    response_class=Response,
    responses=_IN_ORDER | {204: {"description": "They are there.", "headers": _POSITION}},
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {OCTETS: {"schema": {"type": "string", "format": "binary"}}},
        }
    },
    summary="Send the bytes from an offset on.",
)
async def append(
    uploads: UploadsOf,
    owner: OwnerOf,
    upload_id: UploadId,
    request: Request,
    upload_offset: Annotated[int, Header(ge=0, lt=1 << 62)],
    content_length: Annotated[int | None, Header(ge=0, lt=1 << 62, include_in_schema=False)] = None,
) -> Response:
    """Append bytes; what has come stays, also if the connection is cut."""
    writers = request.app.state.writers
    appending = uploads.appending(upload_id, owner, upload_offset, content_length)
    async with contextmanager_in_threadpool(appending) as sink:  # it opens files and asks the disk
        try:
            await _receive(request.stream(), sink, writers)
        except ClientDisconnect:
            raise Refused(HTTPStatus.BAD_REQUEST, "the connection was cut; go on from the offset.") from None

    def position() -> dict[str, str]:
        return _position(uploads, uploads.get(upload_id, owner))

    return Response(status_code=HTTPStatus.NO_CONTENT, headers=await run_sync(position, limiter=writers))


@router.post(
    "/uploads/{upload_id}/complete",
    status_code=HTTPStatus.ACCEPTED,
    responses=_IN_ORDER,
    summary="Say that all is there; then it is verified.",
)
async def complete(
    uploads: UploadsOf, owner: OwnerOf, upload_id: UploadId, completion: Completion, request: Request
) -> UploadResponse:
    """Have an upload put on disk and verified; it is a run when that has passed."""
    writers = request.app.state.writers

    def completed() -> UploadResponse:
        return _answer(uploads, uploads.complete(upload_id, owner, completion), owner)

    return await run_sync(completed, limiter=writers)


@router.delete(
    "/uploads/{upload_id}",
    status_code=HTTPStatus.NO_CONTENT,
    response_class=Response,
    responses=_IN_ORDER,
    summary="Give an upload up; a run that it became stays.",
)
def give_up(uploads: UploadsOf, owner: OwnerOf, upload_id: UploadId) -> Response:
    """Forget an upload, and remove what was received."""
    uploads.give_up(upload_id, owner)
    return Response(status_code=HTTPStatus.NO_CONTENT)


async def _receive(stream: AsyncIterator[bytes], sink: Appending, writers: CapacityLimiter) -> None:
    """Write what comes, in large pieces, in another thread; what has come is written however it ends."""
    gathered = bytearray()
    try:
        async for data in stream:
            gathered += data
            if len(gathered) >= PIECE:
                full, gathered = gathered, bytearray()
                await run_sync(sink.write, full, limiter=writers)
    finally:
        if gathered:
            await run_sync(sink.write, gathered, limiter=writers)


def _position(uploads: Uploads, upload: Upload) -> dict[str, str]:
    length = {} if upload.size is None else {"Upload-Length": str(upload.size)}
    return {"Upload-Offset": str(uploads.offset(upload)), "Cache-Control": "no-store"} | length


def _answer(uploads: Uploads, upload: Upload, owner: str) -> UploadResponse:
    own = upload.owner == owner
    return UploadResponse(
        id=upload.upload_id if own else "",
        state=upload.state,
        offset=uploads.offset(upload),
        size=upload.size,
        name=upload.announced.name,
        run_id=upload.run_id or upload.announced.run_id,
        already=upload.already,
        problem=upload.problem if own else "",
        created=upload.created,
    )
