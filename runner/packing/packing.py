"""Packing a run: what it is and what was recorded, in one file; on request without who made it and where."""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from runner.errors import RunnerError, StorageError
from runner.packing.container import (
    MEMBERS,
    VERSION,
    Manifest,
    PackError,
    member_of,
    opened,
    write_pack,
)
from runner.recording.reader import Recording, open_recording
from runner.recording.rewriting import content_of, rewrite
from runner.runs.labels import LABELS_FILE
from runner.runs.run import RECORDING_FILE, RUN_FILE, Run

SUFFIX: Final = ".dualtaxi"
PRIVATE: Final = ("host", "user", "command", "directory")
"""What provenance says of persons and places."""
LEFT_OUT: Final = "left out"
_LONGEST_ERROR: Final = 10_000


@dataclass(frozen=True)
class Packed:
    """What came of packing a run."""

    path: Path
    manifest: Manifest
    already: bool
    """Whether the very same file was there before."""
    notes: tuple[str, ...]
    """What whoever hands it on should know."""


def pack(run: Run, target: Path | None = None, anonymous: bool = False, force: bool = False) -> Packed:
    """Pack a run into one file; the same run gives the same bytes.

    Args:
        run: any that is not running.
        target: the file; NAME-ID.dualtaxi in the working folder unless given.
        anonymous: leave out host, user, command line and folder, and the text of an error.
        force: replace a file that is there.

    Raises:
        RunnerError: the run is running, or another file is there.
        RecordingError: the recording is damaged.
        StorageError: the file cannot be written.
    """
    if run.status == "running":
        raise RunnerError(f"run {run.run_id} is running; wait for its end, or interrupt it.")
    if run.status == "archived":
        raise RunnerError(f"run {run.run_id} is in an archive alone; bring its recording back first.")
    path = target or Path(f"{run.file_stem}{SUFFIX}")
    if path.is_dir() or not path.absolute().parent.is_dir():
        raise RunnerError(f"{path}: found no place for a file; choose another by -o.")
    with _sources(run, path, anonymous) as sources:
        manifest = _manifest(run, sources, anonymous)
        if already := path.exists() and holds(path, manifest):
            return Packed(path, manifest, already, ())
        if path.exists() and not force:
            raise RunnerError(f"{path}: exists already; --force replaces it, or choose another by -o.")
        fresh = path.with_name(f".{secrets.token_hex(4)}.{path.name}")
        try:
            with fresh.open("xb") as stream:
                write_pack(stream, manifest, sources)
                os.fsync(stream.fileno())
            fresh.replace(path)
        except OSError as error:
            raise StorageError(f"{path}: cannot be written ({error.strerror}).") from error
        finally:
            fresh.unlink(missing_ok=True)
    return Packed(path, manifest, False, tuple(_notes(run)) if anonymous else ())


def holds(path: Path, manifest: Manifest) -> bool:
    """Return whether a file is a sound pack of this very manifest."""
    with contextlib.suppress(PackError), opened(path) as found:
        if found.manifest == manifest:
            for member in manifest.members:
                found.take(member, None)
            found.check_end()
            return True
    return False


def run_facts(recording: Recording, said: Mapping[str, Any]) -> dict[str, Any]:
    """Return what `run.json` shall say: what the recording says, and the little that it cannot know.

    Name, status, duration, the text of an error and the digest to be reached again are taken from `said`,
    if they are what they must be; anything else is not. That a run came to its end, its recording must say.
    """
    facts = recording.run_facts()
    summary, told = dict(facts["summary"]), said.get("summary")
    told = told if isinstance(told, dict) else {}
    seconds, error = told.get("seconds"), told.get("error")
    if isinstance(seconds, int | float) and not isinstance(seconds, bool) and 0 <= seconds < 1e12:
        summary["seconds"] = seconds
    if isinstance(error, str) and len(error) <= _LONGEST_ERROR:
        summary["error"] = error
    if "content_digest" in summary or "bytes" in told:
        summary["bytes"] = recording.size
    if isinstance(said.get("name"), str):
        facts["name"] = said["name"]
    reached = ("finished",) if facts["status"] == "finished" else ()
    if said.get("status") in ("interrupted", "failed", *reached):
        facts["status"] = said["status"]
    proof = said.get("proof")
    if isinstance(proof, str) and len(proof) == 64 and proof.isalnum():
        facts["proof"] = proof
    return facts | {"summary": summary}


def facts_bytes(facts: Mapping[str, Any]) -> bytes:
    """Return facts as `run.json` has them."""
    return json.dumps(facts, indent=1, ensure_ascii=False).encode() + b"\n"


def without_names(name: str, entries: dict[str, str]) -> dict[str, str]:
    """Return the entries of a recording's metadata without host, user, command line and folder."""
    if name in {"provenance", "rerecord"} or name.startswith("resume/"):
        return {key: text for key, text in entries.items() if key not in PRIVATE}
    if name == "result" and "json" in entries:
        result = json.loads(entries["json"])
        if "error" in result:
            return entries | {"json": json.dumps(result | {"error": LEFT_OUT}, sort_keys=True)}
    return entries


@contextlib.contextmanager
def _sources(run: Run, path: Path, anonymous: bool) -> Iterator[dict[str, Path]]:
    """Give the files to be packed, by the names they shall have; those made for it are gone afterwards."""
    try:
        with tempfile.TemporaryDirectory(prefix=".packing-", dir=path.absolute().parent) as folder:
            sources = {RUN_FILE: Path(folder, RUN_FILE), RECORDING_FILE: run.recording}
            if anonymous:
                sources[RECORDING_FILE] = Path(folder, RECORDING_FILE)
                rewrite(run.recording, sources[RECORDING_FILE], without_names)
            with open_recording(sources[RECORDING_FILE]) as recording:
                facts = run_facts(recording, run.facts | {"status": run.status})
            if anonymous and "error" in facts["summary"]:
                facts["summary"]["error"] = LEFT_OUT
            sources[RUN_FILE].write_bytes(facts_bytes(facts))
            labels = run.folder / LABELS_FILE
            if not run.stands_alone and labels.is_file():
                sources[LABELS_FILE] = labels
            yield sources
    except OSError as error:
        raise StorageError(f"{error.filename or path}: cannot be used ({error.strerror}).") from error


def _manifest(run: Run, sources: Mapping[str, Path], anonymous: bool) -> Manifest:
    members = tuple(member_of(sources[name], name) for name in MEMBERS if name in sources)
    said = json.loads(sources[RUN_FILE].read_bytes())
    return Manifest(
        dualtaxi_pack=VERSION,
        run_id=run.run_id,
        name=said["name"],
        seed=run.seed,
        status=said["status"],
        content_digest=content_of(sources[RECORDING_FILE]),
        anonymous=anonymous,
        members=members,
    )


def _notes(run: Run) -> list[str]:
    """Return what stays in an anonymous pack although it may tell of a person or a place."""
    with open_recording(run.recording) as recording:
        paths = [f"{key}: {text}" for key, text in _texts(recording.config, "") if Path(text).is_absolute()]
    notes = [
        f"The configuration names a path, which stays, as the job is not the same without: {path}"
        for path in paths
    ]
    if (run.folder / LABELS_FILE).is_file():
        notes.append("The labels of the run stay as they are: name, tags and note.")
    return notes


def _texts(value: Any, place: str) -> Iterator[tuple[str, str]]:
    """Yield the place and text of every text in a configuration."""
    if isinstance(value, str):
        yield place, value
    elif isinstance(value, Mapping):
        for key, part in value.items():
            yield from _texts(part, f"{place}.{key}" if place else str(key))
    elif isinstance(value, list):
        for k, part in enumerate(value):
            yield from _texts(part, f"{place}[{k}]")
