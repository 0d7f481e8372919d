"""Going on with a run that was interrupted, so that it ends as if it never had been.

The job is done again from its beginning, without recording: what the recording holds already is compared
with what comes, byte for byte, and from its end on everything is recorded. Learning is so much faster
than recording that this costs a fraction of what it saves, and it proves what it continues.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping

import numpy as np
from filelock import FileLock, Timeout

from runner import runs
from runner.config import from_mapping
from runner.errors import RunnerError
from runner.execution import Report, Session, Stop, configured_tables, execute, recorder_for, run_job
from runner.job import Job
from runner.learning.learner import Learner
from runner.mdp import Mdp, load_mdp
from runner.provenance import provenance
from runner.recording.contents import Contents, survey
from runner.recording.past import Past
from runner.recording.reader import Recording, open_recording
from runner.recording.writer import RecordingFile
from runner.runs import Run
from runner.verify import differing_provenance, initial_tables

DECISIVE = ("dualtaxi", "git", "python", "machine", "package.numpy", "package.numba", "package.llvmlite")
"""Provenance that a continued run must share with its beginning, unless told otherwise."""
_NEEDED = {"run", "config", "provenance"}
_LOCK = "owner.lock"


def resume(
    run: Run, accept_changes: bool = False, report: Report = lambda _: None, stop: Stop = lambda: False
) -> Run:
    """Go on with a run to its end; return it as it then is.

    Args:
        run: an interrupted or failed run.
        accept_changes: go on although the code, the environment's package or a numerical library is
            another than at the beginning; recorded. The recorded steps are compared all the same.
        report: called with the progress a few times a second.
        stop: asked every few milliseconds whether to stop.

    Raises:
        RunnerError: the run is finished, or runs; something decisive differs; or what is recorded is
            not what the job gives.
    """
    lock = FileLock(run.folder / _LOCK)
    try:
        lock.acquire(blocking=False)
    except Timeout as error:
        raise RunnerError(f"run {run.run_id} is being resumed by another process.") from error
    try:
        if run.status == "running":
            raise RunnerError(
                f"run {run.run_id} is running (process {run.facts['owner'].get('pid')}); let it."
            )
        return _go_on(run, accept_changes, report, stop)
    finally:
        lock.release()


def _go_on(run: Run, accept_changes: bool, report: Report, stop: Stop) -> Run:
    started = time.monotonic()
    job = Job(from_mapping(run.facts["config"]), run.seed)
    contents = survey(run.recording) if run.recording.is_file() else Contents()
    if not _describes_itself(contents):
        run.recording.unlink(missing_ok=True)
        return run_job(job, _taken_over(run), report, stop)
    mdp = load_mdp(job.config.env.id, job.config.env.kwargs, job.config.rewards)
    with open_recording(run.recording) as recording:
        changes = _changes(recording, mdp)
        initial = initial_tables(recording)
    if changes and not accept_changes:
        raise RunnerError(_refusal(run, changes))
    if initial is None:
        initial = configured_tables(job, run, mdp)
    learner = Learner(job.config, mdp, job.seed, initial)
    run = _taken_over(run)
    with RecordingFile.reopen(run.recording, contents) as file:
        file.add_metadata(f"resume/{_resumes(contents) + 1}", _note(changes))
        with open_recording(run.recording) as recording:
            past = Past(recording, without_steps=job.config.recording.steps == "none")
            recorder = recorder_for(job, learner, file, past, beat=run.beat)
            return execute(Session(job, learner, recorder, report, stop), file, run, started)


def _describes_itself(contents: Contents) -> bool:
    """Return whether a recording got as far as its first chunk: all that describes it stands before."""
    return bool(contents.chunks) and {entry.name for entry in contents.metadata} >= _NEEDED


def _taken_over(run: Run) -> Run:
    return run.update(status="running", owner=runs.owner())


def _changes(recording: Recording, mdp: Mdp) -> dict[str, tuple[str, str]]:
    """Return what is decisive and differs from the recording's beginning: key to (then, now)."""
    changes = {key: values for key, values in differing_provenance(recording).items() if key in DECISIVE}
    then, now = recording.mdp.arrays(), mdp.arrays()
    for name in sorted({*then, *now}):
        if name not in then or name not in now or not np.array_equal(then[name], now[name]):
            changes[f"environment.{name}"] = ("as recorded", "another")
    return changes


def _refusal(run: Run, changes: Mapping[str, tuple[str, str]]) -> str:
    lines = [
        f"  {key}: {then or 'unknown'} then, {now or 'unknown'} now" for key, (then, now) in changes.items()
    ]
    return "\n".join(
        [
            f"run {run.run_id} was begun by something else than what would go on with it:",
            *lines,
            "Bring back what it was begun with, or go on all the same with --accept-changes: every recorded "
            "step is compared either way.",
        ]
    )


def _note(changes: Mapping[str, tuple[str, str]]) -> dict[str, str]:
    """Return the metadata that says who went on, and in spite of which changes."""
    accepted = {key: f"{then} -> {now}" for key, (then, now) in changes.items()}
    return {**provenance(), "accepted_changes": json.dumps(accepted, sort_keys=True)}


def _resumes(contents: Contents) -> int:
    return sum(entry.name.startswith("resume/") for entry in contents.metadata)
