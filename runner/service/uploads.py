"""Uploads: recordings on their way into a recordings folder.

    recordings/.uploads/4f0c…/upload.json    the upload and its state; replaced atomically
    recordings/.uploads/4f0c…/body           the bytes so far: its length is the offset to continue from

An upload is received, in pieces and in order; then verified, by a child process; and then stored, which is
one renaming, or refused. The folder is the truth: a server that was killed continues from it.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, Self

from runner.errors import RunNotFound, StorageError
from runner.runs.resolve import run_of_id
from runner.service.errors import TooManyUploads, UploadConflict, UploadTooLarge
from runner.service.jobs.store import lock_folder
from runner.service.upload_model import Announcement, Completion, Upload, UploadLimits
from runner.service.verification import Verifier
from runner.util.files import storage_errors, sync, write_object

FOLDER: Final = ".uploads"
STATE_FILE: Final = "upload.json"
BODY_FILE: Final = "body"
CLEANUP_SECONDS: Final = 600.0
"""Time between searches for uploads to forget."""
_DISK: Final = "the server's disk"
"""What a client learns of the place of an error."""


class Uploads:
    """The uploads into one recordings folder; thread-safe.

    Args:
        recordings: the recordings folder; created if it is missing.
        limits: what is accepted.
        on_verified: called with each upload that was verified, by another thread.

    Raises:
        StorageError: the folder cannot be written.
        RunnerError: another server accepts uploads into it.
    """

    def __init__(
        self,
        recordings: Path,
        limits: UploadLimits = UploadLimits(),  # noqa: B008 - frozen
        on_verified: Callable[[Upload], object] = lambda _: None,
    ) -> None:
        self.limits, self._on_verified = limits, on_verified
        self._recordings, self._folder = recordings, recordings / FOLDER
        self._lock = threading.RLock()
        """Held for moments only, never during disk access: the server's event loop may wait for it."""
        self._begin_lock = threading.Lock()
        """Held while an upload begins, so that the same bytes do not begin twice."""
        self._cleaned = float("-inf")
        self._in_use: set[str] = set()
        self._file_lock = lock_folder(recordings, f"{FOLDER}/lock")
        self._uploads = {upload.upload_id: upload for upload in _read_uploads(self._folder)}
        self._verifier, self._threads = Verifier(), ThreadPoolExecutor(1, "verification")
        self._forget()
        for upload in self.all():
            if upload.state == "verifying":
                self._threads.submit(self._verify, upload)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop; an unfinished verification is repeated by the next server."""
        self._verifier.stop()
        self._threads.shutdown(wait=True, cancel_futures=True)
        self._file_lock.release()

    def all(self) -> list[Upload]:
        """Return every upload, the newest first."""
        with self._lock:
            return sorted(self._uploads.values(), key=lambda upload: upload.created, reverse=True)

    def get(self, upload_id: str, owner: str) -> Upload:
        """Return an upload of this owner.

        Raises:
            RunNotFound: there is none with this id, or it is another owner's.
        """
        with self._lock:
            upload = self._uploads.get(upload_id)
        if upload is None or not secrets.compare_digest(upload.owner.encode(), owner.encode()):
            raise RunNotFound("no such upload: it was deleted, is long over, or belongs to another token.")
        return upload

    def offset(self, upload: Upload) -> int:
        """Return how many bytes of it were received."""
        if upload.state != "receiving":
            return upload.size or 0
        with storage_errors(_DISK):
            return self._body(upload).stat().st_size

    def begin(self, owner: str, announced: Announcement) -> tuple[Upload, bool]:
        """Return the upload of what is announced, and whether it is a new one.

        The same digest from the same owner is the same upload. A run that is in the recordings folder already
        is stored at once.

        Raises:
            UploadTooLarge, TooManyUploads: it is not accepted.
            StorageError: the disk has no room.
        """
        self._forget()
        with self._begin_lock:
            same = (owner, announced.digest, announced.size)
            for known in self.all() if announced.digest else ():
                if (known.owner, known.announced.digest, known.announced.size) != same:
                    continue
                if not known.is_over:
                    return known, False
                if known.state == "stored" and run_of_id(known.run_id, self._recordings) is not None:
                    return known.stored(known.run_id, already=True), False
            created = datetime.now(UTC).isoformat(timespec="milliseconds")
            upload = Upload(
                upload_id=secrets.token_hex(16), owner=owner, created=created, announced=announced
            )
            run = run_of_id(announced.run_id, self._recordings) if announced.content_digest else None
            if run is not None and run.summary.content_digest == announced.content_digest:
                upload = upload.stored(run.run_id, already=True)
            else:
                self._check_limits(owner, announced.size or 0)
            with storage_errors(_DISK):
                (self._folder / upload.upload_id).mkdir(parents=True)
                self._body(upload).touch()
            self._save(upload)
        return upload, True

    def append(self, upload_id: str, owner: str, offset: int, data: bytes | bytearray, more: int = 0) -> int:
        """Append bytes, and return the offset after them. Of bytes that are too many, none is written.

        Args:
            upload_id: the upload.
            owner: its owner.
            offset: where the bytes begin, which must be where the received ones end.
            data: the bytes.
            more: how many are announced to follow; if there is no room for them, the sender learns it now.

        Raises:
            UploadConflict: the bytes do not follow those that were received.
            UploadTooLarge: they are more than announced, or than the server accepts.
            StorageError: the disk is full, apart from the reserve, or fails; what was written stays.
        """
        with self._exclusive(upload_id, owner) as upload:
            received = self.offset(upload)
            if upload.state != "receiving" or offset != received:
                found = f"found bytes from {offset:,} on"
                raise UploadConflict(f"{found}, expected {received:,} ({upload.state}).")
            limit = self.limits.max_bytes if upload.size is None else upload.size
            if (end := offset + len(data) + more) > limit:
                raise UploadTooLarge(f"found {end:,} bytes, expected at most {limit:,}.")
            self._require_free(len(data) + more)
            with storage_errors(_DISK), self._body(upload).open("ab", buffering=0) as stream:
                view = memoryview(data)
                while view:
                    view = view[os.write(stream.fileno(), view) :]
        return offset + len(data)

    def complete(self, upload_id: str, owner: str, completion: Completion) -> Upload:
        """Finish an upload: it is synced to disk, and queued for verification. Returns its new state.

        Raises:
            UploadConflict: bytes are missing, or another digest was announced or completed.
        """
        with self._exclusive(upload_id, owner) as upload:
            if upload.state != "receiving":
                if upload.completion is not None and upload.completion.digest != completion.digest:
                    raise UploadConflict("the upload was completed with another digest; begin another one.")
                return upload
            if (received := self.offset(upload)) != completion.size:
                raise UploadConflict(
                    f"found {received:,} bytes, expected the {completion.size:,} of the completion."
                )
            if upload.announced.digest not in (None, completion.digest):
                raise UploadConflict("found another digest than the one announced; begin another upload.")
            with storage_errors(_DISK):
                sync(self._body(upload))
            completed = upload.completed(completion)
            self._save(completed)
        self._threads.submit(self._verify, completed)
        return completed

    def delete(self, upload_id: str, owner: str) -> None:
        """Forget an upload, and remove what was received.

        Raises:
            UploadConflict: it is being verified, or changed by another request.
        """
        with self._exclusive(upload_id, owner) as upload:
            if upload.state == "verifying":
                raise UploadConflict("the upload is being verified; wait for its end.")
            with self._lock:
                del self._uploads[upload_id]
            shutil.rmtree(self._folder / upload_id, ignore_errors=True)

    @contextlib.contextmanager
    def _exclusive(self, upload_id: str, owner: str) -> Iterator[Upload]:
        """Yield an upload that no other request changes during the block."""
        with self._lock:
            upload = self.get(upload_id, owner)
            if upload_id in self._in_use:
                raise UploadConflict("another request changes this upload; wait for its end.")
            self._in_use.add(upload_id)
        try:
            yield upload
        finally:
            with self._lock:
                self._in_use.discard(upload_id)

    def _body(self, upload: Upload) -> Path:
        return self._folder / upload.upload_id / BODY_FILE

    def _write(self, upload: Upload) -> None:
        with storage_errors(_DISK):
            write_object(self._folder / upload.upload_id / STATE_FILE, upload.model_dump(mode="json"))

    def _save(self, upload: Upload) -> None:
        self._write(upload)
        with self._lock:
            self._uploads[upload.upload_id] = upload

    def _check_limits(self, owner: str, size: int) -> None:
        limits = self.limits
        if size > limits.max_bytes:
            raise UploadTooLarge(f"found {size:,} bytes, expected at most {limits.max_bytes:,}.")
        owners = [upload.owner for upload in self.all() if not upload.is_over]
        if owners.count(owner) >= limits.max_open_each:
            raise TooManyUploads(
                f"{limits.max_open_each:,} of your uploads are open, the maximum of a client; complete or "
                "delete some."
            )
        if len(owners) >= limits.max_open:
            raise TooManyUploads(f"{limits.max_open:,} uploads are open; try again when some are done.")
        self._require_free(size)

    def _require_free(self, size: int) -> None:
        free = shutil.disk_usage(self._folder).free - self.limits.spare_bytes
        if size > free:
            raise StorageError(f"the server has room for {max(free, 0):,} bytes, expected {size:,}.")

    def _verify(self, upload: Upload) -> None:
        """Verify an upload and save the result; the bytes are removed when they are needed no more."""
        verified = self._verifier.verify(upload, self._body(upload), self._recordings)
        if verified is None:
            return  # the server is stopping
        with contextlib.suppress(StorageError):  # after a restart it is verified again, with the same result
            self._write(verified)
        if verified.is_over:
            with contextlib.suppress(OSError):  # removed with the rest of it, when it is forgotten
                self._body(verified).unlink(missing_ok=True)
        try:
            self._on_verified(verified)
        finally:
            with self._lock:
                self._uploads[upload.upload_id] = verified

    def _forget(self) -> None:
        """Forget uploads that receive nothing any more, are long over, or are over and too many."""
        over = [upload for upload in reversed(self.all()) if upload.is_over]
        forgotten = over[: -self.limits.max_open]
        if time.monotonic() - self._cleaned > CLEANUP_SECONDS:
            self._cleaned = time.monotonic()
            for upload in self.all():
                days = self.limits.over_days if upload.is_over else self.limits.idle_days
                if self._last_change(upload) < time.time() - days * 86_400:
                    forgotten.append(upload)
        for upload in forgotten:
            with contextlib.suppress(UploadConflict, RunNotFound):  # in verification or use, or gone
                self.delete(upload.upload_id, upload.owner)

    def _last_change(self, upload: Upload) -> float:
        """Return when an upload last changed, in seconds since 1970."""
        times = [0.0]
        for path in (self._body(upload), self._folder / upload.upload_id / STATE_FILE):
            with contextlib.suppress(OSError):
                times.append(path.stat().st_mtime)
        return max(times)


def _read_uploads(folder: Path) -> Iterator[Upload]:
    """Yield the uploads in a folder; what is no upload is removed."""
    for entry in [entry for entry in folder.iterdir() if entry.is_dir()]:
        try:
            yield Upload.model_validate_json((entry / STATE_FILE).read_bytes())
        except (OSError, ValueError):
            shutil.rmtree(entry, ignore_errors=True)
