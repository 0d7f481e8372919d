"""What an upload is, and where it stands; what a client says of it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import BaseModel, ConfigDict, Field

from runner.errors import MAX_MESSAGE, RunnerError
from runner.recording.labels import MAX_NOTE, MAX_TAGS
from runner.util.files import read_object

STATE_FILE: Final = "upload.json"
BODY_FILE: Final = "body"
_MAX_STATE_BYTES: Final = 1 << 20

State = Literal["receiving", "verifying", "stored", "refused"]
Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Size = Annotated[int, Field(ge=0, lt=1 << 62)]
Text = Annotated[str, Field(max_length=100)]
_FIRM: Final = ConfigDict(frozen=True, extra="forbid", strict=True)


class Conflict(RunnerError):
    """An upload is not where the request takes it to be; ask for its offset, and go on from there."""


class TooLarge(RunnerError):
    """More bytes than the server takes, or than the upload said it has."""


class TooMany(RunnerError):
    """As many uploads as the server takes at once; try again later."""


@dataclass(frozen=True)
class UploadLimits:
    """What a server takes."""

    most_bytes: int = 100 * 10**9
    """Of one upload."""
    most_open: int = 1_000
    """Uploads that are received or verified."""
    most_open_each: int = 100
    """Of them, those of one client."""
    spare_bytes: int = 256 << 20
    """Left free on the disk for runs that are being recorded on it."""
    idle_days: float = 7.0
    """An upload to which nothing comes for so long is forgotten."""
    kept_days: float = 1.0
    """So long is told what became of an upload."""
    verifiers: int = 1
    """Uploads that are verified at once."""


class Announcement(BaseModel):
    """What is to come; nothing of it is believed, and all of it may be unknown yet."""

    model_config = _FIRM

    digest: Digest | None = None
    """BLAKE3 of all bytes."""
    size: Size | None = None
    """Number of bytes."""
    run_id: Text = ""
    name: Text = ""
    content_digest: Digest | None = None


class Told(BaseModel):
    """What `run.json` says of a run and its recording cannot know."""

    model_config = _FIRM

    name: Text | None = None
    status: Literal["finished", "interrupted", "failed"] | None = None
    proof: Digest | None = None
    seconds: Annotated[float, Field(ge=0, lt=1e12, strict=False)] | None = None
    error: Annotated[str, Field(max_length=MAX_MESSAGE)] | None = None


class ToldLabels(BaseModel):
    """What people say of a run."""

    model_config = _FIRM

    name: Text = ""
    tags: Annotated[list[Annotated[str, Field(max_length=64)]], Field(max_length=MAX_TAGS)] = []
    note: Annotated[str, Field(max_length=MAX_NOTE)] = ""


class Completion(BaseModel):
    """What was sent, once it is all there; an exported recording has its own `run` and `labels`."""

    model_config = _FIRM

    digest: Digest
    size: Size
    run: Told = Told()
    labels: ToldLabels = ToldLabels()


class Upload(BaseModel):
    """An upload as it stands."""

    model_config = _FIRM

    upload_id: Annotated[str, Field(pattern=r"^[0-9a-f]{32}$")]
    owner: str
    """Who may go on with it."""
    created: str
    """When it began, in UTC."""
    state: State = "receiving"
    announced: Announcement = Announcement()
    completion: Completion | None = None
    run_id: str = ""
    """The run that was stored."""
    already: bool = False
    """Whether that run had been there before."""
    problem: str = ""
    """Why it was refused, or could not be stored."""

    @property
    def size(self) -> int | None:
        """The number of bytes it has in the end, if it is known."""
        return self.completion.size if self.completion else self.announced.size


def read_upload(folder: Path) -> Upload:
    """Return the upload in a folder.

    Raises:
        OSError: its file cannot be read.
        ValueError: it holds no upload.
    """
    return Upload.model_validate_json(json.dumps(read_object(folder / STATE_FILE, _MAX_STATE_BYTES)))
