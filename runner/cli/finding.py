"""The runs that a command is given: found, with their recordings at hand, and named in what to type next."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from runner.errors import RunnerError

if TYPE_CHECKING:
    from runner.runs.run import Run


def find(name: str, recordings: Path | None) -> Run:
    """Return the run of a name, or of a path, in the chosen folder."""
    from runner.cli.output import say
    from runner.runs.resolve import find_run

    return find_run(name, recordings, report=say)


def find_recorded(name: str, recordings: Path | None) -> Run:
    """Return the run of a name with its recording at hand: restored into the cache if it is archived."""
    return recorded(find(name, recordings))


def find_all_recorded(names: Iterable[str], recordings: Path | None) -> list[Run]:
    """Return the runs that answer to the names, each once, with their recordings at hand.

    A name stands for all runs of that name.
    """
    from runner.cli.output import say
    from runner.runs.resolve import find_runs
    from runner.runs.run import recordings_folder

    found: dict[Path, Run] = {}
    for name in names:
        for run in find_runs(name, recordings_folder(recordings), say):
            found.setdefault(run.recording.absolute(), run)
    return [recorded(run) for run in found.values()]


def recorded(run: Run) -> Run:
    """Return a run with its recording at hand: restored into the cache if it is archived, and said so.

    Raises:
        RunnerError: it has none.
    """
    run = restored(run)
    if not run.recording.exists():
        raise RunnerError(_without_recording(run))
    return run


def _without_recording(run: Run) -> str:
    """Return what can be done about a run whose recording is missing."""
    if run.status == "running":
        return f"run {run.run_id} has no recording yet: it has just begun."
    if "made_by" in run.file.config:
        return f"run {run.run_id} has no recording, and only the loop that it was made by can make another."
    return (
        f"run {run.run_id} has no recording: {run.recording} is missing. `{suggested(run, 'resume')}` does "
        "it from the beginning."
    )


def restored(run: Run) -> Run:
    """Return a run, restored into the cache if it is archived, and said so."""
    if run.status != "archived":
        return run
    from runner.archive.places import at_hand
    from runner.cli.output import say
    from runner.cli.progress import steps_line

    with steps_line(f"restoring {run.run_id}") as report:
        return at_hand(run, say, report)


def suggested(run: Run, verb: str, *options: str) -> str:
    """Return what to type for a command on a run; its folder is named if it is not the usual one."""
    from runner.runs.run import recordings_folder

    words, root = ["dualtaxi", verb, run.run_id, *options], run.folder.parent
    if root.absolute() != recordings_folder().absolute():
        words += ["--recordings", shlex.quote(os.fspath(root))]
    return " ".join(words)
