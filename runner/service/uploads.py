"""Uploads: recordings on their way into a recordings folder.

    recordings/.uploads/4f0c…/upload.json    the upload and its state; replaced atomically
    recordings/.uploads/4f0c…/body           the bytes so far

An upload is received, in pieces and in order; then verified, by a child process; and then stored, which is
one renaming, or refused. A server that was killed continues from these folders.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

from pydantic import TypeAdapter

from runner.errors import RunNotFound, StorageError
from runner.runs.resolve import run_of_id
from runner.runs.run import Run
from runner.runs.store import Store
from runner.service.errors import Busy, TooManyUploads, UploadConflict, UploadTooLarge
from runner.service.jobs.store import lock_folder, now
from runner.service.logs import LOG
from runner.service.previews import Previews
from runner.service.processes import ProcessPool
from runner.service.settings import Limits
from runner.service.upload import Announcement, Completion, Upload, verify
from runner.util.files import storage_errors, sync, write_object
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
_DISK: Final = "the server's disk"
"""How clients see the place of an error."""

_STORED: Final = TypeAdapter(Upload)


class Uploads:
    """The uploads into one recordings folder; thread-safe.

    `on_verified` is called with each upload that was verified, by another thread.
    """

    def __init__(
        self,
        recordings: Path,
        limits: Limits = Limits(),  # noqa: B008 - frozen
        on_verified: Callable[[Upload], object] = lambda _: None,
    ) -> None:
        self._limits, self._on_verified = limits, on_verified
        self._recordings, self._folder = recordings, recordings / FOLDER
        self._previews = Previews(recordings)
        self._lock = threading.RLock()
        """Held while uploads change, not while they are read: the server's event loop must not wait."""
        self._file_lock = lock_folder(recordings, f"{FOLDER}/lock")
        self._uploads: dict[str, Upload] = {}
        self._is_stopping = False
        self._processes = ProcessPool(1, VERIFY_SECONDS, VERIFY_MEMORY, max_waiting=limits.uploads)
        for folder in [entry for entry in self._folder.iterdir() if entry.is_dir()]:
            try:
                upload = _STORED.validate_json((folder / STATE_FILE).read_bytes())
                facts = {path.name: path.stat() for path in folder.iterdir()}
            except (OSError, ValueError):
                shutil.rmtree(folder, ignore_errors=True)
                continue
            offset = facts[BODY_FILE].st_size if BODY_FILE in facts else upload.offset
            changed = max(stat.st_mtime for stat in facts.values())
            self._uploads[upload.id] = replace(upload, offset=offset, changed=changed)
        self._forget()
        for upload in self.all():
            if upload.state == "verifying":
                self._verify(upload)

    def close(self) -> None:
        """Stop; an unfinished verification is repeated by the next server."""
        self._is_stopping = True
        self._processes.close()
        self._file_lock.release()

    def all(self) -> list[Upload]:
        """Return every upload, the newest first."""
        return sorted(self._uploads.copy().values(), key=lambda upload: upload.created, reverse=True)

    def get(self, upload_id: str, owner: str) -> Upload:
        """Return an upload of this owner.

        Raises:
            RunNotFound: there is none with this id, or it is another owner's.
        """
        upload = self._uploads.get(upload_id)
        if upload is None or upload.owner != owner:
            raise RunNotFound("no such upload: it was deleted, is long over, or belongs to another token.")
        return upload

    def begin(self, owner: str, announced: Announcement) -> tuple[Upload, bool]:
        """Return the upload of what is announced, and whether it is a new one.

        The same digest from the same owner is the same upload. A run that is in the recordings folder already
        is stored at once.

        Raises:
            UploadTooLarge, TooManyUploads: it is not accepted.
            StorageError: the disk has no room.
        """
        self._forget()
        with self._lock:
            content_of, store = self._checkpointed(announced), Store(self._recordings)
            same = (owner, announced.digest, announced.size, announced.checkpoint_of)
            for known in self.all() if announced.digest else ():
                if (known.owner, known.digest, known.size, known.checkpoint_of) != same:
                    continue
                if not known.is_over:
                    return known, False
                if (
                    known.state == "stored"
                    and not content_of
                    and run_of_id(known.run_id, self._recordings) is not None
                ):
                    return known.replace(already=True), False
            upload = Upload(
                id=secrets.token_hex(16),
                owner=owner,
                created=now(),
                **announced.model_dump(exclude={"content_digest"}),
            )
            run = run_of_id(announced.run_id, self._recordings) if announced.content_digest else None
            is_there = run is not None and run.summary.content_digest == announced.content_digest
            if content_of is not None and announced.digest:
                store.refer(content_of.folder.name, [announced.digest])  # from now on it stays
                is_there = store.has(announced.digest, announced.size or 0)
            if is_there:
                upload = upload.replace(state="stored", offset=announced.size or 0, already=True)
            else:
                owners = [known.owner for known in self.all() if not known.is_over]
                if owners.count(owner) >= self._limits.uploads_each:
                    raise TooManyUploads(
                        f"{self._limits.uploads_each:,} of your uploads are open, the maximum of a client; "
                        "complete or delete some."
                    )
                if len(owners) >= self._limits.uploads:
                    raise TooManyUploads(f"{len(owners):,} uploads are open; try again when some are done.")
                self._require_room(upload, announced.size or 0)
            with storage_errors(_DISK):
                self._body(upload).parent.mkdir()
                self._body(upload).touch()
            self._save(upload)
            self._uploads[upload.id] = upload
        return upload, True

    def _checkpointed(self, announced: Announcement) -> Run | None:
        """Return the run with a checkpoint of these bytes; None if they are a recording.

        Raises:
            RunNotFound: there is no such run.
            UploadConflict: it has no checkpoint of this digest and size.
        """
        if not announced.checkpoint_of:
            return None
        run = run_of_id(announced.checkpoint_of, self._recordings)
        if run is None:
            raise RunNotFound("no such run: push it before the contents of its checkpoints.")
        if all((one.digest, one.size) != (announced.digest, announced.size) for one in run.checkpoints()):
            raise UploadConflict(f"run {run.run_id} has no checkpoint of this digest and size.")
        return run

    def append(
        self, upload_id: str, owner: str, offset: int, data: bytes | bytearray, more: int = 0
    ) -> Upload:
        """Append bytes, and return the upload after them. Of bytes that are too many, none is written.

        `more` bytes are announced to follow; if there is no room for them, the sender learns it now.

        Raises:
            UploadConflict: the bytes do not follow those that were received.
            UploadTooLarge: they are more than announced, or than the server accepts.
            StorageError: the disk is full, apart from the reserve, or fails; what was written stays.
        """
        with self._lock:
            upload = self.get(upload_id, owner)
            if upload.state != "receiving" or offset != upload.offset:
                found = f"found bytes from {offset:,} on"
                raise UploadConflict(f"{found}, expected {upload.offset:,} ({upload.state}).")
            self._require_room(upload, len(data) + more)
            with storage_errors(_DISK), self._body(upload).open("ab", buffering=0) as stream:
                try:
                    view = memoryview(data)
                    while view:
                        view = view[os.write(stream.fileno(), view) :]
                finally:
                    received = offset + len(data) - len(view)
                    upload = self._uploads[upload_id] = upload.replace(offset=received)
        if not more:
            self._previews.update(upload, self._body(upload))
        return upload

    def alive(self, upload: Upload) -> Upload:
        """Note that the sender of an upload goes on; return it with whether its run is requested to stop."""
        if upload.state != "receiving" or upload.digest is not None:
            return upload
        self._previews.update(upload, self._body(upload))
        run = self._previews.of(upload)
        return replace(upload, stop_requested=run is not None and run.is_stop_requested)

    def complete(self, upload_id: str, owner: str, completion: Completion) -> Upload:
        """Finish an upload: it is synced to disk, and queued for verification. Returns its new state.

        Raises:
            UploadConflict: bytes are missing, or another digest was announced or completed.
        """
        upload = self.get(upload_id, owner)
        if upload.state == "receiving":
            with storage_errors(_DISK):
                sync(self._body(upload))  # without the lock, as it may take seconds
        with self._lock:
            offset, upload = upload.offset, self.get(upload_id, owner)
            if upload.state != "receiving":
                if upload.completion is not None and upload.completion.digest != completion.digest:
                    raise UploadConflict("the upload was completed with another digest; begin another one.")
                return upload
            if offset != completion.size:
                raise UploadConflict(
                    f"found {offset:,} bytes, expected the {completion.size:,} of the completion."
                )
            if upload.digest not in (None, completion.digest):
                raise UploadConflict("found another digest than the one announced; begin another upload.")
            upload = upload.replace(state="verifying", completion=completion, size=completion.size)
            self._save(upload)
            self._uploads[upload.id] = upload
        self._verify(upload)
        return upload

    def delete(self, upload_id: str, owner: str) -> None:
        """Forget an upload, and remove what was received.

        Raises:
            UploadConflict: it is being verified.
        """
        with self._lock:
            upload = self.get(upload_id, owner)
            if upload.state == "verifying":
                raise UploadConflict("the upload is being verified; wait for its end.")
            del self._uploads[upload_id]
        self._previews.remove(upload)
        shutil.rmtree(self._body(upload).parent, ignore_errors=True)

    def _body(self, upload: Upload) -> Path:
        return self._folder / upload.id / BODY_FILE

    def _save(self, upload: Upload) -> None:
        with storage_errors(_DISK):
            write_object(self._body(upload).with_name(STATE_FILE), _STORED.dump_python(upload, mode="json"))

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
        uploads, moment = self.all(), time.time()
        forgotten = [upload for upload in uploads if upload.is_over][self._limits.uploads :]
        for upload in uploads:
            if moment - upload.changed > (OVER_SECONDS if upload.is_over else IDLE_SECONDS):
                forgotten.append(upload)
        for upload in forgotten:
            with contextlib.suppress(UploadConflict, RunNotFound):  # in verification, or gone
                self.delete(upload.id, upload.owner)

    def _verify(self, upload: Upload) -> None:
        seconds = VERIFY_SECONDS + (upload.size or 0) / VERIFY_BYTES_A_SECOND
        future = self._processes.submit_within(seconds, verify, upload, self._body(upload), self._recordings)
        future.add_done_callback(partial(self._end, upload))

    def _end(self, upload: Upload, verification: Future[Upload]) -> None:
        """Save the result of a verification; the bytes are removed when they are needed no more."""
        try:
            upload = verification.result()
        except CallFailed as error:
            if self._is_stopping:
                return
            upload = upload.refused(f"its verification failed: {error}")
        except Busy as error:
            upload = upload.returned(str(error))
        except Exception:  # else it would remain in verification until the server is started again
            LOG.exception("verification", extra={"upload": upload.id})
            upload = upload.returned(
                "something unexpected went wrong while it was verified; complete it again."
            )
        with contextlib.suppress(StorageError):  # after a restart it is verified again, with the same result
            self._save(upload)
        if upload.is_over:
            self._previews.remove(upload)  # of one that was refused
            with contextlib.suppress(OSError):  # removed with the rest of it, when it is forgotten
                self._body(upload).unlink(missing_ok=True)
        try:
            self._on_verified(upload)
        finally:
            self._uploads[upload.id] = upload
