"""Unpacking a run into a recordings folder: all of it proved right first, or nothing written."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from runner.catalogue.finding import candidates
from runner.errors import RecordingError, RunnerError, StorageError
from runner.labels import LABELS_FILE
from runner.packing.container import Manifest, Pack, PackError, opened
from runner.packing.packing import facts_bytes, run_facts
from runner.recording.facts import json_object
from runner.recording.reader import open_recording
from runner.recording.rewriting import content_of, rewrite
from runner.runs import RECORDING_FILE, RUN_FILE, Run, find_run, new_run_id, runs_in


@dataclass(frozen=True)
class Unpacked:
    """What came of unpacking a run."""

    run: Run
    manifest: Manifest
    already: bool
    """Whether the same run with the same content was there before; then nothing was written."""


def unpack(path: Path, recordings: Path, as_new: bool = False) -> Unpacked:
    """Unpack a run into a recordings folder, under its own id.

    Args:
        path: what `pack` wrote.
        recordings: the folder of runs; made if it is missing.
        as_new: give it a new id, so that it can stand beside another run of the same id.

    Raises:
        PackError: the file is damaged, no pack, or made to do harm; nothing was written.
        RunnerError: another run of this id is there.
        StorageError: the recordings folder cannot be written, or has no room.
    """
    with opened(path) as pack:
        if not as_new and (run := _known_as(pack.manifest, recordings)) is not None:
            _take_all(pack, None)
            return Unpacked(run, pack.manifest, already=True)
        with workplace(recordings) as folder:
            _check_room(path, folder)
            _take_all(pack, folder)
            _check(path, folder, pack.manifest)
            run_id = pack.manifest.run_id
            if as_new:
                run_id = _renamed(folder, recordings)
            folder.rename(recordings / run_id)
        return Unpacked(find_run(f"{recordings}{os.sep}{run_id}", recordings), pack.manifest, False)


class Occupied(RunnerError):
    """Another run of this id is there already: `run`."""

    def __init__(self, run: Run, recordings: Path) -> None:
        super().__init__(
            f"{recordings}: found another run {run.run_id} ({run.name}, seed {run.seed}, {run.status}), "
            "whose content is not that of the one to come"
        )
        self.run = run


def known(run_id: str, content_digest: str, recordings: Path) -> Run | None:
    """Return the run of this id that is there already with this content; None if its place is free.

    Raises:
        Occupied: one of this id and other content is there.
        StorageError: something that is no run has its place.
    """
    taken = next((run for run in candidates(recordings) if run.run_id == run_id), None)
    found = taken and next(runs_in(Path(taken.root, taken.entry)), None)
    if found is None:
        if os.path.lexists(recordings / run_id):
            raise StorageError(f"{recordings / run_id}: is there already and is no run; move it away.")
        return None
    with contextlib.suppress(RecordingError):
        if content_of(found.recording) == content_digest:
            return found
    raise Occupied(found, recordings)


def _known_as(manifest: Manifest, recordings: Path) -> Run | None:
    """Return the run that is there already with the content of a packed one, as `known` does."""
    try:
        return known(manifest.run_id, manifest.content_digest, recordings)
    except Occupied as error:
        raise RunnerError(f"{error} ({manifest.status}); --as-new unpacks it under another.") from error


def _take_all(pack: Pack, folder: Path | None) -> None:
    """Read a pack to its end, into a folder if there is one."""
    for member in pack.manifest.members:
        if folder is None:
            pack.take(member, None)
            continue
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
        datetime.fromisoformat(facts["created"])
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
