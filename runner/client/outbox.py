"""The outbox: runs recorded here for a server, until it has them.

    ~/.local/state/dualtaxi/outbox/k3v9m2xq/    a run as in any recordings folder
    ~/.local/state/dualtaxi/outbox/k3v9m2xq/push.json    the server, and the upload that has begun

A run leaves it when the server has verified and stored it, not before.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import threading
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Final

from runner.client.address import find_token
from runner.client.backoff import ServerUnavailable
from runner.client.client import Client
from runner.client.connection import Report
from runner.client.upload_source import UploadStatus
from runner.errors import RunnerError
from runner.runs.locking import locked
from runner.runs.run import Run, list_runs
from runner.util.files import read_object, write_object

OUTBOX_VARIABLE: Final = "DUALTAXI_OUTBOX"
STATE_VARIABLE: Final = "XDG_STATE_HOME"
PUSH_FILE: Final = "push.json"
FOLLOW_SECONDS: Final = 1.0
AWAY_SECONDS: Final = 30.0
"""So long, at most, is waited before a server that was away is tried again."""
LAST_SECONDS: Final = 10.0
"""At the end of a run, a server that is away is waited for so long."""
_SENT: Final = ".sent-"
_MAX_FILE: Final = 1 << 16


def is_server(recordings: object) -> bool:
    """Return whether what is said to be a recordings folder is the address of a server."""
    return isinstance(recordings, str) and recordings.startswith(("http://", "https://"))


def outbox_folder() -> Path:
    """Return the outbox: the variable's folder, else one in the user's state folder; it need not exist."""
    if chosen := os.environ.get(OUTBOX_VARIABLE):
        return Path(chosen)
    base = os.environ.get(STATE_VARIABLE)
    return (Path(base) if base else Path.home() / ".local" / "state") / "dualtaxi" / "outbox"


def waiting(outbox: Path) -> list[tuple[Run, str]]:
    """Return the runs in an outbox that are over, the oldest first, each with its server.

    Raises:
        StorageError: the folder cannot be read.
    """
    for left in outbox.glob(f"{_SENT}*"):
        shutil.rmtree(left, ignore_errors=True)
    runs = [(run, _server_of(run)) for run in reversed(list_runs(outbox)) if run.status != "running"]
    return [(run, server) for run, server in runs if server]


def deliver(run: Run, client: Client, report: Report = lambda *_: None) -> UploadStatus:
    """Push a run out of the outbox: when the server has stored it, it is removed here.

    Raises:
        ServerError: the server refused it, or was away; it stays.
        RunnerError: another process is at it.
    """
    with locked(run) as own:
        known = _read(own)
        same = known.get("server") == client.url and known.get("upload")
        sent = client.push(own, report, UploadStatus(str(same), "receiving", 0) if same else None)
        gone = own.folder.with_name(f"{_SENT}{own.folder.name}")
        own.folder.rename(gone)
    shutil.rmtree(gone, ignore_errors=True)
    return sent


class Follower:
    """Pushes a run while it is recorded, in a thread of its own; what goes wrong meanwhile can wait.

    Args:
        client: of the server.
        run: in the outbox.
        size: tells how many bytes of its recording stand for good.
    """

    def __init__(self, client: Client, run: Run, size: Callable[[], int]) -> None:
        self._client, self._run, self._size = client, run, size
        self._over = threading.Event()
        self._sent: UploadStatus | None = None
        self._is_stale = False
        _note(run, client.url, None)
        self._thread = threading.Thread(target=self._follow, name="push", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Send nothing more; what is here, stays."""
        self._over.set()
        self._thread.join()
        self._client.close()

    def finish(self, run: Run) -> None:
        """Push the rest of a run that is over now; if the server is away, warn that it waits here."""
        self._over.set()
        self._thread.join()
        try:
            deliver(run, self._client)
        except RunnerError as error:
            warnings.warn(
                f"run {run.run_id} was not pushed: {error} It is kept in {run.folder}; "
                "`dualtaxi remote push --outbox` sends it.",
                stacklevel=4,
            )
        finally:
            self._client.close()

    def _follow(self) -> None:
        pause = FOLLOW_SECONDS
        while not self._over.wait(pause):
            try:
                self._send()
                pause = FOLLOW_SECONDS
            except ServerUnavailable:
                pause = min(2 * pause, AWAY_SECONDS)
                self._is_stale = True
            except RunnerError:
                return  # said at the end, when it is tried anew

    def _send(self) -> None:
        """Send what there is by now."""
        if self._sent is None:
            self._sent = self._client.begin(name=self._run.name, run_id=self._run.run_id)
            _note(self._run, self._client.url, self._sent.id)
        if self._is_stale:
            self._sent, self._is_stale = self._client.standing(self._sent), False
        while self._sent.offset < (size := self._size()) and not self._over.is_set():
            self._sent = self._client.append(self._sent, self._run.recording, size)


def connected(url: str) -> Client:
    """Return a client of the server that a run is recorded for.

    Raises:
        RunnerError: it is no address, its token cannot be read, or HTTPX is not installed.
    """
    return Client(url, find_token(), LAST_SECONDS)


def _note(run: Run, server: str, upload: str | None) -> None:
    with contextlib.suppress(OSError):  # without it, all is sent anew
        write_object(run.folder / PUSH_FILE, {"server": server, "upload": upload})


def _read(run: Run) -> dict[str, object]:
    with contextlib.suppress(OSError, ValueError):
        return read_object(run.folder / PUSH_FILE, _MAX_FILE)
    return {}


def _server_of(run: Run) -> str:
    return str(_read(run).get("server", ""))
