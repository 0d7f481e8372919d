"""Uploads on disk: what each is, and its bytes so far.

    recordings/.uploads/4f0c…/upload.json    what it is, and where it stands; replaced whole
    recordings/.uploads/4f0c…/body           the bytes so far: its length is the offset to go on from

The folder is the truth: a server that was killed goes on where it stands.
"""

from __future__ import annotations

import contextlib
import shutil
import threading
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from datetime import datetime
from pathlib import Path
from typing import BinaryIO, Final

from runner.errors import StorageError
from runner.service.jobs.store import lock_folder
from runner.service.receiving.appending import on_disk
from runner.service.receiving.model import BODY_FILE, STATE_FILE, Upload, read_upload
from runner.util.files import sync, write_object

FOLDER: Final = ".uploads"
LOCK_FILE: Final = "lock"


class UploadFolder:
    """The uploads into a folder of runs, as they are on disk; no other process has them.

    Args:
        recordings: the folder of runs; made if it is missing.

    Raises:
        StorageError: the folder cannot be written.
        RunnerError: another server takes uploads into it.
    """

    def __init__(self, recordings: Path) -> None:
        self._path = recordings / FOLDER
        self._lock = lock_folder(recordings, f"{FOLDER}/{LOCK_FILE}")
        self._guard = threading.Lock()
        self._flushing: dict[str, list[Future[None]]] = {}
        self._flusher = ThreadPoolExecutor(1, "flushing")

    def close(self) -> None:
        """Let another process have them."""
        self._flusher.shutdown(wait=True, cancel_futures=True)
        self._lock.release()

    def of(self, upload_id: str) -> Path:
        """Return the folder of an upload; it need not exist."""
        return self._path / upload_id

    def read(self) -> Iterator[Upload]:
        """Yield the uploads there are; of which it is not known what they are, they are removed."""
        for entry in list(self._path.iterdir()):
            if not entry.is_dir():
                continue
            try:
                yield read_upload(entry)
            except (OSError, ValueError):
                shutil.rmtree(entry, ignore_errors=True)

    def add(self, upload: Upload) -> None:
        """Begin an upload, without a byte yet.

        Raises:
            StorageError: the disk cannot be written.
        """
        with on_disk():
            self.of(upload.upload_id).mkdir(parents=True)
            self._body(upload.upload_id).touch()
        self.write(upload)

    def write(self, upload: Upload) -> None:
        """Write down where an upload stands.

        Raises:
            StorageError: the disk cannot be written; what it says is as before.
        """
        with on_disk():
            write_object(self.of(upload.upload_id) / STATE_FILE, upload.model_dump(mode="json"))

    def remove(self, upload_id: str) -> None:
        """Remove all that there is of an upload."""
        with self._guard:
            self._flushing.pop(upload_id, None)
        shutil.rmtree(self.of(upload_id), ignore_errors=True)

    def remove_body(self, upload_id: str) -> None:
        """Remove the bytes of an upload."""
        self._body(upload_id).unlink(missing_ok=True)

    def length(self, upload_id: str) -> int:
        """Return how many bytes of an upload are there.

        Raises:
            StorageError: the disk cannot be read.
        """
        with on_disk():
            return self._body(upload_id).stat().st_size

    def open(self, upload_id: str) -> BinaryIO:
        """Open the bytes of an upload, for more of them.

        Raises:
            StorageError: the disk cannot be written.
        """
        with on_disk():
            return self._body(upload_id).open("ab", buffering=0)

    def begin_flush(self, upload_id: str) -> None:
        """Begin to put on disk what came, while more of it comes."""
        with self._guard:
            flushed = self._flusher.submit(sync, self._body(upload_id))
            self._flushing.setdefault(upload_id, []).append(flushed)

    def flush(self, upload_id: str) -> None:
        """Put on disk what came; return when all of it is there.

        Raises:
            StorageError: the disk cannot be written.
        """
        with self._guard:
            begun = self._flushing.pop(upload_id, [])
        with on_disk():
            for flushed in begun:
                if not flushed.cancel():
                    flushed.result()
            sync(self._body(upload_id))

    def require_free(self, size: int, spare: int) -> None:
        """Refuse what would leave too little of the disk.

        Args:
            size: bytes to come.
            spare: bytes that are left free.

        Raises:
            StorageError: there is no room.
        """
        free = shutil.disk_usage(self._path).free - spare
        if size > free:
            raise StorageError(f"the server has room for {max(free, 0):,} bytes, expected {size:,}.")

    def touched(self, upload: Upload) -> float:
        """Return when something of an upload last changed, in seconds."""
        times = [datetime.fromisoformat(upload.created).timestamp()]
        for path in (self.of(upload.upload_id) / STATE_FILE, self._body(upload.upload_id)):
            with contextlib.suppress(OSError):
                times.append(path.stat().st_mtime)
        return max(times)

    def _body(self, upload_id: str) -> Path:
        return self.of(upload_id) / BODY_FILE
