"""What plot, report and film share: which runs are meant, and a file that is replaced only when asked."""

from __future__ import annotations

import os
import secrets
from collections.abc import Callable, Iterable
from pathlib import Path

from runner.errors import RecordingError, RunnerError, StorageError
from runner.recording import schema
from runner.recording.reader import Recording
from runner.runs import Run, find_run, list_runs


def find_runs(names: Iterable[str], recordings: Path) -> list[Run]:
    """Return the runs that answer to the names, each once; a name stands for all runs of that name.

    Raises:
        RunNotFound: none answers to one of the names.
    """
    known = list_runs(recordings)
    found: dict[Path, Run] = {}
    for name in names:
        alike = [run for run in reversed(known) if run.name == name]
        for run in alike or [find_run(name, recordings)]:
            found.setdefault(run.recording.absolute(), run)
    return list(found.values())


def write_new(path: Path, force: bool, write: Callable[[Path], None]) -> None:
    """Have a file written beside its place, and put there when it is whole.

    Raises:
        RunnerError: there is one already and `force` is not given.
        StorageError: it cannot be written.
    """
    require_new(path, force)
    fresh = path.with_name(f".{secrets.token_hex(4)}.{path.name}")
    try:
        write(fresh)
        fresh.replace(path)
    except OSError as error:
        raise StorageError(f"{path}: cannot be written ({error.strerror or error}).") from error
    finally:
        if os.path.lexists(fresh):
            fresh.unlink()


def require_new(path: Path, force: bool) -> None:
    """Refuse a path at which no file may be written.

    Raises:
        RunnerError: it is a folder, or there is a file already and `force` is not given.
    """
    if path.is_dir():
        raise RunnerError(f"{path}: found a folder, expected a file to write.")
    if path.exists() and not force:
        raise RunnerError(f"{path}: exists already; --force replaces it, or choose another name.")


def write_text_new(path: Path, force: bool, text: str) -> None:
    """Write text to a file, as `write_new` does."""

    def write(fresh: Path) -> None:
        fresh.write_text(text, encoding="utf-8")

    write_new(path, force, write)


def state_of(recording: Recording) -> str:
    """Return `finished`, or what the run is instead."""
    return str(recording.result.get("status", "interrupted"))


def shortcomings(recording: Recording) -> list[str]:
    """Return what a reader should know that is missing from a recording, a sentence each."""
    said = []
    run = recording.run["run_id"]
    if recording.kind != "job":
        if state_of(recording) != "finished":
            said.append(f"Run {run} did not finish ({state_of(recording)}): shown is what its loop had done.")
        said.append(
            f"Run {run} was recorded from a loop: what it learned is not known, so no episode is shown with "
            "it; `dualtaxi view` shows what was recorded."
        )
        return said
    if state_of(recording) != "finished":
        done, planned = recording.count(schema.TRAIN_EPISODE), recording.config["episodes"]
        said.append(
            f"Run {run} was interrupted: shown are the {done:,} of {planned:,} training episodes it recorded."
        )
    if not has_steps(recording):
        said.append(
            f"Run {run} was recorded without steps, so no episode of it can be replayed; "
            "`dualtaxi rerecord` records them."
        )
    return said


def has_steps(recording: Recording) -> bool:
    """Return whether any step was recorded."""
    return bool(recording.count(schema.TRAIN_STEP) or recording.count(schema.EVAL_STEP))


def require_steps(recording: Recording) -> None:
    """Refuse a recording without steps.

    Raises:
        RecordingError: it has none.
    """
    if not has_steps(recording):
        raise RecordingError(
            f"{recording.path}: found no steps (recording.steps: none), so there is no episode to show; "
            "`dualtaxi rerecord` records them."
        )
