"""An upload, and the verification that makes a run of it."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

from filelock import FileLock
from pydantic import BaseModel, ConfigDict, Field

from runner.client.client import UploadStatus
from runner.errors import RunnerError, StorageError
from runner.recording.labels import labels_from
from runner.runs.importing import import_recording
from runner.runs.resolve import run_of_id
from runner.runs.store import Store
from runner.service.processes import NICENESS
from runner.service.settings import without_folders
from runner.util.files import hash_of
from runner.util.values import Json

Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Size = Annotated[int, Field(ge=0, lt=1 << 62)]
Text = Annotated[str, Field(max_length=100)]
Fact = str | float | None


class Announcement(BaseModel):
    """What a client announces; nothing of it is trusted, and all of it may be unknown yet."""

    model_config = ConfigDict(extra="forbid", strict=True)
    digest: Digest | None = None
    """BLAKE3 of all bytes."""
    size: Size | None = None
    """Number of bytes."""
    run_id: Text = ""
    name: Text = ""
    content_digest: Digest | None = None
    checkpoint_of: Text = ""
    """The run with a checkpoint of these bytes, if they are not a recording."""


class Completion(BaseModel):
    """What was sent, when all of it was."""

    model_config = ConfigDict(extra="forbid", strict=True)
    digest: Digest
    size: Size
    run: dict[str, Fact | dict[str, Fact]] = {}
    """What `run.json` has of the run and its recording does not; an exported recording has its own."""
    labels: dict[str, str | list[str]] = {}
    """Its name, tags and note; likewise."""


@dataclass(frozen=True, kw_only=True)
class Upload(UploadStatus):
    """An upload as the server stores it."""

    owner: str
    """Who may continue it."""
    digest: str | None
    checkpoint_of: str = ""
    completion: Completion | None = None
    changed: float = field(default_factory=time.time)
    """When it last changed, in seconds since 1970."""

    @property
    def is_over(self) -> bool:
        """Whether its result is final."""
        return self.state in ("stored", "refused")

    def replace(self, **changes: object) -> Upload:
        """Return the upload with other values of some fields, and without its problem."""
        new: Json = {"problem": "", "changed": time.time()} | changes
        return replace(self, **new)

    def refused(self, problem: str) -> Upload:
        """Return the upload when it can never be a run."""
        return self.replace(state="refused", problem=problem)

    def returned(self, problem: str) -> Upload:
        """Return the upload when it is to be completed again: the problem is the server's."""
        return self.replace(state="receiving", problem=problem)


def verify(upload: Upload, body: Path, recordings: Path) -> Upload:
    """Return an upload after its verification: stored as a run, refused, or to be completed again.

    For a process of its own.
    """
    with contextlib.suppress(OSError, AttributeError):  # not on Windows
        os.nice(NICENESS)
        # A signal to stop may go to all processes of the service, which then kills this one itself: its end
        # must not look like that of a recording that is too large.
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with FileLock(body.with_name("verifying.lock")):  # that of a server that was killed may still run
        try:
            sent = upload.completion
            if sent is None or hash_of(body)[1] != sent.digest:
                return upload.refused(
                    "found another digest than sent: bytes changed on the way; send it again."
                )
            if upload.checkpoint_of:
                run = run_of_id(upload.checkpoint_of, recordings)
                if run is None:
                    return upload.refused("the run of this checkpoint was removed.")
                Store(recordings).put(run.folder.name, body, expected=sent.digest)
                return upload.replace(state="stored", run_id=run.run_id)
            labels = labels_from(sent.labels) if sent.labels else None
            imported = import_recording(body, recordings, sent.run or None, labels)
            return upload.replace(state="stored", run_id=imported.run.run_id, already=imported.already)
        except RunnerError as error:
            problem = without_folders(str(error).replace(os.fspath(body), "the upload"), recordings)
            return (upload.returned if isinstance(error, StorageError) else upload.refused)(problem)
        except OSError as error:
            return upload.returned(f"the server's disk cannot be used ({error.strerror}).")
