"""Pulling a run from a server: resumed where it was cut off, and proved right before it is a run here."""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import quote

from blake3 import blake3
from filelock import FileLock, Timeout

from runner.client.backoff import ServerError, ServerUnavailable
from runner.client.connection import Connection, Report
from runner.errors import RecordingError, RunnerError, StorageError
from runner.recording.labels import labels_from
from runner.runs.importing import Imported, import_recording

if TYPE_CHECKING:
    import httpx2

FOLDER: Final = ".pulling"


def pull(client: Connection, name: str, recordings: Path, report: Report = lambda *_: None) -> Imported:
    """Bring a run from a server into a folder of runs, with its labels.

    Args:
        client: of the server.
        name: a run as the server knows it: its id, the beginning of one, its name, @latest.
        recordings: the folder of runs; made if it is missing.
        report: told the progress.

    Raises:
        ServerError: the server has no such run, or was away for too long; what came is kept.
        RecordingError: what came is no sound recording.
        RunnerError: it is running, or another run of its id is here.
        StorageError: the folder cannot be written, or has no room.
    """
    facts = _facts(client, name)
    place = f"/runs/{quote(facts['run_id'], safe='')}/recording"
    tag, size = _tag_and_size(client.ask("HEAD", place))
    folder = recordings / FOLDER
    part = folder / f"{blake3(f'{client.url}{place} {tag}'.encode()).hexdigest()[:32]}.part"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with FileLock(part.with_suffix(".lock"), timeout=0):
            _fetch(client, place, tag, size, part, report)
            imported = import_recording(part, recordings, _said(facts), labels_from(facts))
            part.unlink()
        part.with_suffix(".lock").unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # another pull is under way, or was cut off
            folder.rmdir()
        return imported
    except Timeout as error:
        raise RunnerError(f"run {facts['run_id']} is being pulled by another process; let it.") from error
    except RecordingError as error:
        part.unlink(missing_ok=True)
        raise RecordingError(
            str(error).replace(str(part), f"run {facts['run_id']} of {client.url}")
        ) from error
    except OSError as error:
        raise StorageError(f"{recordings}: cannot be written ({error.strerror}).") from error


def _facts(client: Connection, name: str) -> dict[str, Any]:
    """Return what the server says of a run that is over.

    Raises:
        ServerError: there is none, or it makes no sense.
        RunnerError: it is running.
    """
    answer = client.ask("GET", f"/runs/{quote(name, safe='')}")
    try:
        facts = dict(answer.json())
        run_id, status = str(facts["run_id"]), str(facts["status"])
    except (ValueError, KeyError, TypeError) as error:
        raise ServerError(f"{client.url}: found another answer than a dualtaxi server gives.") from error
    if status == "running":
        raise RunnerError(f"run {run_id} is running at {client.url}; wait for its end.")
    return facts


def _said(facts: dict[str, Any]) -> dict[str, Any]:
    """Return what `run.json` is to say, in its form; the name is the recording's own."""
    return {
        "status": facts.get("status"),
        "summary": {key: facts.get(key) for key in ("seconds", "error", "bytes")},
    }


def _tag_and_size(answer: httpx2.Response) -> tuple[str, int]:
    try:
        return answer.headers["etag"], int(answer.headers["content-length"])
    except (KeyError, ValueError) as error:
        raise ServerError(f"{answer.url}: found no length and ETag; is it a dualtaxi server?") from error


def _fetch(client: Connection, place: str, tag: str, size: int, part: Path, report: Report) -> None:
    """Bring a file, from where it was cut off the last time.

    Raises:
        ServerError: it is another one by now, or the server was away for too long.
        StorageError: there is no room.
        OSError: it cannot be written.
    """
    patience = client.patience()
    with part.open("ab") as stream:
        lacking, free = size - stream.tell(), shutil.disk_usage(part.parent).free
        if lacking > free:
            raise StorageError(f"{part.parent.parent}: found room for {free:,} bytes, expected {lacking:,}.")
        while stream.tell() < size:
            try:
                for piece in client.download(place, tag, stream.tell(), size):
                    stream.write(piece)
                    patience.moved()
                    report(stream.tell(), size)
            except ServerUnavailable as error:
                patience.wait(error)
