"""Record the steps of a finished run later; evaluate its Q-table in new episodes."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np

from runner.config import ExperimentConfig, from_mapping
from runner.config.job import Job
from runner.environments.loading import load_mdp
from runner.errors import Diverged, RunnerError
from runner.execution.initial_tables import address, recorded_tables
from runner.execution.rerecord_loop import rerecord_loop
from runner.execution.session import Report, Session, Stop, describe, recorder_for, run_job
from runner.learning.learner import Learner
from runner.recording import schema
from runner.recording.code import CODE_ATTACHMENT, CODE_RECORD
from runner.recording.metadata import write_result
from runner.recording.reader import open_recording
from runner.recording.writer import RecordingFile
from runner.replay.steps import last_step
from runner.replay.tables import tables_at
from runner.runs import run as runs
from runner.runs.locking import locked
from runner.runs.provenance import provenance
from runner.runs.run import Run, unless_empty
from runner.util.files import storage_errors

Start = int | Literal["random", "each"]


def holds_steps(run: Run) -> bool:
    """Return whether a run's recording has its steps."""
    with open_recording(run.recording) as recording:
        return not recording.leaves_out_steps


def is_done_again(run: Run) -> bool:
    """Return whether the steps of a run come again from its environment, not from training."""
    if not run.recording.is_file():
        return False
    with open_recording(run.recording) as recording:
        return not recording.can_train_again


def rerecord(
    run: Run,
    report: Report = lambda _: None,
    stop: Stop = lambda: False,
    *,
    trust: bool = False,
    count: Callable[[int], None] = lambda _: None,
) -> Run:
    """Record the steps of a run that left them out.

    A job is trained again; a loop's environment takes the recorded actions again. The new recording replaces
    the old one when it is complete and has the same content digest. A run that has its steps is returned as
    it is.

    Args:
        run: the run.
        report: called with the progress of a job, a few times a second.
        stop: called every few milliseconds while a job is trained; return True to stop.
        trust: whether the environment may be imported that a loop's recording names, if no installed package
            registers it.
        count: called with the number of steps of a loop that were done, a few times a second.

    Raises:
        CannotRedo: the environment of a loop cannot be had.
        RunnerError: the run is not finished, or its folder cannot be used.
        Diverged: the job gives another content than it gave then; the recording stays as it is.
        KeyboardInterrupt: `stop` returned True; the recording stays as it is.
    """
    with locked(run) as current:
        if is_done_again(current):
            return current if holds_steps(current) else rerecord_loop(current, trust, count)
        if current.status != "finished":
            from_mapping(current.file.config)  # refuses a loop's run, which nobody can resume
            raise RunnerError(
                f"run {run.run_id} is {current.status}; `dualtaxi resume {run.run_id}` finishes it first."
            )
        if holds_steps(current):
            return current
        return _rerecord(current, report, stop)


def _rerecord(run: Run, report: Report, stop: Stop) -> Run:
    config = from_mapping(run.file.config)
    config = _with(config, recording=config.to_mapping()["recording"] | {"steps": "all"})
    fresh = run.recording.with_suffix(".rerecording")
    started = time.monotonic()
    try:
        with storage_errors(fresh):
            fresh.unlink(missing_ok=True)
            summary = _record(Job(config, run.seed), run, fresh, report, stop)
            fresh.replace(run.recording)
    finally:
        fresh.unlink(missing_ok=True)
    summary |= {"seconds": round(time.monotonic() - started, 3), "bytes": run.recording.stat().st_size}
    return run.update(config=config.to_mapping(), summary=summary)


def evaluate(
    run: Run,
    recordings: Path,
    step: int | None = None,
    trials: int | None = 200,
    start: Start = "random",
    seed: int = 0,
    report: Report = lambda _: None,
    stop: Stop = lambda: False,
) -> Run:
    """Play a run's greedy policy at some step in new episodes, recorded as a run of its own.

    Args:
        run: the run with the Q-table, which becomes the new run's `initial_q`.
        recordings: the folder for the new run.
        step: the number of training steps; None for the last.
        trials: the number of episodes; None for one from each start state.
        start: where they start: at random, in each start state in turn, or in one state.
        seed: the new run's seed.
        report: called with the progress a few times a second.
        stop: called every few milliseconds; return True to stop.

    Raises:
        RunnerError: there is no such table, or the new run cannot be recorded.
    """
    config = evaluation_of(run, recordings, step, trials, start, seed)
    fresh = runs.create_run(recordings, config, seed)
    with unless_empty(fresh):
        return run_job(Job(config, seed), fresh, report, stop)


def evaluation_of(
    run: Run, recordings: Path, step: int | None, trials: int | None, start: Start, seed: int
) -> ExperimentConfig:
    """Return the experiment that evaluates a run's table; arguments and errors as for `evaluate`."""
    with open_recording(run.recording) as recording:
        chosen = last_step(recording) if step is None else step
        tables_at(recording, chosen)  # raises here, before there is a new run
        states = recording.mdp.states
        if isinstance(start, int) and not 0 <= start < states:
            raise RunnerError(f"--start: found state {start}, expected one of 0 to {states - 1}.")
        starts = int(np.count_nonzero(recording.mdp.start))
        original = from_mapping(recording.config)
    return _with(
        original,
        name=f"{run.name[:90]}.evaluated",
        seeds=[seed],
        episodes=0,
        initial_q={"run": address(run, recordings), "step": chosen},
        evaluation={
            "every": 1,
            "trials": starts if trials is None else trials,
            "start": "each" if trials is None else start,
        },
        snapshots={"every": None},
        branches=[],
        recording=original.to_mapping()["recording"] | {"steps": "all"},
    )


def _record(job: Job, run: Run, fresh: Path, report: Report, stop: Stop) -> dict[str, object]:
    mdp = load_mdp(job.config.env.id, job.config.env.kwargs, job.config.rewards)
    with open_recording(run.recording) as recording:
        learner = Learner(job.config, mdp, job.seed, recorded_tables(recording))
        expected, made_by = recording.result["content_digest"], recording.metadata("provenance")
        kept = {
            name: recording.metadata(name)
            for name in recording.metadata_names
            if name == CODE_RECORD or name.startswith("resume/")
        }
        circumstances = {topic: list(recording.messages(topic)) for topic in schema.MACHINE_TOPICS}
        code = [entry for entry in recording.attachments() if entry[0] == CODE_ATTACHMENT]
    with RecordingFile(fresh) as file:
        describe(file, job, run, learner, made_by)
        for attachment in code:
            file.add_attachment(*attachment)
        for name, entries in kept.items():
            file.add_metadata(name, entries)
        file.add_metadata("rerecord", provenance())
        recorder = recorder_for(job, learner, file, beat=run.beat, clock=False)
        session = Session(job, learner, recorder, report, stop)
        try:
            for topic, messages in circumstances.items():
                for log_time, payload in messages:
                    recorder.append(topic, payload, log_time // schema.STEP_NANOSECONDS)
            done = session.run()
            topics = session.recorder.drain()
        except BaseException:
            session.recorder.abandon()
            raise
        if not done:
            raise KeyboardInterrupt(f"the recording of run {run.run_id} is as it was")
        summary = session.summary(topics)
        if summary["content_digest"] != expected:
            raise Diverged("the recording", "content digest", summary["content_digest"], expected)
        write_result(file, "finished", summary)
    return summary


def _with(config: ExperimentConfig, **changes: object) -> ExperimentConfig:
    return from_mapping(config.to_mapping() | changes)
