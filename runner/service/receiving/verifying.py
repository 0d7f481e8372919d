"""Verifying an upload, by a process of its own that has bounds and may die; what passes becomes a run.

    python -m runner.service.receiving.verifying recordings/.uploads/4f0c… recordings

prints its verdict as JSON.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from filelock import FileLock

from runner.errors import RunnerError, StorageError
from runner.recording.labels import labels_from
from runner.service.receiving.model import BODY_FILE, Completion, Told, ToldLabels, read_upload
from runner.service.settings import without_folders
from runner.util.files import hash_of

PATIENCE_SECONDS: Final = 120.0
"""A verification may last so long,"""
BYTES_A_SECOND: Final = 2 << 20
"""and longer the more there is to verify."""
MOST_MEMORY: Final = 2 << 30
_LOCK_FILE: Final = "verifying.lock"
_STOPPED: Final = {
    -getattr(signal, name) for name in ("SIGTERM", "SIGINT", "SIGHUP") if hasattr(signal, name)
}
"""How a process ends that is stopped together with the server."""


@dataclass(frozen=True)
class Verdict:
    """What came of a verification."""

    run_id: str = ""
    """The run that it became."""
    already: bool = False
    """Whether that run had been there before."""
    problem: str = ""
    """Why it is no run; empty if it is."""
    try_again: bool = False
    """Whether that lies with the server: its disk is full."""


class Verifier:
    """Starts the processes, and ends them with the server."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._running: set[subprocess.Popen[bytes]] = set()
        self._stopping = False

    def verify(self, folder: Path, recordings: Path) -> Verdict | None:
        """Verify the upload in a folder; None if the server is stopped meanwhile."""
        with self._lock:
            if self._stopping:
                return None
            try:
                process = _started(folder, recordings)
            except OSError as error:
                return Verdict(
                    problem=f"the server has no process for it ({error.strerror}).", try_again=True
                )
            self._running.add(process)
        try:
            return self._outcome(process, PATIENCE_SECONDS + _size(folder / BODY_FILE) / BYTES_A_SECOND)
        finally:
            with self._lock:
                self._running.discard(process)

    def stop(self) -> None:
        """End what runs, and begin nothing more."""
        with self._lock:
            self._stopping = True
            for process in self._running:
                process.kill()

    def _outcome(self, process: subprocess.Popen[bytes], seconds: float) -> Verdict | None:
        try:
            said, _ = process.communicate(timeout=seconds)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            return Verdict(
                problem=f"its verification was ended after {seconds:,.0f} s, more than any run needs."
            )
        if self._stopping or process.returncode in _STOPPED:
            return None
        if process.returncode:
            return Verdict(problem=f"its verification failed (exit code {process.returncode}).")
        return Verdict(**json.loads(said))


def _started(folder: Path, recordings: Path) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-m", __name__, os.fspath(folder), os.fspath(recordings)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # Ctrl-C is for the server, which then stops it
    )


def judge(folder: Path, recordings: Path) -> Verdict:
    """Verify the upload in a folder, and make it a run if it passes."""
    body = folder / BODY_FILE
    with FileLock(folder / _LOCK_FILE):  # of a server that was killed, the verification may still go on
        try:
            completion = read_upload(folder).completion
            if completion is None or hash_of(body)[1] != completion.digest:
                return Verdict(
                    problem="found another digest than was said: bytes changed on their way; send it again."
                )
            return _taken(body, completion, recordings)
        except StorageError as error:
            return Verdict(problem=_without_paths(error, body, recordings), try_again=True)
        except RunnerError as error:
            return Verdict(problem=_without_paths(error, body, recordings))
        except OSError as error:
            return Verdict(problem=f"the server's disk cannot be used ({error.strerror}).", try_again=True)


def _taken(body: Path, completion: Completion, recordings: Path) -> Verdict:
    """Import a recording into the folder of runs.

    Raises:
        RunnerError: it is damaged, or another run has its id.
    """
    from runner.runs.importing import import_recording

    details = _said(completion) if completion.run != Told() else None
    labels = labels_from(completion.labels.model_dump()) if completion.labels != ToldLabels() else None
    imported = import_recording(body, recordings, details, labels)
    return Verdict(imported.run.run_id, imported.already)


def _said(completion: Completion) -> dict[str, Any]:
    """Return what was told of a run, in the form of `run.json`."""
    told = completion.run.model_dump(exclude_none=True)
    summary = {key: told.pop(key) for key in ("seconds", "error") if key in told}
    return told | {"summary": summary}


def _without_paths(error: RunnerError, body: Path, recordings: Path) -> str:
    """Return what is wrong without saying where the server keeps what."""
    return without_folders(str(error).replace(os.fspath(body), "the upload"), recordings)


def _size(path: Path) -> int:
    with contextlib.suppress(OSError):
        return path.stat().st_size
    return 0


def _bound() -> None:
    """Bound what this process may take, and let others go first."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        os.nice(5)
        resource.setrlimit(resource.RLIMIT_DATA, (MOST_MEMORY, MOST_MEMORY))


if __name__ == "__main__":
    _bound()
    print(json.dumps(asdict(judge(Path(sys.argv[1]), Path(sys.argv[2])))))
