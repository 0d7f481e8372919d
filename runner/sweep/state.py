"""A sweep on disk: its resolved file next to the runs; what has been done follows from the runs themselves.

recordings/.sweeps/NAME/sweep.yaml   the sweep, with the whole base
recordings/k3v9m2xq/labels.json      one of its runs: it has the tag sweep=NAME
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from runner.config import from_mapping
from runner.config.document import read_yaml, write_yaml
from runner.config.loading import read_text
from runner.config.model import identity_of
from runner.errors import ConfigError, RunnerError, nearest
from runner.execution.resume import require_same_makers
from runner.execution.session import resolve_initial_q
from runner.runs.run import Run, acquired, list_runs
from runner.sweep import FILE, folder_of, sweeps_in, tag_of
from runner.sweep.model import Sweep, from_values
from runner.util.files import read_object, replacing, storage_errors, write_object
from runner.util.values import JsonView, flatten

FAILED: Final = "failed.json"
MAX_FAILED_BYTES: Final = 8 << 20
LOCK: Final = "owner.lock"
_IGNORED: Final = ("limits", "base.name", "base.seeds")
"""Ignored differences: limits may change, and the base has its name and seeds from the sweep."""
PRUNED: Final = "pruned"
"""The tag of a pruned run."""


class SweepBusy(RunnerError):
    """Another process is running the sweep."""


def read_sweep(name: str, recordings: Path) -> Sweep:
    """Return a sweep as it was started.

    Raises:
        RunnerError: there is none of this name, or its file is damaged.
    """
    names = sweeps_in(recordings)
    if name not in names:
        listed = f" Its sweeps: {', '.join(names)}." if names else " `dualtaxi sweep run FILE` starts one."
        raise RunnerError(f"no sweep {name!r} in {recordings}.{nearest(name, names) or listed}")
    path = folder_of(name, recordings) / FILE
    try:
        # Suggestions depend on the file; one from before `repeats` existed does not have it.
        return from_values({"repeats": True} | read_yaml(read_text(path), str(path)).value)
    except (ConfigError, TypeError, ValueError) as error:
        raise RunnerError(f"{path}: no longer describes a sweep: {error}") from error


def with_resolved_tables(sweep: Sweep, recordings: Path) -> Sweep:
    """Return a sweep with the ids and steps of the runs whose Q-tables its trials start from.

    The runs of a sweep are found by their configurations, which have ids and steps.

    Raises:
        ConfigError: runs are tried, and no step: the last step of one would be taken of all.
        RunnerError: there is no such run.
    """
    values = sweep.to_mapping()

    def resolved(table: Any) -> Any:
        if not isinstance(table, Mapping) or "run" not in table:
            return table
        config = from_mapping(values["base"] | {"initial_q": table})
        return resolve_initial_q(config, recordings).to_mapping()["initial_q"]

    base, parameters = values["base"], values["parameters"]
    if isinstance(runs := parameters.get("initial_q.run"), list):
        steps = base["initial_q"] if isinstance(base["initial_q"], Mapping) else {}
        if steps.get("step") is None and "initial_q.step" not in parameters:
            raise ConfigError(
                "parameters.initial_q.run: found runs without a step, expected base.initial_q.step, or whole "
                "tables, initial_q: [{run: ...}, ...], each of the last step of its run."
            )
        parameters["initial_q.run"] = [resolved({"run": run, "step": 0})["run"] for run in runs]
    base["initial_q"] = resolved(base["initial_q"])
    if isinstance(choices := parameters.get("initial_q"), list):
        parameters["initial_q"] = [resolved(choice) for choice in choices]
    return from_values(values)


def begin(sweep: Sweep, recordings: Path, resume: bool, accept_changes: bool) -> None:
    """Write a sweep to disk, or check that it is the one on disk.

    With `resume` it may exist already; if changes are accepted, the existing one may differ, or have been
    started by other code.
    """
    require_startable(sweep, recordings, resume, accept_changes)
    folder = folder_of(sweep.name, recordings)
    with storage_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with replacing(folder / FILE) as fresh:
            fresh.write_text(write_yaml(sweep.to_mapping()), encoding="utf-8")


def require_startable(sweep: Sweep, recordings: Path, resume: bool, accept_changes: bool) -> None:
    """Raise the `RunnerError` that `begin` would raise, and write nothing."""
    exists = sweep.name in sweeps_in(recordings)
    if exists and not resume:
        raise RunnerError(
            f"a sweep {sweep.name!r} exists in {recordings}: --resume continues it, --name gives this one "
            "another name."
        )
    if exists and not accept_changes:
        changed = differences(read_sweep(sweep.name, recordings).to_mapping(), sweep.to_mapping())
        if changed:
            raise RunnerError(
                f"the sweep {sweep.name!r} was started with other settings:\n"
                + "\n".join(f"  {key}: {before}, now {now}" for key, before, now in changed)
                + "\n--accept-changes continues it nevertheless and keeps the runs that still belong to it; "
                "--name starts another."
            )
        # Runs that cannot be resumed as they are would send the search another way.
        failed = failures_of(sweep.name, recordings)
        for identity, run in runs_of(sweep.name, recordings).items():
            if not is_over(run) and identity not in failed:
                require_same_makers(run)


def differences(before: Mapping[str, object], now: Mapping[str, object]) -> list[tuple[str, str, str]]:
    """Return what differs between two sweeps: path, value before, value now."""
    old, new = flatten(before), flatten(now)
    return [
        (key, str(old.get(key, "nothing")), str(new.get(key, "nothing")))
        for key in dict.fromkeys([*old, *new])
        if old.get(key, "nothing") != new.get(key, "nothing")
        and not f"{key}.".startswith(tuple(f"{ignored}." for ignored in _IGNORED))
    ]


@contextlib.contextmanager
def locked(name: str, recordings: Path) -> Iterator[None]:
    """Keep every other process from running this sweep.

    Raises:
        SweepBusy: another one is running it.
        StorageError: the folder cannot be written.
    """
    busy = SweepBusy(f"the sweep {name!r} is being run by another process; try again when that has finished.")
    lock = acquired(folder_of(name, recordings) / LOCK, busy)
    try:
        yield
    finally:
        lock.release()


def is_over(run: Run) -> bool:
    """Return whether a run of a sweep is finished or pruned; it may be archived."""
    return run.file.status == "finished" or PRUNED in run.tags


def job_identity(config: JsonView, seed: int) -> str:
    """Return the identity of a job of a sweep, of its configuration with numbers of 15 digits.

    Runs of older sweeps have 0.7000000000000001 where 0.7 is tried now, and belong to the same trial.
    """
    rounded = json.loads(json.dumps(config), parse_float=lambda text: float(f"{float(text):.15g}"))
    return identity_of(rounded, seed)


def runs_of(name: str, recordings: Path) -> dict[str, Run]:
    """Return the runs of a sweep by the identity of their job; of two, the one that is over."""
    runs: dict[str, Run] = {}
    for run in list_runs(recordings):
        if tag_of(name) in run.tags:
            identity = job_identity(run.file.config, run.seed)
            if identity not in runs or (is_over(run) and not is_over(runs[identity])):
                runs[identity] = run
    return runs


def failures_of(name: str, recordings: Path) -> dict[str, str]:
    """Return the errors of a sweep's failed jobs by identity; a damaged list counts as empty."""
    try:
        errors = read_object(folder_of(name, recordings) / FAILED, MAX_FAILED_BYTES)
    except (OSError, ValueError):
        return {}
    return {identity: error for identity, error in errors.items() if isinstance(error, str)}


def write_failures(name: str, recordings: Path, failures: Mapping[str, str]) -> None:
    """Store the errors of a sweep's failed jobs."""
    path = folder_of(name, recordings) / FAILED
    with storage_errors(path):
        write_object(path, failures)


def forget_failures(name: str, recordings: Path) -> None:
    """Let the failed jobs of a sweep be tried again."""
    (folder_of(name, recordings) / FAILED).unlink(missing_ok=True)
