"""What the commands on recorded runs share: finding the file, doing a job, telling what came of it."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from runner.cli.finding import find_recorded, suggested
from runner.cli.output import UNKNOWN, draw, duration, facts, print_json, say, size
from runner.errors import RecordingError, RunnerError, RunNotFound
from runner.runs.run import RECORDING_FILE, RUN_FILE, recordings_folder

if TYPE_CHECKING:
    from runner.api import Interrupt
    from runner.execution.session import Report
    from runner.runs.run import Run


def recording_of(name: str, recordings: Path | None) -> tuple[Path, Run | None]:
    """Return the recording of a run, or of a path, however damaged; and the run, if there is one around it.

    Raises:
        RunnerError: there is neither.
    """
    try:
        run = find_recorded(name, recordings)
        in_folder = run.recording.name == RECORDING_FILE and (run.folder / RUN_FILE).is_file()
        return run.recording, run if in_folder else None
    except (RunNotFound, RecordingError):
        folders = (Path(name), recordings_folder(recordings) / name)
        for path in (Path(name), *(folder / RECORDING_FILE for folder in folders)):
            if path.is_file():
                return path, None
        raise


def refuse_running(run: Run | None) -> None:
    """Refuse what cannot be done to a run while it is running.

    Raises:
        RunnerError: it is.
    """
    if run is not None and run.status == "running":
        raise RunnerError(f"run {run.run_id} is running; wait for its end, or interrupt it.")


@contextlib.contextmanager
def announcing() -> Iterator[None]:
    """Say so when a kernel must be compiled, as it must the first time for an algorithm."""
    from runner.learning.compilation import MESSAGE, announced

    with announced(lambda: say(MESSAGE)):
        yield


@contextlib.contextmanager
def at_work(label: str, episodes: int) -> Iterator[tuple[Report, Interrupt]]:
    """Give what a job reports to, and what says whether to stop; as `dualtaxi run` has them."""
    from runner.api import interruptible
    from runner.cli.progress import progress_line

    with (
        interruptible(second=signal.SIG_DFL) as interrupt,
        progress_line(label, episodes) as report,
        announcing(),
    ):
        yield report, interrupt


def run_as_json(run: Run) -> dict[str, Any]:
    """Return what programs want to know of a run that is over."""
    summary = _told(run)
    known = ("content_digest", "episodes", "train_steps", "eval_steps", "seconds", "bytes", "last_evaluation")
    return {
        "run_id": run.run_id,
        "name": run.name,
        "seed": run.seed,
        "status": run.status,
        "path": str(run.recording.absolute()),
        **{key: summary.get(key) for key in known},
    }


def run_in_words(run: Run) -> dict[str, str]:
    """Return the facts of a run that is over, as text by name."""
    summary = _told(run)
    took = "" if summary.get("seconds") is None else f", in {duration(summary['seconds'])}"
    return {
        "run": f"{run.run_id}  {run.title}, {run.status}",
        "steps": _steps_in_words(summary) + took,
        "digest": summary.get("content_digest") or UNKNOWN,
        "file": f"{run.recording}  {size(run.recording.stat().st_size)}",
    }


def _told(run: Run) -> Mapping[str, Any]:
    """Return what a run said at its end; of one that was killed, how far it came by its recording."""
    from runner.recording.reader import open_recording

    if run.summary.train_steps is not None and run.summary.eval_steps is not None:
        return run.summary
    with open_recording(run.recording) as recording:
        return {**recording.done(), **run.summary}


def _steps_in_words(summary: Mapping[str, Any]) -> str:
    return f"{summary['train_steps']:,} of training, {summary['eval_steps']:,} of evaluation"


def tell_received(run: Run, digest: str, already: str, as_json: bool, **more: object) -> None:
    """Tell of a run that came from elsewhere.

    Args:
        run: as it is here.
        digest: of its content.
        already: what was there already, such as `this content`; empty if it was written now.
        as_json: tell it as JSON.
        more: what else programs want to know.
    """
    if already:
        say(f"Run {run.run_id} is there already with {already}; nothing was written.")
    if as_json:
        told = {"run_id": run.run_id, "name": run.name, "seed": run.seed, "status": run.status}
        told |= {"path": str(run.recording.absolute()), "already": bool(already)}
        print_json(told | {"content_digest": digest} | more)
        return
    draw(
        facts(
            {
                "run": f"{run.run_id}  {run.title}, {run.status}",
                "digest": digest,
                "file": f"{run.recording}  {size(run.recording.stat().st_size)}",
                "next": suggested(run, "show"),
            }
        )
    )
