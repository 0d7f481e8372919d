"""What plot, report and film share: which runs are meant, and what is to be said of them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from runner.errors import RecordingError
from runner.finding import find_run
from runner.recording import schema
from runner.recording.reader import Recording
from runner.runs import Run, list_runs


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
        found = (
            "no steps (recording.steps: none)" if recording.kind == "job" else "no step that its loop took"
        )
        hint = "; `dualtaxi rerecord` records them" if recording.kind == "job" else ""
        raise RecordingError(f"{recording.path}: found {found}, so there is no episode to show{hint}.")
