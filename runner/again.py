"""A recorded run taken up again: its steps recorded later, its table played in new episodes."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, Literal

from runner import runs
from runner.config import ExperimentConfig, from_mapping
from runner.errors import Diverged, RunnerError
from runner.execution import Report, Session, Stop, describe, recorder_for, run_job, write_result
from runner.job import Job
from runner.learning.learner import Learner
from runner.mdp import load_mdp
from runner.provenance import provenance
from runner.recording.reader import open_recording
from runner.recording.writer import RecordingFile
from runner.runs import Run
from runner.verify import initial_tables


def rerecord(run: Run, report: Report = lambda _: None, stop: Stop = lambda: False) -> Run:
    """Record the steps of a run that left them out; proven by the digest that they had.

    The new recording takes the old one's place when it is complete and has the same content digest.

    Raises:
        RunnerError: the run is not finished, or holds its steps already.
        Diverged: the job gives another content here than it gave then; the recording stays as it is.
    """
    if run.status != "finished":
        raise RunnerError(
            f"run {run.run_id} is {run.status}; `dualtaxi resume {run.run_id}` finishes it first."
        )
    config = from_mapping(run.facts["config"])
    if config.recording.steps == "all":
        raise RunnerError(f"run {run.run_id} holds its steps already; there is nothing to do.")
    config = _with(config, recording=config.to_mapping()["recording"] | {"steps": "all"})
    job = Job(config, run.seed)
    fresh = run.recording.with_suffix(".rerecording")
    fresh.unlink(missing_ok=True)
    started = time.monotonic()
    try:
        summary = _record(job, run, fresh, report, stop)
    except BaseException:
        fresh.unlink(missing_ok=True)
        raise
    fresh.replace(run.recording)
    summary |= {"seconds": round(time.monotonic() - started, 3), "bytes": run.recording.stat().st_size}
    return run.update(config=config.to_mapping(), summary=summary)


def evaluate(
    run: Run,
    recordings: Path,
    step: int | None = None,
    trials: int = 200,
    start: int | Literal["random", "each"] = "random",
    seed: int = 0,
    report: Report = lambda _: None,
    stop: Stop = lambda: False,
) -> Run:
    """Play a run's table of some moment, greedily, in new episodes, recorded as a run of its own.

    Args:
        run: whose table; the new run's `initial_q` names it.
        recordings: the folder for the new run.
        step: after how many training steps; None for the last.
        trials: how many episodes.
        start: where they start: at random, in each start state in turn, or in one state.
        seed: fixes the new run's draws.
        report: called with the progress a few times a second.
        stop: asked every few milliseconds whether to stop.

    Raises:
        RunnerError: the table cannot be had, or the new run not be recorded.
    """
    known = run.folder.parent.resolve() == recordings.resolve()
    origin = {"run": run.run_id if known else str(run.recording.resolve()), "step": step}
    config = _with(
        from_mapping(run.facts["config"]),
        name=f"{run.name[:90]}.evaluated",
        seeds=[seed],
        episodes=0,
        initial_q=origin,
        evaluation={"every": 1, "trials": trials, "start": start},
        snapshots={"every": None},
    )
    job = Job(config, seed)
    return run_job(job, runs.create_run(recordings, config, seed), report, stop)


def _record(job: Job, run: Run, fresh: Path, report: Report, stop: Stop) -> dict[str, Any]:
    """Do the job again into a new file; return its summary, proven to be the old one's."""
    mdp = load_mdp(job.config.env.id, job.config.env.kwargs, job.config.rewards)
    with open_recording(run.recording) as recording:
        learner = Learner(job.config, mdp, job.seed, initial_tables(recording))
        expected, made_by = recording.result["content_digest"], recording.provenance
    with RecordingFile(fresh) as file:
        describe(file, job, run, learner, made_by)
        file.add_metadata("rerecord", provenance())
        session = Session(job, learner, recorder_for(job, learner, file, beat=run.beat), report, stop)
        try:
            done = session.run()
            topics = session.recorder.drain()
        except BaseException:
            session.recorder.abandon()
            raise
        if not done:
            raise RunnerError(f"stopped; the recording of run {run.run_id} is as it was.")
        summary = session.summary(topics)
        if summary["content_digest"] != expected:
            raise Diverged("the recording", "content digest", summary["content_digest"], expected)
        write_result(file, {"status": "finished", **summary})
    return summary


def _with(config: ExperimentConfig, **changes: Any) -> ExperimentConfig:
    """Return the configuration with other values for some keys."""
    return from_mapping(config.to_mapping() | changes)
