"""A sweep on disk: the file as it was resolved, beside the runs. What has been done, the runs themselves say.

recordings/.sweeps/NAME/sweep.yaml   the sweep, its base spelled out
recordings/k3v9m2xq/labels.json      a run of it: the tag sweep=NAME
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from runner.config.document import read_yaml, write_yaml
from runner.config.job import identity_of
from runner.config.loading import read_text
from runner.errors import ConfigError, RunnerError, nearest
from runner.runs.locking import acquired
from runner.runs.run import Run, list_runs
from runner.sweep.loading import from_values
from runner.sweep.model import Sweep
from runner.sweep.names import FILE, folder_of, sweeps_in, tag_of
from runner.util.files import read_object, replacing, storage_errors, write_object
from runner.util.values import flatten

FAILED: Final = "failed.json"
MAX_FAILED_BYTES: Final = 8 << 20
LOCK: Final = "owner.lock"
FREE: Final = ("limits",)
"""What may change when a sweep is gone on with: what is done follows from the rest."""
TOLD_ANYWAY: Final = ("base.name", "base.seeds")
"""What the base has from the sweep, where it is told."""

PRUNED: Final = "pruned"
"""The tag of a run that was given up."""


class SweepBusy(RunnerError):
    """Another process is doing the sweep."""


def read_sweep(name: str, recordings: Path) -> Sweep:
    """Return a sweep as it was begun.

    Raises:
        RunnerError: there is none of this name, or its file was damaged.
    """
    known = sweeps_in(recordings)
    if name not in known:
        listed = f" There are {', '.join(known)}." if known else " `dualtaxi sweep run FILE` starts one."
        raise RunnerError(f"no sweep {name!r} in {recordings}.{nearest(name, known) or listed}")
    path = folder_of(name, recordings) / FILE
    try:
        # What a sweep suggests follows from its file; one that was begun before `repeats` existed has none.
        return from_values({"repeats": True} | read_yaml(read_text(path), str(path)).value)
    except (ConfigError, TypeError, ValueError) as error:
        raise RunnerError(f"{path}: is no sweep any more: {error}") from error


def begin(sweep: Sweep, recordings: Path, resume: bool, accept_changes: bool) -> None:
    """Write a sweep down, or find it as it was begun.

    Args:
        sweep: what is to be done.
        recordings: the folder of its runs.
        resume: whether it may be there already.
        accept_changes: whether it may have been another then, or begun by other code.

    Raises:
        RunnerError: there is one of this name already, it was another, or other code began a run of it
            that is not over.
        StorageError: the folder cannot be written.
    """
    require_startable(sweep, recordings, resume, accept_changes)
    _write(folder_of(sweep.name, recordings), write_yaml(sweep.to_mapping()))


def require_startable(sweep: Sweep, recordings: Path, resume: bool, accept_changes: bool) -> None:
    """Refuse what `begin` would refuse, and write nothing.

    Raises:
        RunnerError: there is one of this name already, it was another, or other code began a run of it
            that is not over.
    """
    there = sweep.name in sweeps_in(recordings)
    if there and not resume:
        raise RunnerError(
            f"a sweep {sweep.name!r} is in {recordings} already: --resume goes on with it, --name calls this "
            "one otherwise."
        )
    if there and not accept_changes:
        changed = differences(read_sweep(sweep.name, recordings).to_mapping(), sweep.to_mapping())
        if changed:
            raise RunnerError(
                f"the sweep {sweep.name!r} was begun with something else:\n"
                + "\n".join(f"  {key}: {before}, now {now}" for key, before, now in changed)
                + "\n--accept-changes goes on all the same, and runs that still belong to it count; "
                "--name begins another."
            )
        _require_same_makers(sweep.name, recordings)


def _require_same_makers(name: str, recordings: Path) -> None:
    """Refuse runs that cannot be gone on with as they are: without them a search would go elsewhere."""
    from runner.execution.resume import require_same_makers

    failed = failures_of(name, recordings)
    for identity, run in runs_of(name, recordings).items():
        if not is_over(run) and identity not in failed:
            require_same_makers(run)


def differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Return what differs between two sweeps: path, value before, value now."""
    ours, theirs = (flatten({k: v for k, v in each.items() if k not in FREE}) for each in (before, now))
    missing = "nothing"
    return [
        (key, str(ours.get(key, missing)), str(theirs.get(key, missing)))
        for key in dict.fromkeys([*ours, *theirs])
        if ours.get(key, missing) != theirs.get(key, missing) and key not in TOLD_ANYWAY
    ]


@contextlib.contextmanager
def held(name: str, recordings: Path) -> Iterator[None]:
    """Keep every other process from doing this sweep meanwhile.

    Raises:
        SweepBusy: one does.
        StorageError: the folder cannot be written.
    """
    busy = SweepBusy(f"the sweep {name!r} is being done by another process; let it.")
    lock = acquired(folder_of(name, recordings) / LOCK, busy)
    try:
        yield
    finally:
        lock.release()


def is_over(run: Run) -> bool:
    """Return whether there is nothing left to do for a run of a sweep; it may be archived."""
    return run.file.status == "finished" or PRUNED in run.tags


def runs_of(name: str, recordings: Path) -> dict[str, Run]:
    """Return the runs of a sweep by the identity of their job: where there are two, the one that is over."""
    found: dict[str, Run] = {}
    for run in list_runs(recordings):
        if tag_of(name) in run.tags:
            identity = identity_of(run.file.config, run.seed)
            if identity not in found or (is_over(run) and not is_over(found[identity])):
                found[identity] = run
    return found


def failures_of(name: str, recordings: Path) -> dict[str, str]:
    """Return why jobs of a sweep failed, by identity; what cannot be understood counts as not failed."""
    try:
        found = read_object(folder_of(name, recordings) / FAILED, MAX_FAILED_BYTES)
    except (OSError, ValueError):
        return {}
    return {identity: error for identity, error in found.items() if isinstance(error, str)}


def note_failures(name: str, recordings: Path, failures: dict[str, str]) -> None:
    """Write down why jobs of a sweep failed.

    Raises:
        StorageError: the folder cannot be written.
    """
    path = folder_of(name, recordings) / FAILED
    with storage_errors(path):
        write_object(path, failures)


def forget_failures(name: str, recordings: Path) -> None:
    """Have the jobs of a sweep that failed tried again."""
    (folder_of(name, recordings) / FAILED).unlink(missing_ok=True)


def _write(folder: Path, text: str) -> None:
    with storage_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with replacing(folder / FILE) as fresh:
            fresh.write_text(text, encoding="utf-8")
