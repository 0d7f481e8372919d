"""The outbox: runs recorded here for a server, until it has stored them.

~/.local/state/dualtaxi/outbox/k3v9m2xq/    a run as in any recordings folder
~/.local/state/dualtaxi/outbox/k3v9m2xq/push.json    the server, and the upload that has begun
"""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import threading
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

from platformdirs import user_state_path

from runner.client.client import (
    Client,
    Report,
    ServerUnavailable,
    UploadStatus,
    append_upload,
    find_token,
    put_upload,
)
from runner.errors import RunnerError
from runner.runs.checkpoints import Store
from runner.runs.run import SHARDS_FOLDER, Run, list_runs, locked
from runner.util.files import read_object, write_object

OUTBOX_VARIABLE: Final = "DUALTAXI_OUTBOX"
PUSH_FILE: Final = "push.json"
FOLLOW_SECONDS: Final = 1.0
MAX_PAUSE: Final = 30.0
"""The longest pause before a server that was unavailable is tried again."""
LAST_SECONDS: Final = 10.0
"""How long a server may be unavailable at the end of a run."""
_SENT: Final = ".sent-"
_MAX_FILE: Final = 1 << 16


class _Push(NamedTuple):
    """Where a run of the outbox goes."""

    server: str = ""
    upload: str = ""
    """The id of the upload that has its first bytes; empty if none has."""


def is_server(recordings: object) -> bool:
    """Return whether the value for a recordings folder is the address of a server."""
    return isinstance(recordings, str) and recordings.startswith(("http://", "https://"))


def outbox_folder() -> Path:
    """Return the outbox: the variable's folder, else one in the user's state folder; it need not exist."""
    return Path(os.environ.get(OUTBOX_VARIABLE) or user_state_path("dualtaxi") / "outbox")


def waiting(outbox: Path) -> list[tuple[Run, str]]:
    """Return the runs in an outbox that are over, the oldest first, each with its server."""
    for sent in outbox.glob(f"{_SENT}*"):
        shutil.rmtree(sent, ignore_errors=True)
    runs = [run for run in reversed(list_runs(outbox)) if run.status != "running"]
    return [(run, push.server) for run in runs if (push := _read_push_file(run)).server]


def deliver(run: Run, client: Client, report: Report = lambda *_: None) -> UploadStatus:
    """Push a run out of the outbox: it is removed here when the server has stored it.

    Raises:
        ServerError: the server refused it, or was unavailable; it stays.
        RunnerError: another process has it.
    """
    with locked(run) as waiting:
        if (waiting.folder / SHARDS_FOLDER).exists():
            raise RunnerError(
                f"its shards are not added to it yet: `dualtaxi show {waiting.folder}` does it when all "
                "of its processes have ended."
            )
        push = _read_push_file(waiting)
        upload = client.push(waiting, report, begun=push.upload if push.server == client.url else "")
        sent = waiting.folder.with_name(f"{_SENT}{waiting.folder.name}")
        waiting.folder.rename(sent)
    shutil.rmtree(sent, ignore_errors=True)
    Store(waiting.folder.parent).drop(waiting.folder.name)
    return upload


class Follower:
    """Pushes a run while it is recorded, in a thread of its own.

    A server that is unavailable is tried again; one that refuses the run is reported at once, since the loop
    may go on for days, and at the end. The client is closed at the end; `size` returns how many bytes of the
    recording are final.
    """

    def __init__(self, client: Client, run: Run, size: Callable[[], int]) -> None:
        self._client = client
        self._run = run
        self._size = size
        self._over = threading.Event()
        self._upload_id = secrets.token_hex(32)
        _write_push_file(run, _Push(client.url, self._upload_id))
        self._thread = threading.Thread(target=self._follow, name="push", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Send nothing more; the run stays in the outbox."""
        self._over.set()
        self._thread.join()
        self._client.close()

    def finish(self, run: Run) -> None:
        """Push the rest of a run that is over; warn if the server is unavailable and the run waits here."""
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
        pause, client, run = FOLLOW_SECONDS, self._client, self._run
        while not self._over.wait(pause):
            try:  # also without new bytes, so the server knows that the loop goes on
                upload = put_upload(client, self._upload_id, name=run.name, run_id=run.run_id)
                if upload.stop_requested and not run.is_stop_requested:
                    run.request_stop()
                while upload.offset < (size := self._size()) and not self._over.is_set():
                    upload = append_upload(client, upload, run.recording, size)
                pause = FOLLOW_SECONDS
            except ServerUnavailable:
                pause = min(2 * pause, MAX_PAUSE)
            except RunnerError as error:
                warnings.warn(
                    f"run {run.run_id} is not pushed while it is recorded: {error} "
                    f"It is kept in {run.folder}.",
                    stacklevel=1,
                )
                return


def forget_upload(run: Run) -> None:
    """Have a run of the outbox pushed from its beginning: its recording is another file now."""
    if (push := _read_push_file(run)).server:
        _write_push_file(run, _Push(push.server))


def connect(url: str) -> Client:
    """Return a client of the server that a run is recorded for."""
    return Client(url, find_token(), LAST_SECONDS)


def _write_push_file(run: Run, push: _Push) -> None:
    with contextlib.suppress(OSError):  # without it, everything is sent again
        write_object(run.folder / PUSH_FILE, push._asdict())


def _read_push_file(run: Run) -> _Push:
    with contextlib.suppress(OSError, ValueError):
        values = read_object(run.folder / PUSH_FILE, _MAX_FILE)
        return _Push(str(values.get("server") or ""), str(values.get("upload") or ""))
    return _Push()
