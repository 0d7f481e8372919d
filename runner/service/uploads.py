"""Uploads: recordings on their way into a recordings folder.

    recordings/.uploads/4f0c…/upload.json    the upload, with its sender's facts; replaced atomically
    recordings/.uploads/4f0c…/body           the bytes so far

An upload is received, in pieces and in order. When it has all of its bytes it is verified, by a child
process; then it is stored, which is one renaming, or refused. A server that was killed continues from these
folders. A stored upload is kept so that its sender learns the result; an idle upload is dropped.

A run that is pushed while it is recorded is listed as running before its upload is complete, by a preview:

    recordings/k3v9m2xq/run.json          with the id of the upload
    recordings/k3v9m2xq/recording.mcap    a link to the bytes that have been received
    recordings/k3v9m2xq/stop              if the loop is requested to stop

Nothing of it is verified: readers take any recording as hostile input. When the upload is verified and
stored, its run replaces the preview.
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import shutil
import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Final

from filelock import FileLock
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from runner.client.client import UploadStatus
from runner.errors import RecordingError, RunnerError, RunNotFound, StorageError
from runner.recording.marks import marks_from
from runner.recording.reader import open_recording
from runner.runs.checkpoints import Store
from runner.runs.importing import checked_facts, import_recording, merge_marks
from runner.runs.resolve import run_of_id
from runner.runs.run import PREVIEW, RECORDING_FILE, RUN_FILE, Run, run_in
from runner.service.errors import Busy, LimitReached, StateConflict, UploadTooLarge, expecting
from runner.service.jobs.store import lock_folder, now
from runner.service.logs import LOG
from runner.service.processes import ProcessPool, lower_priority
from runner.service.settings import ServiceLimits, without_folders
from runner.service.tokens import Digest
from runner.util.files import hash_of, require_room, storage_errors, write_all, write_object
from runner.util.processes import CallFailed, end_after_call
from runner.util.values import NAME_PATTERN

FOLDER: Final = ".uploads"
STATE_FILE: Final = "upload.json"
BODY_FILE: Final = "body"
IDLE_SECONDS: Final = 7 * 86_400
"""An upload is dropped after this time without a request from its sender."""
VERIFY_SECONDS: Final = 120.0
VERIFY_BYTES_A_SECOND: Final = 2 << 20
"""The time limit of a verification grows with the size of the upload."""
VERIFY_MEMORY: Final = 2 << 30

Text = Annotated[str, Field(max_length=100)]
Fact = str | float | None
Facts = dict[str, Fact | dict[str, Fact | list[str] | list[dict[str, int | Fact | list[str]]]]]


class UploadSource(BaseModel):
    """Unverified facts from the client; every field may still be missing."""

    model_config = ConfigDict(extra="forbid", strict=True)
    digest: Digest | None = None
    """BLAKE3 of all bytes."""
    size: Annotated[int, Field(ge=0, lt=1 << 62)] | None = None
    """Number of bytes."""
    run_id: Text = ""
    name: Text = ""
    content_digest: Digest | None = None
    checkpoint_of: Text = ""
    """The run with a checkpoint of these bytes, if they are not a recording."""
    run: Annotated[Facts, expecting("facts of a run, as `dualtaxi export mcap` stores them")] = {}
    """Facts of the run that its recording lacks, as `import_record` returns them."""


@dataclass(frozen=True, kw_only=True)
class Upload(UploadStatus):
    """An upload as the server stores it."""

    owner: str
    """The id of the token that may continue it; empty without tokens."""
    source: UploadSource
    folder: str = field(default_factory=partial(secrets.token_hex, 16))


_STORED: Final = TypeAdapter(Upload)


class Uploads:
    """The uploads into one recordings folder; thread-safe.

    Methods raise `RunNotFound` for an unknown upload, or another owner's. `on_verified` is called with each
    verified upload, on another thread.
    """

    def __init__(
        self, recordings: Path, limits: ServiceLimits, on_verified: Callable[[Upload], object]
    ) -> None:
        self._recordings = recordings
        self._limits = limits
        self._on_verified = on_verified
        self._folder = recordings / FOLDER
        self._lock = threading.RLock()
        """Held while uploads change, not while they are read: the server's event loop must not wait."""
        self._file_lock = lock_folder(recordings, f"{FOLDER}/lock")
        self._uploads: dict[tuple[str, str], Upload] = {}
        """By owner and id."""
        self._processes = ProcessPool(1, VERIFY_SECONDS, VERIFY_MEMORY, max_waiting=limits.uploads)
        for folder in [entry for entry in self._folder.iterdir() if entry.is_dir()]:
            try:
                upload = _STORED.validate_json((folder / STATE_FILE).read_bytes())
                offset = upload.offset if upload.is_over else (folder / BODY_FILE).stat().st_size
                self._uploads[upload.owner, upload.id] = replace(upload, offset=offset)
            except (OSError, ValueError):
                shutil.rmtree(folder, ignore_errors=True)
        self._drop_old()
        for upload in self.all():
            if upload.source.digest is not None:
                self._proceed(upload)

    def close(self) -> None:
        """Stop; an unfinished verification is repeated by the next server."""
        self._processes.close()
        self._file_lock.release()

    def all(self) -> list[Upload]:
        """Return every upload, the newest first."""
        return sorted(self._uploads.copy().values(), key=lambda upload: upload.created, reverse=True)

    def get(self, owner: str, upload_id: str) -> Upload:
        """Return an upload of this owner."""
        if upload := self._uploads.get((owner, upload_id)):
            return upload
        raise RunNotFound(
            "no such upload: it was deleted, is stored, or belongs to another token; begin it again."
        )

    def put(self, owner: str, upload_id: str, source: UploadSource) -> Upload:
        """Begin an upload, or continue it with new facts from its sender; return it.

        It begins again if the file has become shorter. If the server has its run or content already, it
        counts as stored at once, and its bytes are dropped.

        Raises:
            StateConflict, RunNotFound: another digest was announced, or a run has no such checkpoint.
            UploadTooLarge, LimitReached, StorageError: there is no room for it.
            Busy: the server could not verify it, and will try again.
        """
        with self._lock:
            announced = source.model_dump(include={"run_id", "name", "size"})
            fresh = Upload(id=upload_id, owner=owner, source=source, created=now(), **announced)
            upload = self._uploads.get((owner, upload_id), fresh)
            if upload.source.digest not in (None, source.digest):
                raise StateConflict("found another digest than the one announced; begin another upload.")
            if upload.state in ("verifying", "refused"):
                return upload
            if upload.problem:
                self._uploads[owner, upload_id] = replace(upload, problem="")  # it is verified next time
                raise Busy(upload.problem)
            run = self._run_with(source, upload.run_id if upload.is_over else "")
            is_shorter = source.size is not None and source.size < upload.offset
            if upload is not fresh and (run is not None or upload.is_over or is_shorter):
                self.delete(owner, upload_id)
            if run is not None:
                merge_marks(run, marks_from(source.run.get("marks")))
                size = source.size or 0
                there = replace(fresh, state="stored", offset=size, run_id=run.run_id, already=True)
                return upload if upload.is_over else there
            if (owner, upload_id) not in self._uploads:
                upload = fresh
                self._drop_old()
                owners = [other.owner for other in self.all() if not other.is_over]
                if (count := owners.count(owner)) >= self._limits.uploads_each:
                    message = f"{count:,} of your uploads are open, the maximum; complete or delete some."
                    raise LimitReached(message)
                if len(owners) >= self._limits.uploads:
                    raise LimitReached(f"{len(owners):,} uploads are open; try again when some are done.")
            if upload.run_id != source.run_id:
                remove_preview(self._recordings, upload.id, upload.run_id)
            upload = replace(upload, source=source, **announced)
            self._require_room(upload, (upload.size or 0) - upload.offset)
            self._store(upload)
        return self._proceed(upload)

    def append(self, owner: str, upload_id: str, offset: int, data: bytes, more: int = 0) -> Upload:
        """Append bytes, and return the upload. Nothing is written of more bytes than it may have.

        `more` bytes are announced to follow; they are refused now if there is no room for them.

        Raises:
            StateConflict: the bytes do not follow those that were received.
            UploadTooLarge: they are more than announced, or than the server accepts.
            StorageError: the disk fails, or has only its reserve left; what was written stays.
        """
        with self._lock:
            upload = self.get(owner, upload_id)
            if upload.state != "receiving" or offset != upload.offset:
                expected = f"expected {upload.offset:,} ({upload.state})"
                raise StateConflict(f"found bytes from {offset:,} on, {expected}.")
            self._require_room(upload, len(data) + more)
            with storage_errors(self._folder), self._body(upload).open("ab", buffering=0) as stream:
                try:
                    write_all(stream.fileno(), data)
                finally:
                    upload = self._uploads[owner, upload_id] = replace(upload, offset=stream.tell())
        return self._proceed(upload)

    def delete(self, owner: str, upload_id: str) -> None:
        """Forget an upload, and remove what was received.

        Raises:
            StateConflict: it is being verified.
        """
        with self._lock:
            upload = self.get(owner, upload_id)
            if upload.state == "verifying":
                raise StateConflict("the upload is being verified; wait for its end.")
            del self._uploads[owner, upload_id]
        remove_preview(self._recordings, upload.id, upload.run_id)
        shutil.rmtree(self._body(upload).parent, ignore_errors=True)

    def _body(self, upload: Upload) -> Path:
        return self._folder / upload.folder / BODY_FILE

    def _run_with(self, source: UploadSource, stored_as: str) -> Run | None:
        """Return the run that already has these bytes, or was stored from them; None without one."""
        run = run_of_id(source.checkpoint_of or stored_as or source.run_id, self._recordings)
        if not source.checkpoint_of:
            has = run is not None and run.summary.content_digest == source.content_digest is not None
            return run if stored_as or has else None
        if run is None:
            raise RunNotFound("no such run: push it before the contents of its checkpoints.")
        checkpoints = [(checkpoint.digest, checkpoint.size) for checkpoint in run.checkpoints()]
        if (source.digest, source.size) not in checkpoints:
            raise StateConflict(f"run {run.run_id} has no checkpoint of this digest and size.")
        return run if Store(self._recordings).has(source.digest or "", source.size or 0) else None

    def _require_room(self, upload: Upload, more: int) -> None:
        """Refuse an upload if there is no room for more of its bytes."""
        end = upload.offset + more
        limit = self._limits.upload_bytes
        limit = limit if upload.size is None else min(limit, upload.size)
        if end > limit:
            raise UploadTooLarge(f"found {end:,} bytes, expected at most {limit:,}.")
        require_room(self._recordings, more, self._limits.spare_bytes)

    def _store(self, upload: Upload) -> None:
        """Write an upload to disk; once it is over, remove its bytes and its preview."""
        body = self._body(upload)
        try:
            with storage_errors(self._folder):
                body.parent.mkdir(exist_ok=True)
                body.touch()
                write_object(body.with_name(STATE_FILE), _STORED.dump_python(upload, mode="json"))
                if upload.is_over:
                    remove_preview(self._recordings, upload.id, upload.run_id)
                    body.unlink()
        finally:  # clients see it when it is on disk
            self._uploads[upload.owner, upload.id] = upload

    def _drop_old(self) -> None:
        """Drop uploads without a request for `IDLE_SECONDS`; of those that are over, only the newest stay."""
        over = 0
        for upload in sorted(self.all(), key=self._changed, reverse=True):
            over += upload.is_over
            is_old = time.time() - self._changed(upload) > IDLE_SECONDS or (
                upload.is_over and over > self._limits.uploads
            )
            if is_old and upload.state != "verifying":
                self.delete(upload.owner, upload.id)

    def _changed(self, upload: Upload) -> float:
        """Return when a request last changed an upload, in seconds of the epoch."""
        body = self._body(upload)
        with contextlib.suppress(OSError):
            return (body.with_name(STATE_FILE) if upload.is_over else body).stat().st_mtime
        return 0.0

    def _proceed(self, upload: Upload) -> Upload:
        """Verify an upload that is complete, or list the run that is still being recorded."""
        if upload.source.digest is None and upload.state == "receiving":
            run = update_preview(self._recordings, upload.id, upload.run_id, self._body(upload))
            return replace(upload, stop_requested=run is not None and run.is_stop_requested)
        if upload.offset != upload.size or upload.state != "receiving":
            return upload
        with self._lock:
            if self._uploads.get((upload.owner, upload.id)) is not upload:  # another request was first
                return self.get(upload.owner, upload.id)
            upload = replace(upload, state="verifying", problem="")
            self._uploads[upload.owner, upload.id] = upload
        seconds = VERIFY_SECONDS + upload.offset / VERIFY_BYTES_A_SECOND
        future = self._processes.submit(seconds, verify, upload, self._body(upload), self._recordings)
        future.add_done_callback(partial(self._end, upload))
        return upload

    def _end(self, upload: Upload, verification: Future[Upload]) -> None:
        """Store the result of a verification; if the server itself failed, it can be repeated."""
        try:
            upload = verification.result()
        except RunnerError as error:
            problem = str(error).replace(os.fspath(self._body(upload)), "the upload")
            if isinstance(error, CallFailed):
                problem = f"its verification failed: {problem}"
            is_temporary = isinstance(error, Busy | StorageError)
            problem = without_folders(problem, self._recordings)
            upload = replace(upload, state="receiving" if is_temporary else "refused", problem=problem)
        except Exception:  # else it would remain in verification until the server is started again
            LOG.exception("verification", extra={"upload": upload.id})
            problem = "something unexpected went wrong while it was verified; try again."
            upload = replace(upload, state="receiving", problem=problem)
        try:
            self._on_verified(upload)
        finally:
            with contextlib.suppress(StorageError):  # verified again after a restart, with the same result
                self._store(upload)


def verify(upload: Upload, body: Path, recordings: Path) -> Upload:
    """Return an upload that has become a run, or its checkpoint; in a process that ends after it.

    Raises:
        StorageError: the disk prevents it for now.
        RunnerError: it can never be a run.
    """
    end_after_call()
    lower_priority()
    with contextlib.suppress(AttributeError):  # not on Windows
        # A signal to stop may go to all processes of the service, which then kills this one itself: its end
        # must not look like that of a recording that is too large.
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
    source = upload.source
    lock = FileLock(body.with_name("verifying.lock"))
    with storage_errors(body), lock:  # the process of a server that was killed may still have it
        if hash_of(body)[1] != source.digest:
            raise RecordingError("found another digest than sent: bytes changed on the way; send it again.")
        if source.checkpoint_of:
            run = run_of_id(source.checkpoint_of, recordings)
            if run is None:
                raise RunNotFound(
                    "the run of this checkpoint was removed; push the run, then the checkpoint again."
                )
            Store(recordings).put(run.folder.name, body, expected=source.digest)
            return replace(upload, state="stored", run_id=run.run_id)
        imported = import_recording(body, recordings, source.run or None)
        return replace(upload, state="stored", run_id=imported.run.run_id, already=imported.already)


_DESCRIPTION_BYTES: Final = 64 << 20
"""A description of a run that takes more is not waited for."""


def preview_of(recordings: Path, upload_id: str, run_id: str) -> Run | None:
    """Return the run that shows an upload; None without one, or if the id is another run's."""
    run = run_in(recordings / run_id) if re.fullmatch(NAME_PATTERN, run_id) else None
    return run if run is not None and run.facts.get(PREVIEW) == upload_id else None


def update_preview(recordings: Path, upload_id: str, run_id: str, body: Path) -> Run | None:
    """Note that the sender of an upload goes on; return the run that shows it, if its bytes describe it.

    A run of another upload, or one that is stored, stays as it is.
    """
    if (run := preview_of(recordings, upload_id, run_id)) is not None:
        run.beat()
        return run
    target = recordings / run_id
    if not re.fullmatch(NAME_PATTERN, run_id) or os.path.lexists(target):
        return None
    with contextlib.suppress(RunnerError, OSError):  # its description is not complete, or no run's
        if body.stat().st_size > _DESCRIPTION_BYTES:
            return None
        with open_recording(body) as recording:
            facts = checked_facts(recording, {})
        if facts["run_id"] != run_id:
            return None
        # The owner is no process of this machine, so the run counts as running by its heartbeat.
        facts |= {"status": "running", "owner": {"host": "upload"}, PREVIEW: upload_id}
        hidden = body.with_name("preview")
        shutil.rmtree(hidden, ignore_errors=True)
        hidden.mkdir()
        os.link(body, hidden / RECORDING_FILE)
        write_object(hidden / RUN_FILE, facts)
        hidden.rename(target)
    return preview_of(recordings, upload_id, run_id)


def remove_preview(recordings: Path, upload_id: str, run_id: str) -> None:
    """Remove the run that shows an upload, if it exists."""
    if (run := preview_of(recordings, upload_id, run_id)) is not None:
        shutil.rmtree(run.folder, ignore_errors=True)
