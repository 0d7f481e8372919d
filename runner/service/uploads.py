"""Uploads: recordings on their way into a recordings folder.

    recordings/.uploads/4f0c…/upload.json    the upload with what its sender says of it; replaced atomically
    recordings/.uploads/4f0c…/body           the bytes so far

An upload is received, in pieces and in order. When it has all of its bytes it is verified, by a child
process; then it is stored, which is one renaming, or refused. A server that was killed continues from these
folders.
"""

from __future__ import annotations

import contextlib
import os
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

from runner.client.uploads import UploadStatus
from runner.errors import RecordingError, RunnerError, RunNotFound, StorageError
from runner.recording.labels import labels_from
from runner.runs.importing import import_recording
from runner.runs.resolve import run_of_id
from runner.runs.run import Run
from runner.runs.store import Store
from runner.service.errors import Busy, TooManyUploads, UploadConflict, UploadTooLarge
from runner.service.jobs.store import lock_folder, now
from runner.service.logs import LOG
from runner.service.previews import Previews
from runner.service.processes import ProcessPool, lower_priority
from runner.service.settings import Limits, without_folders
from runner.util.files import hash_of, storage_errors, sync, write_object
from runner.util.processes import CallFailed

FOLDER: Final = ".uploads"
STATE_FILE: Final = "upload.json"
BODY_FILE: Final = "body"
IDLE_SECONDS: Final = 7 * 86_400
"""An upload that receives nothing for so long is forgotten."""
OVER_SECONDS: Final = 86_400
"""How long the result of an upload is remembered."""
VERIFY_SECONDS: Final = 120.0
VERIFY_BYTES_A_SECOND: Final = 2 << 20
"""The time limit of a verification grows with the size of the upload."""
VERIFY_MEMORY: Final = 2 << 30

Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Text = Annotated[str, Field(max_length=100)]
Fact = str | float | None


class UploadSource(BaseModel):
    """What a client says of a file: nothing of it is trusted, and all of it may be unknown yet."""

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
    run: dict[str, Fact | dict[str, Fact]] = {}
    """What `run.json` has of the run and its recording does not; an exported recording has its own."""
    labels: dict[str, str | list[str]] = {}
    """Its name, tags and note; likewise."""


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

    `on_verified` is called with each upload that was verified, by another thread.
    """

    def __init__(self, recordings: Path, limits: Limits, on_verified: Callable[[Upload], object]) -> None:
        self._limits, self._on_verified = limits, on_verified
        self._recordings, self._folder = recordings, recordings / FOLDER
        self._previews = Previews(recordings)
        self._lock = threading.RLock()
        """Held while uploads change, not while they are read: the server's event loop must not wait."""
        self._file_lock = lock_folder(recordings, f"{FOLDER}/lock")
        self._uploads: dict[tuple[str, str], Upload] = {}
        """By owner and id."""
        self._is_stopping = False
        self._processes = ProcessPool(1, VERIFY_SECONDS, VERIFY_MEMORY, max_waiting=limits.uploads)
        for folder in [entry for entry in self._folder.iterdir() if entry.is_dir()]:
            try:
                upload = _STORED.validate_json((folder / STATE_FILE).read_bytes())
                offset = upload.offset if upload.is_over else (folder / BODY_FILE).stat().st_size
                self._uploads[upload.owner, upload.id] = replace(upload, offset=offset)
            except (OSError, ValueError):
                shutil.rmtree(folder, ignore_errors=True)
        self._forget()
        for upload in self.all():
            self._verify_if_whole(upload)

    def close(self) -> None:
        """Stop; an unfinished verification is repeated by the next server."""
        self._is_stopping = True
        self._processes.close()
        self._file_lock.release()

    def all(self) -> list[Upload]:
        """Return every upload, the newest first."""
        return sorted(self._uploads.copy().values(), key=lambda upload: upload.created, reverse=True)

    def get(self, owner: str, upload_id: str) -> Upload:
        """Return an upload of this owner.

        Raises:
            RunNotFound: there is none with this id, or it is another owner's.
        """
        if upload := self._uploads.get((owner, upload_id)):
            return upload
        raise RunNotFound("no such upload: it was deleted, is long over, or belongs to another token.")

    def put(self, owner: str, upload_id: str, source: UploadSource) -> Upload:
        """Begin an upload, or continue it with what its sender knows by now; return it.

        It begins again if its run was removed, or the file has become shorter. When its run or content is
        here already, it is stored at once.

        Raises:
            UploadConflict: another digest was announced before, or the run has no such checkpoint.
            RunNotFound: the run of a checkpoint is not here.
            UploadTooLarge, TooManyUploads: it is not accepted.
            Busy: it could not be verified, for a reason of the server's own.
            StorageError: the disk has no room.
        """
        with self._lock:
            upload = self._uploads.get((owner, upload_id))
            if upload is not None:
                if upload.source.digest not in (None, source.digest):
                    raise UploadConflict("found another digest than the one announced; begin another upload.")
                if upload.state in ("verifying", "refused") or self._is_here(upload, source):
                    return upload
                if upload.problem:
                    self._uploads[owner, upload_id] = replace(upload, problem="")  # it is verified next time
                    raise Busy(upload.problem)
                if upload.is_over or (source.size is not None and source.size < upload.offset):
                    self.delete(owner, upload_id)
                    upload = None
            run = self._run_with(source)
            if upload is None:
                self._forget()
                upload = Upload(id=upload_id, owner=owner, source=source, created=now())
                if run is None:
                    self._require_place(owner)
            if upload.run_id != source.run_id:
                self._previews.remove(upload.id, upload.run_id)
            known = source.model_dump(include={"run_id", "name", "size"})
            upload = replace(upload, source=source, **known)
            if run is None:
                self._require_room(upload, (upload.size or 0) - upload.offset)
            else:
                size = upload.size or 0
                upload = replace(upload, state="stored", offset=size, run_id=run.run_id, already=True)
            self._store(upload)
        return self._verify_if_whole(upload)

    def _is_here(self, upload: Upload, source: UploadSource) -> bool:
        """Return whether an upload was stored, and what it became was not removed since."""
        if upload.state != "stored":
            return False
        if source.checkpoint_of:  # its run may have been removed with its contents, and be here again
            return self._run_with(source) is not None
        return run_of_id(upload.run_id, self._recordings) is not None

    def _run_with(self, source: UploadSource) -> Run | None:
        """Return the run that has all of these bytes already; None if there is none."""
        if not source.checkpoint_of:
            run = run_of_id(source.run_id, self._recordings) if source.content_digest else None
            return run if run is not None and run.summary.content_digest == source.content_digest else None
        run = run_of_id(source.checkpoint_of, self._recordings)
        if run is None:
            raise RunNotFound("no such run: push it before the contents of its checkpoints.")
        if all((one.digest, one.size) != (source.digest, source.size) for one in run.checkpoints()):
            raise UploadConflict(f"run {run.run_id} has no checkpoint of this digest and size.")
        return run if Store(self._recordings).has(source.digest or "", source.size or 0) else None

    def append(self, owner: str, upload_id: str, offset: int, data: bytes, more: int = 0) -> Upload:
        """Append bytes, and return the upload after them. Of bytes that are too many, none is written.

        `more` bytes are announced to follow; if there is no room for them, the sender learns it now. After
        the last of all bytes, the upload is synced to disk and verified.

        Raises:
            RunNotFound: there is none with this id, or it is another owner's.
            UploadConflict: the bytes do not follow those that were received.
            UploadTooLarge: they are more than announced, or than the server accepts.
            StorageError: the disk is full, apart from the reserve, or fails; what was written stays.
        """
        with self._lock:
            upload = self.get(owner, upload_id)
            if upload.state != "receiving" or offset != upload.offset:
                found = f"found bytes from {offset:,} on"
                raise UploadConflict(f"{found}, expected {upload.offset:,} ({upload.state}).")
            self._require_room(upload, len(data) + more)
            with storage_errors(self._folder), self._body(upload).open("ab", buffering=0) as stream:
                try:
                    view = memoryview(data)
                    while view:
                        view = view[os.write(stream.fileno(), view) :]
                finally:
                    upload = replace(upload, offset=offset + len(data) - len(view))
                    self._uploads[owner, upload_id] = upload
        return self._verify_if_whole(upload)

    def alive(self, upload: Upload) -> Upload:
        """Show what has arrived of a run that is being recorded; return whether its loop is to stop, too."""
        if upload.state != "receiving" or upload.source.digest is not None:
            return upload
        run = self._previews.update(upload.id, upload.run_id, self._body(upload))
        return replace(upload, stop_requested=run is not None and run.is_stop_requested)

    def delete(self, owner: str, upload_id: str) -> None:
        """Forget an upload, and remove what was received.

        Raises:
            RunNotFound: there is none with this id, or it is another owner's.
            UploadConflict: it is being verified.
        """
        with self._lock:
            upload = self.get(owner, upload_id)
            if upload.state == "verifying":
                raise UploadConflict("the upload is being verified; wait for its end.")
            del self._uploads[owner, upload_id]
        self._previews.remove(upload.id, upload.run_id)
        shutil.rmtree(self._body(upload).parent, ignore_errors=True)

    def _body(self, upload: Upload) -> Path:
        return self._folder / upload.folder / BODY_FILE

    def _store(self, upload: Upload) -> None:
        """Write an upload to disk; remove what is not needed any more when it is over."""
        body = self._body(upload)
        try:
            with storage_errors(self._folder):
                body.parent.mkdir(exist_ok=True)
                body.touch()
                write_object(body.with_name(STATE_FILE), _STORED.dump_python(upload, mode="json"))
                if upload.is_over:
                    self._previews.remove(upload.id, upload.run_id)
                    body.unlink()
        finally:  # clients see it when it is on disk
            self._uploads[upload.owner, upload.id] = upload

    def _require_place(self, owner: str) -> None:
        """Refuse a new upload if too many are open."""
        owners = [upload.owner for upload in self.all() if not upload.is_over]
        if owners.count(owner) >= self._limits.uploads_each:
            raise TooManyUploads(
                f"{self._limits.uploads_each:,} of your uploads are open, the maximum of a client; "
                "complete or delete some."
            )
        if len(owners) >= self._limits.uploads:
            raise TooManyUploads(f"{len(owners):,} uploads are open; try again when some are done.")

    def _require_room(self, upload: Upload, more: int) -> None:
        """Refuse an upload if there is no room for more of its bytes."""
        end, limit = upload.offset + more, self._limits.upload_bytes
        limit = limit if upload.size is None else min(limit, upload.size)
        if end > limit:
            raise UploadTooLarge(f"found {end:,} bytes, expected at most {limit:,}.")
        free = shutil.disk_usage(self._folder).free - self._limits.spare_bytes
        if more > free:
            raise StorageError(f"the server has room for {max(free, 0):,} bytes, expected {more:,}.")

    def _forget(self) -> None:
        """Forget uploads that receive nothing any more, are long over, or are over and too many."""
        over = [upload for upload in self.all() if upload.is_over]
        for upload in self.all():
            body, changed = self._body(upload), 0.0
            with contextlib.suppress(OSError):
                changed = (body.with_name(STATE_FILE) if upload.is_over else body).stat().st_mtime
            is_old = time.time() - changed > (OVER_SECONDS if upload.is_over else IDLE_SECONDS)
            if upload.state != "verifying" and (is_old or upload in over[self._limits.uploads :]):
                self.delete(upload.owner, upload.id)

    def _verify_if_whole(self, upload: Upload) -> Upload:
        """Sync an upload that has all of its bytes to disk, and queue it for verification; return it."""
        if upload.state != "receiving" or upload.source.digest is None or upload.offset != upload.size:
            return upload
        body = self._body(upload)
        with storage_errors(self._folder):
            sync(body)  # without the lock, as it may take seconds
        with self._lock:
            upload = self.get(upload.owner, upload.id)
            if upload.state != "receiving":  # another request was first
                return upload
            upload = self._uploads[upload.owner, upload.id] = replace(upload, state="verifying", problem="")
        seconds = VERIFY_SECONDS + upload.offset / VERIFY_BYTES_A_SECOND
        future = self._processes.submit_within(seconds, verify, upload.source, body, self._recordings)
        future.add_done_callback(partial(self._end, upload))
        return upload

    def _end(self, upload: Upload, verification: Future[tuple[str, bool]]) -> None:
        """Store the result of a verification; after a problem of the server's own it can be repeated."""
        try:
            run_id, already = verification.result()
            upload = replace(upload, state="stored", run_id=run_id, already=already)
        except RunnerError as error:
            if isinstance(error, CallFailed) and self._is_stopping:
                return
            problem = str(error).replace(os.fspath(self._body(upload)), "the upload")
            if isinstance(error, CallFailed):
                problem = f"its verification failed: {problem}"
            problem = without_folders(problem, self._recordings)
            is_final = not isinstance(error, Busy | StorageError)
            upload = replace(upload, state="refused" if is_final else "receiving", problem=problem)
        except Exception:  # else it would remain in verification until the server is started again
            LOG.exception("verification", extra={"upload": upload.id})
            problem = "something unexpected went wrong while it was verified; try again."
            upload = replace(upload, state="receiving", problem=problem)
        try:
            self._on_verified(upload)
        finally:
            with contextlib.suppress(StorageError):  # verified again after a restart, with the same result
                self._store(upload)


def verify(source: UploadSource, body: Path, recordings: Path) -> tuple[str, bool]:
    """Make a run of an upload; return its id, and whether it was there before. For a process of its own.

    Raises:
        StorageError: the disk prevents it for now.
        RunnerError: it can never be a run.
    """
    lower_priority()
    with contextlib.suppress(AttributeError):  # not on Windows
        # A signal to stop may go to all processes of the service, which then kills this one itself: its end
        # must not look like that of a recording that is too large.
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
    lock = FileLock(body.with_name("verifying.lock"))
    with storage_errors(body), lock:  # the process of a server that was killed may still have it
        if hash_of(body)[1] != source.digest:
            raise RecordingError("found another digest than sent: bytes changed on the way; send it again.")
        if source.checkpoint_of:
            run = run_of_id(source.checkpoint_of, recordings)
            if run is None:
                raise RunNotFound("the run of this checkpoint was removed.")
            Store(recordings).put(run.folder.name, body, expected=source.digest)
            return run.run_id, False
        labels = labels_from(source.labels) if source.labels else None
        imported = import_recording(body, recordings, source.run or None, labels)
        return imported.run.run_id, imported.already
