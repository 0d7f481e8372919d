"""Uploads: recordings on their way into a recordings folder.

    recordings/.uploads/4f0c…/upload.json    the upload and its state; replaced atomically
    recordings/.uploads/4f0c…/body           the bytes so far: its length is the offset to continue from

An upload is received, in pieces and in order; then verified, by a child process; and then stored, which is
one renaming, or refused. The folder is the truth: a server that was killed continues from it.
"""

from __future__ import annotations

import contextlib
import json
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
from runner.service.logs import LOG
from runner.service.upload_model import (
    Announcement,
    Completion,
    Upload,
    UploadLimits,
)
from runner.service.verification import Verdict, Verifier
from runner.util.files import read_object, sync, write_object

FOLDER: Final = ".uploads"
STATE_FILE: Final = "upload.json"
BODY_FILE: Final = "body"
_MAX_STATE_BYTES: Final = 1 << 20
CLEANUP_SECONDS: Final = 600.0
"""Time between searches for uploads to forget."""


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
        for upload in self._uploads.values():
            if upload.state == "verifying":
                self._threads.submit(self._verify, upload.upload_id)

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
        with _disk_errors():
            return self._body(upload.upload_id).stat().st_size

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
            if (known := self._find(owner, announced)) is not None:
                return known.model_copy(update={"already": known.state == "stored"}), False
            run_id = announced.run_id if self._is_stored(announced) else ""
            if not run_id:
                self._require_room(owner, announced.size)
            upload = Upload(
                upload_id=secrets.token_hex(16),
                owner=owner,
                created=datetime.now(UTC).isoformat(timespec="milliseconds"),
                state="stored" if run_id else "receiving",
                announced=announced,
                run_id=run_id,
                already=bool(run_id),
            )
            with _disk_errors():
                (self._folder / upload.upload_id).mkdir(parents=True)
                self._body(upload.upload_id).touch()
            self._save(upload)
        return upload, True

    @contextlib.contextmanager
    def receive(
        self, upload_id: str, owner: str, offset: int, length: int | None
    ) -> Iterator[Callable[[bytes | bytearray], None]]:
        """Yield a function that appends bytes; what it has written stays, however the block ends.

        The function raises `UploadTooLarge` for more bytes than announced, of which it writes none, and
        `StorageError` if the disk is full, apart from the reserve, or fails.

        Args:
            upload_id: the upload.
            owner: its owner.
            offset: where the bytes begin, which must be where the received ones end.
            length: the announced number of bytes; None if unknown.

        Raises:
            UploadConflict: the bytes do not follow, or another request sends some right now.
            UploadTooLarge: they would be too many.
            StorageError: the disk has no room.
        """
        with self._exclusive(upload_id, owner) as upload:
            received = self.offset(upload)
            if upload.state != "receiving" or offset != received:
                raise UploadConflict(
                    f"found bytes from {offset:,} on, expected {received:,} ({upload.state})."
                )
            limit = self.limits.max_bytes if upload.size is None else upload.size
            if offset + (length or 0) > limit:
                raise UploadTooLarge(f"found {offset + (length or 0):,} bytes, expected at most {limit:,}.")
            self._require_free(length or 0)
            with _disk_errors():
                stream = self._body(upload_id).open("ab", buffering=0)

            def write(data: bytes | bytearray) -> None:
                nonlocal received
                if received + len(data) > limit:
                    raise UploadTooLarge("found more bytes than the upload was announced to have.")
                self._require_free(len(data))
                received += len(data)
                view = memoryview(data)
                with _disk_errors():
                    while view:
                        view = view[os.write(stream.fileno(), view) :]

            with stream:
                yield write

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
            with _disk_errors():
                sync(self._body(upload_id))
            changes = {"state": "verifying", "completion": completion, "problem": ""}
            completed = upload.model_copy(update=changes)
            self._save(completed)
        self._threads.submit(self._verify, upload_id)
        return completed

    def delete(self, upload_id: str, owner: str) -> None:
        """Forget an upload, and remove what was received.

        Raises:
            UploadConflict: it is being received or verified.
        """
        with self._exclusive(upload_id, owner) as upload:
            if upload.state == "verifying":
                raise UploadConflict("the upload is being verified; wait for its end.")
            self._remove(upload)

    @contextlib.contextmanager
    def _exclusive(self, upload_id: str, owner: str) -> Iterator[Upload]:
        """Yield an upload that no other request changes during the block."""
        with self._lock:
            upload = self.get(upload_id, owner)
            if upload_id in self._in_use:
                raise UploadConflict("another request sends to this upload; wait for its end.")
            self._in_use.add(upload_id)
        try:
            yield upload
        finally:
            with self._lock:
                self._in_use.discard(upload_id)

    def _body(self, upload_id: str) -> Path:
        return self._folder / upload_id / BODY_FILE

    def _write(self, upload: Upload) -> None:
        with _disk_errors():
            write_object(self._folder / upload.upload_id / STATE_FILE, upload.model_dump(mode="json"))

    def _save(self, upload: Upload) -> None:
        self._write(upload)
        with self._lock:
            self._uploads[upload.upload_id] = upload

    def _remove(self, upload: Upload) -> None:
        with self._lock:
            del self._uploads[upload.upload_id]
        shutil.rmtree(self._folder / upload.upload_id, ignore_errors=True)

    def _find(self, owner: str, announced: Announcement) -> Upload | None:
        """Return the owner's upload of the same bytes, unless it was refused, or its run was removed."""
        for upload in self.all() if announced.digest else ():
            if upload.owner != owner or upload.state == "refused":
                continue
            if (upload.announced.digest, upload.announced.size) != (announced.digest, announced.size):
                continue
            if upload.state != "stored" or run_of_id(upload.run_id, self._recordings) is not None:
                return upload
        return None

    def _is_stored(self, announced: Announcement) -> bool:
        run = run_of_id(announced.run_id, self._recordings)
        digest = None if run is None else run.summary.content_digest
        return bool(digest) and digest == announced.content_digest

    def _require_room(self, owner: str, size: int | None) -> None:
        limits = self.limits
        if (size or 0) > limits.max_bytes:
            raise UploadTooLarge(f"found {size:,} bytes, expected at most {limits.max_bytes:,}.")
        owners = [upload.owner for upload in self.all() if upload.state in ("receiving", "verifying")]
        if owners.count(owner) >= limits.max_open_each:
            raise TooManyUploads(
                f"{limits.max_open_each:,} of your uploads are open, the maximum of a client; complete or "
                "delete some."
            )
        if len(owners) >= limits.max_open:
            raise TooManyUploads(f"{limits.max_open:,} uploads are open; try again when some are done.")
        self._require_free(size or 0)

    def _require_free(self, size: int) -> None:
        free = shutil.disk_usage(self._folder).free - self.limits.spare_bytes
        if size > free:
            raise StorageError(f"the server has room for {max(free, 0):,} bytes, expected {size:,}.")

    def _verify(self, upload_id: str) -> None:
        """Verify an upload and save the result; the bytes are removed when they are needed no more."""
        with self._lock:
            upload = self._uploads.get(upload_id)
        if upload is None or upload.state != "verifying" or upload.completion is None:
            return
        try:
            verdict = self._verifier.verify(self._body(upload_id), self._recordings, upload.completion)
        except Exception:  # else it would remain in verification until the server is started again
            LOG.exception("verification", extra={"upload": upload_id})
            problem = "something unexpected went wrong while it was verified; complete it again."
            verdict = Verdict(problem=problem, try_again=True)
        if verdict is None:
            return  # the server is stopping
        changes: dict[str, object] = {"state": "receiving", "completion": None, "problem": verdict.problem}
        if not verdict.try_again:
            changes = {"state": "refused" if verdict.problem else "stored", "problem": verdict.problem}
            changes |= {"run_id": verdict.run_id, "already": verdict.already}
        verified = upload.model_copy(update=changes)
        with contextlib.suppress(StorageError):  # after a restart it is verified again, with the same result
            self._write(verified)
        if verified.state != "receiving":
            with contextlib.suppress(OSError):  # removed with the rest of it, when it is forgotten
                self._body(upload_id).unlink(missing_ok=True)
        try:
            self._on_verified(verified)
        finally:
            with self._lock:
                self._uploads[upload_id] = verified

    def _forget(self) -> None:
        """Forget uploads that receive nothing any more, are long over, or are over and too many."""
        over = [upload for upload in reversed(self.all()) if upload.state in ("stored", "refused")]
        forgotten = over[: -self.limits.max_open]
        if time.monotonic() - self._cleaned > CLEANUP_SECONDS:
            self._cleaned = time.monotonic()
            for upload in self.all():
                days = (time.time() - self._changed(upload)) / 86400
                limit = self.limits.idle_days if upload.state == "receiving" else self.limits.over_days
                if upload.state != "verifying" and days > limit:
                    forgotten.append(upload)
        for upload in forgotten:
            with (
                contextlib.suppress(UploadConflict, RunNotFound),
                self._exclusive(upload.upload_id, upload.owner),
            ):
                self._remove(upload)

    def _changed(self, upload: Upload) -> float:
        """Return when an upload last changed, in seconds since 1970."""
        times = [datetime.fromisoformat(upload.created).timestamp()]
        for name in (STATE_FILE, BODY_FILE):
            with contextlib.suppress(OSError):
                times.append((self._folder / upload.upload_id / name).stat().st_mtime)
        return max(times)


def _read_uploads(folder: Path) -> Iterator[Upload]:
    """Yield the uploads in a folder; what is no upload is removed."""
    for entry in [entry for entry in folder.iterdir() if entry.is_dir()]:
        try:
            state = read_object(entry / STATE_FILE, _MAX_STATE_BYTES)
            yield Upload.model_validate_json(json.dumps(state))
        except (OSError, ValueError):
            shutil.rmtree(entry, ignore_errors=True)


@contextlib.contextmanager
def _disk_errors() -> Iterator[None]:
    """Report an error of the disk to the client, without its place.

    Raises:
        StorageError: there was one.
    """
    try:
        yield
    except OSError as error:
        raise StorageError(f"the server's disk cannot be written ({error.strerror}).") from error
