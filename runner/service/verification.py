"""Verification of an upload, in a child process with limits; what passes becomes a run."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from pathlib import Path
from typing import Final

from filelock import FileLock

from runner.errors import RunnerError, StorageError
from runner.recording.labels import labels_from
from runner.runs.importing import import_recording
from runner.service.logs import LOG
from runner.service.processes import PRELOADED
from runner.service.settings import without_folders
from runner.service.upload_model import RunDetails, RunLabels, Upload
from runner.util.files import hash_of
from runner.util.processes import CallFailed, ChildProcess, TimedOut, process_context

MAX_SECONDS: Final = 120.0
BYTES_A_SECOND: Final = 2 << 20
"""The time limit grows with the size of the upload."""
MEMORY_BYTES: Final = 2 << 30
NICENESS: Final = 5
_LOCK_FILE: Final = "verifying.lock"


class Verifier:
    """Verifies uploads in a child process, one after the other."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._child: ChildProcess | None = None
        self._is_stopping = False

    def stop(self) -> None:
        """End the verification that runs, and start no more."""
        with self._lock:
            self._is_stopping = True
            if self._child is not None:
                self._child.kill()

    def verify(self, upload: Upload, body: Path, recordings: Path) -> Upload | None:
        """Return an upload after its verification, see `verify`; None if `stop` was called meanwhile."""
        seconds = MAX_SECONDS + (upload.size or 0) / BYTES_A_SECOND
        try:
            with ChildProcess(MEMORY_BYTES, process_context(PRELOADED)) as child:
                with self._lock:
                    self._child = child
                    if self._is_stopping:
                        return None
                return child.call(verify, seconds, upload, body, recordings)
        except TimedOut:
            return upload.refused(
                f"its verification was stopped after {seconds:,.0f} s, more than any needs."
            )
        except CallFailed as error:
            return None if self._is_stopping else upload.refused(f"its verification failed: {error}")
        except OSError as error:
            return upload.returned(f"the server has no process for it ({error.strerror}).")
        except Exception:  # else it would remain in verification until the server is started again
            LOG.exception("verification", extra={"upload": upload.upload_id})
            return upload.returned(
                "something unexpected went wrong while it was verified; complete it again."
            )


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
    with FileLock(body.with_name(_LOCK_FILE)):  # the verification of a server that was killed may still run
        try:
            sent = upload.completion
            if sent is None or hash_of(body)[1] != sent.digest:
                return upload.refused(
                    "found another digest than sent: bytes changed on the way; send it again."
                )
            details = labels = None  # an exported recording has its own
            if sent.run != RunDetails():
                details = sent.run.model_dump(exclude_none=True)
                details["summary"] = {key: details.pop(key) for key in ("seconds", "error") if key in details}
            if sent.labels != RunLabels():
                labels = labels_from(sent.labels.model_dump())
            imported = import_recording(body, recordings, details, labels)
            return upload.stored(imported.run.run_id, imported.already)
        except StorageError as error:
            return upload.returned(_problem(error, body, recordings))
        except RunnerError as error:
            return upload.refused(_problem(error, body, recordings))
        except OSError as error:
            return upload.returned(f"the server's disk cannot be used ({error.strerror}).")


def _problem(error: RunnerError, body: Path, recordings: Path) -> str:
    return without_folders(str(error).replace(os.fspath(body), "the upload"), recordings)
