"""What an upload is, what a client says of it, and what a server accepts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from runner.errors import MAX_MESSAGE
from runner.recording.labels import MAX_NOTE, MAX_TAGS

State = Literal["receiving", "verifying", "stored", "refused"]
Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Size = Annotated[int, Field(ge=0, lt=1 << 62)]
Text = Annotated[str, Field(max_length=100)]


@dataclass(frozen=True)
class UploadLimits:
    """What a server accepts."""

    max_bytes: int = 100 * 10**9
    """Size of an upload."""
    max_open: int = 1_000
    """Uploads that are being received or verified."""
    max_open_each: int = 100
    """The same for one client."""
    spare_bytes: int = 256 << 20
    """Left free on the disk for runs that are being recorded."""
    idle_days: float = 7.0
    """An upload that receives nothing for so long is forgotten."""
    over_days: float = 1.0
    """How long the result of an upload is remembered."""


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class Announcement(_Model):
    """What a client announces; nothing of it is trusted, and all of it may be unknown yet."""

    digest: Digest | None = None
    """BLAKE3 of all bytes."""
    size: Size | None = None
    """Number of bytes."""
    run_id: Text = ""
    name: Text = ""
    content_digest: Digest | None = None


class RunDetails(_Model):
    """What `run.json` has of a run and its recording does not."""

    name: Text | None = None
    status: Literal["finished", "interrupted", "failed"] | None = None
    proof: Digest | None = None
    seconds: Annotated[float, Field(ge=0, lt=1e12, strict=False)] | None = None
    error: Annotated[str, Field(max_length=MAX_MESSAGE)] | None = None


class RunLabels(_Model):
    """The labels of a run."""

    name: Text = ""
    tags: Annotated[list[Annotated[str, Field(max_length=64)]], Field(max_length=MAX_TAGS)] = []
    note: Annotated[str, Field(max_length=MAX_NOTE)] = ""


class Completion(_Model):
    """What was sent, when all of it was; an exported recording has its own `run` and `labels`."""

    digest: Digest
    size: Size
    run: RunDetails = RunDetails()
    labels: RunLabels = RunLabels()


class Upload(_Model):
    """An upload and its state."""

    upload_id: Annotated[str, Field(pattern=r"^[0-9a-f]{32}$")]
    owner: str
    """Who may continue it."""
    created: str
    """In UTC, as ISO 8601."""
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
        """Its number of bytes when it is complete; None if unknown."""
        return self.completion.size if self.completion else self.announced.size

    @property
    def is_over(self) -> bool:
        """Whether its result is final."""
        return self.state in ("stored", "refused")

    def completed(self, completion: Completion) -> Upload:
        """Return the upload when all bytes were sent."""
        return self._with(state="verifying", completion=completion, problem="")

    def stored(self, run_id: str, already: bool) -> Upload:
        """Return the upload when it is a run."""
        return self._with(state="stored", run_id=run_id, already=already, problem="")

    def refused(self, problem: str) -> Upload:
        """Return the upload when it can never be a run."""
        return self._with(state="refused", problem=problem)

    def returned(self, problem: str) -> Upload:
        """Return the upload when it is to be completed again: the problem is the server's."""
        return self._with(state="receiving", completion=None, problem=problem)

    def _with(self, **changes: object) -> Upload:
        return self.model_copy(update=changes)
