"""Record the steps of a finished run later, of a loop by its actions; evaluate a Q-table in new episodes."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from runner.config import ExperimentConfig, from_mapping
from runner.config.loading import recorded_packing
from runner.config.model import Job
from runner.environments.loading import load_mdp
from runner.errors import CannotRedo, Diverged, RunnerError
from runner.execution.session import Report, Session, address, recorded_tables, recorder_for, run_job
from runner.learning.learner import Learner
from runner.recording import schema
from runner.recording.description import recorded_facts
from runner.recording.digest import combined_digest
from runner.recording.observer import Observer
from runner.recording.reader import Recording, open_recording
from runner.recording.recorder import Recorder
from runner.recording.rewriting import rewrite
from runner.recording.steps import ACTION_TOPICS, after_step, is_taken
from runner.recording.writer import RecordingFile
from runner.replay.engine import Rerun
from runner.replay.makers import stream_from_child, why_not_rerun
from runner.replay.recorded import Piece, pieces
from runner.replay.steps import blank_steps, first_of, last_step, put_states, whole_records
from runner.replay.tables import tables_at
from runner.replay.trust import require_may_train
from runner.runs import run as runs
from runner.runs.provenance import provenance
from runner.runs.run import Run, locked, unless_empty
from runner.util.arrays import Ints, Records
from runner.util.files import storage_errors
from runner.util.humanize import counted
from runner.util.processes import Stop, report_progress

Start = int | Literal["random", "each"]


def holds_steps(run: Run) -> bool:
    """Return whether a run's recording has its steps."""
    with open_recording(run.recording) as recording:
        return not recording.leaves_out_steps


def is_rerun(run: Run) -> bool:
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

    A job is retrained; a loop's environment takes the recorded actions again. The new recording replaces
    the old one when it is complete and has the same content digest. A run that has its steps is returned as
    it is.

    Args:
        run: the run.
        report: called with the progress of a job, a few times a second.
        stop: called every few milliseconds while a job is trained; return True to stop.
        trust: whether an environment may be made that `runner.replay.trust` refuses.
        count: called with the number of steps of a loop that were done, a few times a second.

    Raises:
        CannotRedo: the environment of a loop cannot be had.
        RunnerError: the run is not finished, or its folder cannot be used.
        Diverged: the job gives another content than it gave then; the recording stays as it is.
        KeyboardInterrupt: `stop` returned True; the recording stays as it is.
    """
    with locked(run) as current:
        if is_rerun(current):
            record = partial(_rerun_loop, trust=trust, count=count)
        elif current.status == "finished":
            record = partial(_rerecord_job, report=report, stop=stop, trust=trust)
        else:
            from_mapping(current.file.config)  # refuses a loop's run, which nobody can resume
            raise RunnerError(
                f"run {run.run_id} is {current.status}; `dualtaxi resume {run.run_id}` finishes it first."
            )
        if holds_steps(current):
            return current
        fresh = current.recording.with_suffix(".rerecording")
        started = time.monotonic()
        try:
            with storage_errors(fresh):
                fresh.unlink(missing_ok=True)
                record(current, fresh)
                fresh.replace(current.recording)
        finally:
            fresh.unlink(missing_ok=True)
        with open_recording(current.recording) as recording:
            config = recording.config
            summary = recorded_facts(recording)["summary"]
        seconds = round(time.monotonic() - started, 3)
        size = current.recording.stat().st_size
        return current.update(config=config, summary=summary | {"seconds": seconds, "bytes": size})


def evaluate(
    run: Run,
    recordings: Path,
    step: int | None = None,
    trials: int | None = 200,
    start: Start = "random",
    seed: int = 0,
    report: Report = lambda _: None,
    stop: Stop = lambda: False,
    trust: bool = False,
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
        trust: whether an environment may be made that `runner.replay.trust` refuses.

    Raises:
        CannotRedo: the environment may not be made.
        RunnerError: there is no such table, or the new run cannot be recorded.
    """
    with open_recording(run.recording) as recording:
        after_step = last_step(recording) if step is None else step
        tables_at(recording, after_step)  # raises here, before there is a new run
        states = recording.mdp.states
        if isinstance(start, int) and not 0 <= start < states:
            raise RunnerError(f"start: found state {start}, expected one of 0 to {states - 1}.")
        starts = int(np.count_nonzero(recording.mdp.start))
        original = from_mapping(recording.config)
    config = _with(
        original,
        name=f"{run.name[:90]}.evaluated",
        seeds=[seed],
        episodes=0,
        initial_q={"run": address(run, recordings), "step": after_step},
        evaluation={
            "every": 1,
            "trials": starts if trials is None else trials,
            "start": "each" if trials is None else start,
        },
        snapshots={"every": None},
        branches=[],
        recording=original.to_mapping()["recording"] | {"steps": "all"},
    )
    require_may_train(run.recording, config.to_mapping(), trust)
    fresh = runs.create_run(recordings, config, seed, parent=run)
    with unless_empty(fresh):
        return run_job(Job(config, seed), fresh, report, stop)


def _with(config: ExperimentConfig, **changes: object) -> ExperimentConfig:
    return from_mapping(config.to_mapping() | changes)


def _rerecord_job(run: Run, fresh: Path, report: Report, stop: Stop, trust: bool) -> None:
    """Retrain a job, and write its recording with whole steps into a new file."""
    require_may_train(run.recording, run.file.config, trust)
    with open_recording(run.recording) as recording:
        config = from_mapping(recording.config)
        job = Job(_with(config, recording=config.to_mapping()["recording"] | {"steps": "all"}), run.seed)
        mdp = load_mdp(job.config.env.id, job.config.env.kwargs, job.config.rewards)
        learner = Learner(job.config, mdp, job.seed, recorded_tables(recording))
        expected = recording.result["content_digest"]

    def retrain(file: RecordingFile) -> None:
        recorder = recorder_for(job, learner, file, beat=run.beat, clock=False)
        is_done, digests = Session(job, learner, recorder, report, stop).finish()
        if not is_done:
            raise KeyboardInterrupt(f"the recording of run {run.run_id} is as it was")
        if (digest := combined_digest(digests)) != expected:
            raise Diverged("the recording", "content digest", digest, expected)

    trained = [topic.name for topic in schema.JOB_TOPICS]
    rewrite(run.recording, fresh, _with_all_steps, {"rerecord": provenance()}, trained, retrain)


def _rerun_loop(run: Run, fresh: Path, trust: bool, count: Callable[[int], None]) -> None:
    """Rerun a loop's environment in a child process, and write its recording with whole steps.

    Raises:
        CannotRedo: the environment cannot be had.
        RunnerError: no actions were recorded, or the loop was cut off.
    """
    with open_recording(run.recording) as recording:
        if not recording.has_actions:
            raise RunnerError(
                f"run {run.run_id} was recorded without its actions, so its environment cannot be rerun."
            )
        if recording.result.content_digest is None:
            raise RunnerError(
                f"run {run.run_id} was cut off, so it has no content digest to compare with; "
                f"`dualtaxi verify {run.run_id}` compares the episodes that it has."
            )
        if reason := why_not_rerun(recording, trust):
            raise CannotRedo(reason)
    for done in stream_from_child(_rerecord_loop, run.recording, fresh, trust):
        count(done)


def _rerecord_loop(path: Path, fresh: Path, trust: bool) -> None:
    """Write a loop's recording with whole steps into a new file; runs in a child process."""
    with open_recording(path) as recording:
        rewrite(
            path,
            fresh,
            _with_all_steps,
            left_out=[topic.name for topic in ACTION_TOPICS],
            add=lambda file: _add_steps(recording, file, trust),
        )


def _with_all_steps(name: str, entries: dict[str, str]) -> dict[str, str]:
    """Return a metadata record as a recording with whole steps has it."""
    if name not in ("config", "result"):
        return entries
    values = json.loads(entries["json"])
    if name == "config":
        values["recording"]["steps"] = "all"
    else:
        values["steps_recorded"] = True
        for topic in ACTION_TOPICS:
            values["messages"].pop(topic.name, None)
    return entries | {"json": json.dumps(values, sort_keys=True)}


def _add_steps(recording: Recording, file: RecordingFile, trust: bool) -> None:
    """Rerun the environment, and write the whole steps.

    Raises:
        CannotRedo: the state of the random generators before some steps is not known.
        Diverged: they differ from the recorded ones.
    """
    topics = {phase: recording.phase(phase).steps.topic for phase in schema.PHASES}
    packing = recorded_packing(recording.config)
    recorder = Recorder(file, recording.layout, packing, observer=Observer(file.path.parent))
    try:
        with closing(Rerun(recording, trust)) as rerun:
            states = {phase: np.full(recording.environments, -1, np.int64) for phase in schema.PHASES}
            for piece in pieces(recording, schema.PHASES):
                records = _whole_steps(recording, rerun, piece, states[piece.phase])
                positions = records["log_time"] // schema.STEP_NANOSECONDS
                topic = topics[piece.phase]
                names = (field.name for field in recording.layout.message(topic).fields)
                recorder.put(topic, {name: records[name] for name in names}, positions)
                report_progress(rerun.taken)
        digests = recorder.drain()
    except BaseException:
        recorder.abandon()
        raise
    for name in sorted(topic.name for topic in topics.values()):
        expected = recording.result.topic_digests.get(name)
        if digests.get(name) != expected:
            raise Diverged(name, "digest", digests.get(name), expected)


def _whole_steps(recording: Recording, rerun: Rerun, piece: Piece, states: Ints) -> Records:
    """Return the whole records of the steps of a piece; `states` are as for `put_states`."""
    records = blank_steps(recording, piece.phase, piece.rows)
    for environment in rerun.environments:
        for steps in rerun.steps(piece, environment, draws=False):
            records[steps.recorded["step"] - piece.first] = whole_records(recording, steps)
        if rerun.skipped:
            rows, _ = rerun.recorded_steps(piece, environment)
            of_environment = f" of environment {environment}" if len(rerun.environments) > 1 else ""
            raise CannotRedo(
                f"{counted(rerun.skipped, 'step')} of {schema.PHASE_NAMES[piece.phase]}{of_environment} "
                f"cannot be rerun, from its episode {rows['episode'][0]:,} on: the reset had no seed, and "
                "the state of the random generators before it was not recorded. Whole steps are recorded of "
                f"all episodes or of none; `dualtaxi verify {recording.run_id}` reruns the others."
            )
    are_steps = is_taken(records)
    begun = []
    for reset in piece.resets:
        row = reset.step - piece.first + reset.environment
        if row >= len(records) or are_steps[row]:
            begun.append((row, reset))
        else:
            records[after_step(records.dtype)][row] = first_of(recording, reset)
    put_states(recording, records, states, begun)
    return records
