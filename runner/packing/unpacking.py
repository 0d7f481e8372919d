"""Unpacking a run into a recordings folder: all of it proved right first, or nothing written."""

from __future__ import annotations

import contextlib
import io
import os
import secrets
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from runner.errors import RecordingError, RunnerError, StorageError
from runner.packing.container import Manifest, Pack, PackError, opened
from runner.packing.packing import facts_bytes, run_facts
from runner.packing.present import Occupied, known, met, settled
from runner.recording.metadata import json_object
from runner.recording.reader import open_recording
from runner.recording.rewriting import content_of, rewrite
from runner.recording.run_file import parse_run_file
from runner.runs.labels import LABELS_FILE, read_labels
from runner.runs.run import RECORDING_FILE, RUN_FILE, Run, new_run_id, run_at


@dataclass(frozen=True)
class Unpacked:
    """What came of unpacking a run."""

    run: Run
    manifest: Manifest
    already: bool
    """Whether the same run was there before, with this content or as far and further; nothing was written."""


def unpack(path: Path, recordings: Path, as_new: bool = False) -> Unpacked:
    """Unpack a run into a recordings folder, under its own id.

    One of its id that is there, but did not come to its end, is gone on with, as `admit` does.

    Args:
        path: what `pack` wrote.
        recordings: the folder of runs; made if it is missing.
        as_new: give it a new id, so that it can stand beside another run of the same id.

    Raises:
        PackError: the file is damaged, no pack, or made to do harm; nothing was written.
        RunnerError: another run of this id is there, which this does not go on with.
        StorageError: the recordings folder cannot be written, or has no room.
    """
    occupied = None
    with opened(path) as pack:
        try:
            manifest = pack.manifest
            run = None if as_new else known(manifest.run_id, manifest.content_digest, recordings)
        except Occupied as error:
            run, occupied = None, error
        if run is not None:
            return Unpacked(settled(run, _confirmed(path, pack, run)), manifest, already=True)
        with workplace(recordings) as folder:
            _check_room(path, folder)
            _take_all(pack, folder)
            _check(path, folder, manifest)
            if occupied is not None:
                return Unpacked(*_met(occupied, folder, manifest))
            run_id = _renamed(folder, recordings) if as_new else manifest.run_id
            folder.rename(recordings / run_id)
        return Unpacked(run_at(recordings / run_id), manifest, False)


def _met(occupied: Occupied, folder: Path, manifest: Manifest) -> tuple[Run, Manifest, bool]:
    """Return what came of unpacking a run where one of its id is, as `met` does.

    Raises:
        RunnerError: neither of the two holds the other.
    """
    facts = json_object((folder / RUN_FILE).read_bytes(), RUN_FILE)
    try:
        run, already = met(occupied, folder / RECORDING_FILE, facts, read_labels(folder))
    except Occupied as error:
        raise RunnerError(
            f"{error}, and neither goes on where the other ends ({manifest.status}); --as-new unpacks it "
            "under a new id, beside the one that is there."
        ) from error
    return run, manifest, already


def _confirmed(path: Path, pack: Pack, run: Run) -> dict[str, Any]:
    """Read a pack to its end; return what it says of a run that is there, as its recording confirms it."""
    said = io.BytesIO()
    for member in pack.manifest.members:
        pack.take(member, said if member.name == RUN_FILE else None)
    pack.check_end()
    try:
        with open_recording(run.recording) as recording:
            return run_facts(recording, json_object(said.getvalue(), RUN_FILE))
    except RecordingError as error:
        raise PackError(f"{path}: {error}") from error


def _take_all(pack: Pack, folder: Path) -> None:
    """Read a pack to its end, into a folder."""
    for member in pack.manifest.members:
        with (folder / member.name).open("xb") as target:
            pack.take(member, target)
            target.flush()
            os.fsync(target.fileno())
    pack.check_end()


@contextlib.contextmanager
def workplace(recordings: Path) -> Iterator[Path]:
    """Give a folder within a hidden one, so that it is no run as long as it is there; both are gone after."""
    made = not recordings.exists()
    hidden = recordings / f".unpacking-{secrets.token_hex(4)}"
    try:
        (hidden / "run").mkdir(parents=True)
        yield hidden / "run"
    except OSError as error:
        raise StorageError(
            f"{recordings}: cannot be written ({error.strerror}); nothing was unpacked."
        ) from error
    finally:
        shutil.rmtree(hidden, ignore_errors=True)
        if made:
            with contextlib.suppress(OSError):
                recordings.rmdir()


def _check_room(path: Path, folder: Path) -> None:
    size, free = path.stat().st_size, shutil.disk_usage(folder).free
    if size > free:
        raise StorageError(
            f"{folder.parents[1]}: found room for {free:,} bytes, expected {size:,}; free some disk."
        )


def _check(path: Path, folder: Path, manifest: Manifest) -> None:
    """Compare what was unpacked with itself: facts, recording and manifest must say the same.

    Raises:
        PackError: they do not.
    """
    try:
        with open_recording(folder / RECORDING_FILE) as recording:
            text = (folder / RUN_FILE).read_bytes()
            facts = run_facts(recording, json_object(text, RUN_FILE))
        if text != facts_bytes(facts):
            raise PackError(f"{path}: its {RUN_FILE} says other things than its recording does.")
        said = (facts["run_id"], facts["name"], facts["seed"], facts["status"])
        if said != (manifest.run_id, manifest.name, manifest.seed, manifest.status):
            raise PackError(f"{path}: found the run {said} in it, expected the one that the manifest says.")
        if problems := parse_run_file(facts).problems:
            raise PackError(f"{path}: its {RUN_FILE} makes no sense ({'; '.join(problems)}).")
        if content_of(folder / RECORDING_FILE) != manifest.content_digest:
            raise PackError(f"{path}: its recording has another content digest than the manifest says.")
        if (folder / LABELS_FILE).exists():
            json_object((folder / LABELS_FILE).read_bytes(), LABELS_FILE)
    except RecordingError as error:
        told = str(error).replace(f"{folder}{os.sep}", "")
        raise PackError(f"{path}: {told}") from error
    except ValueError as error:
        raise PackError(f"{path}: found no time of creation in it ({error}).") from error


def _renamed(folder: Path, recordings: Path) -> str:
    """Give an unpacked run a new id, also within its recording; return it."""
    run_id = new_run_id(recordings)
    old = folder / f"old-{RECORDING_FILE}"
    (folder / RECORDING_FILE).rename(old)
    rewrite(
        old,
        folder / RECORDING_FILE,
        lambda name, entries: entries | {"run_id": run_id} if name == "run" else entries,
    )
    old.unlink()
    with open_recording(folder / RECORDING_FILE) as recording:
        facts = run_facts(recording, json_object((folder / RUN_FILE).read_bytes(), RUN_FILE))
    (folder / RUN_FILE).write_bytes(facts_bytes(facts))
    return run_id
