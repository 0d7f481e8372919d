"""What commands on recorded runs share: find them, work on them, reply what came of it."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from runner.cli.command import argument, record
from runner.cli.options import (
    compared_argument,
    recordings_option,
    run_argument,
)
from runner.cli.output import Reply, path_and_size, say
from runner.cli.parameter_types import RunName
from runner.cli.progress import progress_line, steps_line
from runner.errors import ExitCode, RecordingError, RunnerError, RunNotFound
from runner.recording.run_file import has_environment
from runner.runs.resolve import find_run, find_runs
from runner.runs.run import RECORDING_FILE, RUN_FILE, SHARDS_FOLDER, Run, command_for, recordings_folder
from runner.runs.shards import are_over, shards_in_words
from runner.util.compilation import MESSAGE, announced
from runner.util.humanize import UNKNOWN, duration
from runner.util.values import Json, JsonView

if TYPE_CHECKING:
    from runner.api import Interrupt
    from runner.execution.session import Report
    from runner.recording.reader import Recording

# --- finding ----------------------------------------------------------------------------------------------


def find(name: str, recordings: Path | None, newest: bool = False) -> Run:
    """Return the run of a name or path in a recordings folder; with `newest`, the newest of several."""
    return folded(find_run(name, recordings, report=say, newest=newest))


def find_recorded(name: str, recordings: Path | None) -> Run:
    """Return the newest run of a name with its recording, restored into the cache if it is archived."""
    return recorded(find(name, recordings, newest=True))


def find_all_recorded(names: Iterable[str], recordings: Path | None) -> list[Run]:
    """Return all runs of these names, each once, with their recordings."""
    runs: dict[Path, Run] = {}
    for name in names:
        for run in find_runs(name, recordings_folder(recordings), say):
            runs.setdefault(run.recording.absolute(), folded(run))
    return [recorded(run) for run in runs.values()]


def folded(run: Run) -> Run:
    """Return a run with the shards of processes that were killed; print how many shards are still open."""
    if not (run.folder / SHARDS_FOLDER).is_dir():
        return run
    from runner.loops.fold import fold_if_over

    what = shards_in_words(run)
    if not are_over(run):
        say(f"Run {run.run_id} has {what} of other processes, which are added when the last of them ends.")
        return run
    try:
        with steps_line(f"adding {what} to {run.run_id}") as report:
            run = fold_if_over(run, report=lambda done, _: report(done))
    except RunnerError as error:
        say(f"Run {run.run_id} is shown without {what}: {error}")
        return run
    say(f"Added {what} to run {run.run_id}, whose processes had been killed.")
    if run.summary.unfolded:
        say(f"Not all of it is in the run: {run.summary.error}")
    return run


def recorded(run: Run) -> Run:
    """Return a run with its recording, restored into the cache if it is archived.

    Raises:
        RunnerError: the recording is missing.
    """
    run = restored(run)
    if run.recording.exists():
        return run
    if run.status == "running":
        raise RunnerError(f"run {run.run_id} has no recording yet: it has just begun.")
    if not run.can_train_again:
        raise RunnerError(
            f"run {run.run_id} has no recording, and only the loop that recorded it can make another."
        )
    raise RunnerError(
        f"run {run.run_id} has no recording: {run.recording} is missing. "
        f"`{command_for(run, 'resume')}` trains it from the beginning."
    )


def restored(run: Run) -> Run:
    """Return a run, restored into the cache if it is archived."""
    if run.status != "archived":
        return run
    from runner.archive.places import at_hand

    with steps_line(f"restoring {run.run_id}") as report:
        return at_hand(run, say, report)


@record
def recording_and_run(
    run_name: str = run_argument, recordings: Path | None = recordings_option
) -> tuple[Path, Run | None]:
    """Return a recording, however damaged, by run name or path; and its run, if it is in a run's folder."""
    try:
        run = find_recorded(run_name, recordings)
        in_folder = run.recording.name == RECORDING_FILE and (run.folder / RUN_FILE).is_file()
        return run.recording, run if in_folder else None
    except (RunNotFound, RecordingError):
        folders = (Path(run_name), recordings_folder(recordings) / run_name)
        for path in (Path(run_name), *(folder / RECORDING_FILE for folder in folders)):
            if path.is_file():
                return path, None
        raise


@contextlib.contextmanager
def open_for_export(run: Run, needs_steps: bool = False) -> Iterator[Recording]:
    """Open the recording of a run to export it, and print what it lacks when that is done."""
    from runner.analysis.contents import require_steps, shortcomings
    from runner.recording.reader import open_recording

    with open_recording(run.recording) as recording:
        if needs_steps and has_environment(recording.config):
            require_steps(recording, "export")
        yield recording
        for shortcoming in shortcomings(recording):
            say(shortcoming)


@record
def found_run(run_name: str = run_argument, recordings: Path | None = recordings_option) -> Run:
    """Return the run that the command names."""
    return find(run_name, recordings)


@record
def recorded_run(run_name: str = run_argument, recordings: Path | None = recordings_option) -> Run:
    """Return the newest run of the name that the command gives, with its recording."""
    return find_recorded(run_name, recordings)


@record
def any_run(run_name: str = run_argument, recordings: Path | None = recordings_option) -> Run:
    """Return the newest run of the name that the command gives, whether it has its recording or not."""
    return restored(find(run_name, recordings, newest=True))


@record
def two_recorded_runs(
    a: str = argument(metavar="A", type=RunName()),
    b: str = argument(metavar="B", type=RunName()),
    recordings: Path | None = recordings_option,
) -> list[Run]:
    """Return the two runs that the command names."""
    return [find_recorded(a, recordings), find_recorded(b, recordings)]


@record
def all_recorded_runs(
    run_names: tuple[str, ...] = compared_argument, recordings: Path | None = recordings_option
) -> list[Run]:
    """Return all runs that the command names."""
    return find_all_recorded(run_names, recordings)


@record
def runs_folder(recordings: Path | None = recordings_option) -> Path:
    """Return the folder of runs."""
    return recordings_folder(recordings)


@record
def named_sweep(name: str = argument(), folder: Path = runs_folder) -> tuple[str, Path]:
    """Return the name of a sweep, and its folder of runs."""
    return name, folder


# --- working ----------------------------------------------------------------------------------------------


@contextlib.contextmanager
def compilation_notice() -> Iterator[None]:
    """Print a notice when a kernel is compiled, which takes seconds the first time."""
    with announced(lambda: say(MESSAGE)):
        yield


@contextlib.contextmanager
def job_progress(label: str, episodes: int) -> Iterator[tuple[Report, Interrupt]]:
    """Yield the function that a job reports its progress to, and whether it was interrupted."""
    from runner.api import interruptible

    with (
        interruptible(second=signal.SIG_DFL) as interrupt,
        progress_line(label, episodes) as report,
        compilation_notice(),
    ):
        yield report, interrupt


# --- replying ---------------------------------------------------------------------------------------------


def identity(run: Run) -> dict[str, object]:
    """Return what identifies a run, as JSON."""
    path = str(run.recording.absolute())
    return {"run_id": run.run_id, "name": run.name, "seed": run.seed, "status": run.status, "path": path}


def run_reply(run: Run, rows: dict[str, str], interrupted: str = "", **more: object) -> Reply:
    """Return a run that is over and its results, with further rows or keys of the JSON object.

    `interrupted` says what can be done if the run was interrupted now.
    """
    notes, code = ([interrupted], ExitCode.INTERRUPTED) if interrupted else ([], ExitCode.OK)
    return Reply(run_as_json(run) | more, [run_facts(run) | rows], notes=notes, exit_code=code)


def run_as_json(run: Run) -> Json:
    """Return a run that is over and its results as JSON."""
    summary = _summary(run)
    keys = ("content_digest", "episodes", "train_steps", "eval_steps", "seconds", "bytes", "last_evaluation")
    return identity(run) | {key: summary.get(key) for key in keys}


def run_facts(run: Run) -> dict[str, str]:
    """Return a run that is over and its results as text by name."""
    summary = _summary(run)
    took = "" if summary.get("seconds") is None else f", in {duration(summary['seconds'])}"
    return {
        "run": f"{run.run_id}  {run.title}, {run.status}",
        "steps": f"{summary['train_steps']:,} of training, {summary['eval_steps']:,} of evaluation{took}",
        "digest": summary.get("content_digest") or UNKNOWN,
        "file": path_and_size(run.recording),
    }


def _summary(run: Run) -> JsonView:
    """Return the summary of a run; of one that was killed, what its recording holds."""
    from runner.recording.reader import open_recording

    if run.summary.train_steps is not None and run.summary.eval_steps is not None:
        return run.summary
    with open_recording(run.recording) as recording:
        return {**recording.done(), **run.summary}


def received(run: Run, digest: str, existing: str, **more: object) -> Reply:
    """Return a run that was imported or downloaded.

    `existing` is what was in the folder before, such as `this content`, empty if the run is new; `more` are
    further keys of the JSON object.
    """
    if existing:
        say(f"Run {run.run_id} is there already with {existing}; nothing was written.")
    values = identity(run) | {"already": bool(existing), "content_digest": digest} | more
    title = f"{run.run_id}  {run.title}, {run.status}"
    return Reply(
        values,
        [
            {
                "run": title,
                "digest": digest,
                "file": path_and_size(run.recording),
                "next": command_for(run, "show"),
            }
        ],
    )
