"""Verification of an upload, in a child process with limits; what passes becomes a run."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from filelock import FileLock

from runner.errors import RunnerError, StorageError
from runner.recording.labels import labels_from
from runner.runs.importing import import_recording
from runner.service.processes import PRELOADED
from runner.service.settings import without_folders
from runner.service.upload_model import Completion, RunDetails, RunLabels
from runner.util.files import hash_of
from runner.util.processes import CallFailed, ChildProcess, TimedOut, start_method

MAX_SECONDS: Final = 120.0
BYTES_A_SECOND: Final = 2 << 20
"""The time limit grows with the size of the upload."""
MEMORY_BYTES: Final = 2 << 30
NICENESS: Final = 5
_LOCK_FILE: Final = "verifying.lock"


@dataclass(frozen=True)
class Verdict:
    """The result of a verification."""

    run_id: str = ""
    """The run that it became."""
    already: bool = False
    """Whether that run had been there before."""
    problem: str = ""
    """Why it is no run; empty if it is."""
    try_again: bool = False
    """Whether the problem is the server's, such as a full disk."""


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

    def verify(self, body: Path, recordings: Path, completion: Completion) -> Verdict | None:
        """Verify an uploaded file, and make it a run if it passes; None if `stop` was called meanwhile."""
        seconds = MAX_SECONDS + completion.size / BYTES_A_SECOND
        try:
            with ChildProcess(MEMORY_BYTES, start_method(PRELOADED)) as child:
                with self._lock:
                    self._child = child
                    if self._is_stopping:
                        return None
                return child.call(verify, seconds, body, recordings, completion)
        except CallFailed as error:
            problem = f"its verification failed: {error}"
            if isinstance(error, TimedOut):
                problem = f"its verification was stopped after {seconds:,.0f} s, more than any run needs."
            return None if self._is_stopping else Verdict(problem=problem)
        except OSError as error:
            return Verdict(problem=f"the server has no process for it ({error.strerror}).", try_again=True)
        finally:
            with self._lock:
                self._child = None


def verify(body: Path, recordings: Path, completion: Completion) -> Verdict:
    """Verify an uploaded file, and make it a run if it passes; for a process of its own."""
    with contextlib.suppress(OSError, AttributeError):  # not on Windows
        os.nice(NICENESS)
        # A signal to stop may go to all processes of the service, which then kills this one itself: its end
        # must not look like that of a recording that is too large.
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with FileLock(body.with_name(_LOCK_FILE)):  # the verification of a server that was killed may still run
        try:
            if hash_of(body)[1] != completion.digest:
                return Verdict(
                    problem="found another digest than sent: bytes changed on the way; send it again."
                )
            details = labels = None  # an exported recording has its own
            if completion.run != RunDetails():
                details = completion.run.model_dump(exclude_none=True)
                details["summary"] = {key: details.pop(key) for key in ("seconds", "error") if key in details}
            if completion.labels != RunLabels():
                labels = labels_from(completion.labels.model_dump())
            imported = import_recording(body, recordings, details, labels)
            return Verdict(imported.run.run_id, imported.already)
        except RunnerError as error:
            problem = without_folders(str(error).replace(os.fspath(body), "the upload"), recordings)
            return Verdict(problem=problem, try_again=isinstance(error, StorageError))
        except OSError as error:
            return Verdict(problem=f"the server's disk cannot be used ({error.strerror}).", try_again=True)
