"""Uploads: recordings on their way into a folder of runs; what may be done with one when.

An upload is received, piece by piece and in order; then verified, by a process of its own; and then stored,
which is one renaming, or refused.
"""

from __future__ import annotations

import contextlib
import secrets
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, Self

from runner.errors import RunNotFound, StorageError
from runner.recording.run_file import Summary
from runner.runs.run import run_of_id
from runner.service.logs import LOG
from runner.service.receiving.appending import Appending
from runner.service.receiving.folder import UploadFolder
from runner.service.receiving.model import (
    Announcement,
    Completion,
    Conflict,
    State,
    TooLarge,
    TooMany,
    Upload,
    UploadLimits,
)
from runner.service.receiving.verifying import Verdict, Verifier

FLUSHED_BYTES: Final = 8 << 20
"""A request that brought so much is put on disk while the next one comes, not only at the end."""
SWEEP_SECONDS: Final = 600.0
"""So often is looked for uploads that are to be forgotten."""


class Uploads:
    """The uploads into one folder of runs; safe to use from several threads.

    Args:
        recordings: the folder of runs; made if it is missing.
        limits: what is taken.
        settled: told of each upload that was verified, by another thread.

    Raises:
        StorageError: the folder cannot be written.
        RunnerError: another server takes uploads into it.
    """

    def __init__(
        self,
        recordings: Path,
        limits: UploadLimits = UploadLimits(),  # noqa: B008 - frozen
        settled: Callable[[Upload], object] = lambda _: None,
    ) -> None:
        self.limits = limits
        self._tell = settled
        self._recordings = recordings
        self._guard = threading.RLock()
        """Held for moments only, never while the disk is used: the server's event loop may wait for it."""
        self._beginning = threading.Lock()
        """Held while an upload begins, so that the same bytes do not begin twice."""
        self._swept = 0.0
        self._used: set[str] = set()
        self._folder = UploadFolder(recordings)
        self._uploads = {upload.upload_id: upload for upload in self._folder.read()}
        self._verifier = Verifier()
        self._pool = ThreadPoolExecutor(limits.verifiers, "verifying")
        self._forget_old()
        for upload in self._uploads.values():
            if upload.state == "verifying":
                self._pool.submit(self._verify, upload.upload_id)

    def close(self) -> None:
        """Stop; what is being verified will be verified anew."""
        self._verifier.stop()
        self._pool.shutdown(wait=True, cancel_futures=True)
        self._folder.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    # --- what is known --------------------------------------------------------------------------------

    def all(self) -> list[Upload]:
        """Return every upload that is known, the newest first."""
        with self._guard:
            return sorted(self._uploads.values(), key=lambda upload: upload.created, reverse=True)

    def get(self, upload_id: str, owner: str) -> Upload:
        """Return an upload of this owner.

        Raises:
            RunNotFound: there is none of this id, or it is another's.
        """
        with self._guard:
            upload = self._uploads.get(upload_id)
        if upload is None or not secrets.compare_digest(upload.owner.encode(), owner.encode()):
            raise RunNotFound("no such upload: it was given up, is long over, or belongs to another token.")
        return upload

    def offset(self, upload: Upload) -> int:
        """Return how many bytes of it are there."""
        if upload.state == "receiving":
            return self._folder.length(upload.upload_id)
        return upload.size or 0

    # --- receiving ------------------------------------------------------------------------------------

    def begin(self, owner: str, announced: Announcement) -> tuple[Upload, bool]:
        """Return the upload of what is announced, and whether it is a new one.

        The same digest from the same owner is the same upload. What is in the folder of runs already is
        stored at once.

        Raises:
            TooLarge, TooMany: it is not taken.
            StorageError: there is no room.
        """
        if time.monotonic() - self._swept > SWEEP_SECONDS:
            self._forget_old()
        with self._beginning:
            known = self._known(owner, announced)
            if known is not None:
                stored = known.state == "stored"
                return known.model_copy(update={"already": True}) if stored else known, False
            run_id = self._stored_as(announced)
            if not run_id:
                self._check_room(owner, announced.size)
            upload = Upload(
                upload_id=secrets.token_hex(16),
                owner=owner,
                created=datetime.now(UTC).isoformat(timespec="milliseconds"),
                state="stored" if run_id else "receiving",
                announced=announced,
                run_id=run_id,
                already=bool(run_id),
            )
            self._folder.add(upload)
            with self._guard:
                forgotten = self._forget_some()
                self._uploads[upload.upload_id] = upload
        for upload_id in forgotten:
            self._folder.remove(upload_id)
        return upload, True

    @contextlib.contextmanager
    def appending(self, upload_id: str, owner: str, offset: int, length: int | None) -> Iterator[Appending]:
        """Give what takes the bytes from an offset on; what was taken stays, however this ends.

        Args:
            upload_id: which upload.
            owner: whose.
            offset: where the bytes begin, which must be where those that are there end.
            length: how many are said to come; None if that is not said.

        Raises:
            Conflict: they do not follow, or others are coming right now.
            TooLarge: they would be too many.
            StorageError: there is no room.
        """
        with self._in_use(upload_id, owner) as upload:
            there = self.offset(upload)
            if upload.state != "receiving" or offset != there:
                raise Conflict(f"found bytes from {offset:,} on, expected {there:,} ({upload.state}).")
            most = self.limits.most_bytes if upload.size is None else upload.size
            if offset + (length or 0) > most:
                raise TooLarge(f"found {offset + (length or 0):,} bytes, expected at most {most:,}.")
            self._check_free(length or 0)
            with self._folder.open(upload_id) as stream:
                sink = Appending(stream.fileno(), most - offset, self._check_free)
                yield sink
            if sink.written >= FLUSHED_BYTES:
                self._folder.begin_flush(upload_id)

    def complete(self, upload_id: str, owner: str, completion: Completion) -> Upload:
        """Say that all is there; it is put on disk, and verified. Returns the upload as it then is.

        Raises:
            Conflict: it is not all there, or another digest was announced or completed.
        """
        with self._in_use(upload_id, owner) as upload:
            if upload.state != "receiving":
                return _repeated(upload, completion)
            if (there := self.offset(upload)) != completion.size:
                raise Conflict(f"found {there:,} bytes, expected the {completion.size:,} of the completion.")
            if upload.announced.digest not in (None, completion.digest):
                raise Conflict("found another digest than the one announced; begin another upload.")
            self._folder.flush(upload_id)
            changes = {"state": "verifying", "completion": completion, "problem": ""}
            completed = upload.model_copy(update=changes)
            self._folder.write(completed)
            with self._guard:
                self._uploads[upload_id] = completed
        self._pool.submit(self._verify, upload_id)
        return completed

    def give_up(self, upload_id: str, owner: str) -> None:
        """Forget an upload, and remove what was received.

        Raises:
            Conflict: it is being received or verified.
        """
        with self._in_use(upload_id, owner) as upload:
            if upload.state == "verifying":
                raise Conflict("the upload is being verified; wait for its end.")
            with self._guard:
                del self._uploads[upload_id]
            self._folder.remove(upload_id)

    @contextlib.contextmanager
    def _in_use(self, upload_id: str, owner: str) -> Iterator[Upload]:
        """Give an upload that nobody else changes meanwhile."""
        with self._guard:
            upload = self.get(upload_id, owner)
            if upload_id in self._used:
                raise Conflict("another request sends to this upload; wait for its end.")
            self._used.add(upload_id)
        try:
            yield upload
        finally:
            with self._guard:
                self._used.discard(upload_id)

    # --- inside ---------------------------------------------------------------------------------------

    def _known(self, owner: str, announced: Announcement) -> Upload | None:
        """Return the upload of the same bytes by the same owner, unless it came to nothing."""
        if announced.digest is None:
            return None
        for upload in self.all():
            same = (upload.announced.digest, upload.announced.size) == (announced.digest, announced.size)
            if same and upload.owner == owner and upload.state != "refused":
                gone = upload.state == "stored" and self._run(upload.run_id) is None
                if not gone:
                    return upload
        return None

    def _stored_as(self, announced: Announcement) -> str:
        """Return the id of the run that has the announced content, if it is there already."""
        summary = self._run(announced.run_id)
        there = summary and summary.content_digest
        return announced.run_id if there and there == announced.content_digest else ""

    def _run(self, run_id: str) -> Summary | None:
        """Return the summary of a run, None if there is none."""
        run = run_of_id(run_id, self._recordings)
        return None if run is None else run.summary

    def _check_room(self, owner: str, size: int | None) -> None:
        if (size or 0) > self.limits.most_bytes:
            raise TooLarge(f"found {size:,} bytes, expected at most {self.limits.most_bytes:,}.")
        owners = [upload.owner for upload in self.all() if upload.state in ("receiving", "verifying")]
        if owners.count(owner) >= self.limits.most_open_each:
            raise TooMany(
                f"{self.limits.most_open_each:,} of your uploads are open, which is all that a client may "
                "have; complete some or give them up."
            )
        if len(owners) >= self.limits.most_open:
            raise TooMany(f"{self.limits.most_open:,} uploads are open; try again when some are done.")
        self._check_free(size or 0)

    def _check_free(self, size: int) -> None:
        self._folder.require_free(size, self.limits.spare_bytes)

    def _verify(self, upload_id: str) -> None:
        """Have an upload verified, and say what came of it; the bytes go once they are needed no more."""
        with self._guard:
            upload = self._uploads.get(upload_id)
        if upload is None or upload.state != "verifying":
            return
        try:
            verdict = self._verifier.verify(self._folder.of(upload_id), self._recordings)
        except Exception:  # or it would stand as being verified until the server is started again
            LOG.exception("verification", extra={"upload": upload_id})
            problem = "something unexpected went wrong while it was verified; complete it again."
            verdict = Verdict(problem=problem, try_again=True)
        if verdict is None:
            return  # the server stops
        settled = upload.model_copy(update=_settled(verdict))
        with contextlib.suppress(StorageError):  # after a restart it is verified once more, to the same end
            self._folder.write(settled)
        if settled.state != "receiving":
            with contextlib.suppress(OSError):  # removed with the rest of it, when it is forgotten
                self._folder.remove_body(upload_id)
        try:
            self._tell(settled)
        finally:
            with self._guard:
                self._uploads[upload_id] = settled

    def _forget_old(self) -> None:
        """Forget the uploads to which nothing comes any more, and those that are long over."""
        self._swept, now = time.monotonic(), time.time()
        for upload in self.all():
            if upload.state == "verifying":
                continue
            days = (now - self._folder.touched(upload)) / 86400
            most = self.limits.idle_days if upload.state == "receiving" else self.limits.kept_days
            with self._guard:
                is_same = self._uploads.get(upload.upload_id) is upload
                if days <= most or not is_same or upload.upload_id in self._used:
                    continue
                del self._uploads[upload.upload_id]
            self._folder.remove(upload.upload_id)

    def _forget_some(self) -> list[str]:
        """Forget the oldest uploads that are over, but for as many as may be open; return their ids."""
        over = [upload for upload in self._uploads.values() if upload.state in ("stored", "refused")]
        oldest = sorted(over, key=lambda upload: upload.created)[: -self.limits.most_open]
        for upload in oldest:
            del self._uploads[upload.upload_id]
        return [upload.upload_id for upload in oldest]


def _settled(verdict: Verdict) -> dict[str, Any]:
    """Return what a verdict makes of an upload: a run, nothing, or one to be completed again."""
    if verdict.try_again:
        return {"state": "receiving", "completion": None, "problem": verdict.problem}
    state: State = "refused" if verdict.problem else "stored"
    return {
        "state": state,
        "run_id": verdict.run_id,
        "already": verdict.already,
        "problem": verdict.problem,
    }


def _repeated(upload: Upload, completion: Completion) -> Upload:
    """Return an upload that was completed before, in the same way."""
    if upload.completion is not None and upload.completion.digest != completion.digest:
        raise Conflict("the upload was completed with another digest; begin another one.")
    return upload
