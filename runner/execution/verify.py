"""Verify that a recording is what its job gives: every byte, step, metric and table.

A job determines its content, so the strongest check is also the simplest: run the job again, in memory, and
compare. With the environment data in the recording this checks the recording against itself (each step among
the outcomes, each draw as the seed gives it, each metric, episode and table as the steps make them); with the
installed environment, whether the run can be reproduced here and now.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from runner.config import from_mapping
from runner.config.job import Job
from runner.environments.loading import load_mdp
from runner.environments.mdp import Mdp
from runner.errors import (
    CannotRedo,
    ConfigError,
    CutOff,
    Diverged,
    EnvironmentNotUsable,
    OtherVersion,
    RecordingError,
    RunnerError,
)
from runner.execution.initial_tables import recorded_tables
from runner.execution.session import Report, Session, recorder_for
from runner.execution.verification import (
    CIRCUMSTANCES,
    LOOP_NOT_COMPARED,
    NAMES_NOT_COMPARED,
    Verdict,
    Verification,
    compare_names,
    compare_result,
    compare_values,
    with_difference,
)
from runner.learning.learner import Learner
from runner.recording import schema
from runner.recording.composition import composition_of
from runner.recording.consistency import Findings, Inconsistent, check_extras, check_phase
from runner.recording.digest import combined_digest
from runner.recording.integrity import check_integrity, refuse_foreign, survey
from runner.recording.reader import Recording, open_recording
from runner.recording.records import Report as BytesReport
from runner.recording.reference import Reference
from runner.recording.rewriting import content_hash
from runner.recording.run_file import has_environment
from runner.replay.trust import require_may_train
from runner.runs.checkpoints import read_checkpoints
from runner.runs.listing import run_at
from runner.runs.provenance import Differences, differing_provenance
from runner.util.humanize import counted


def verify(
    path: Path,
    rerun: bool | None = None,
    *,
    sample: int | None = None,
    tolerance: float = 0.0,
    trust: bool = False,
    report: Report = lambda _: None,
) -> Verification:
    """Verify a recording: check its file, then retrain its job, or rerun its environment.

    Args:
        path: the recording.
        rerun: of a job, whether to retrain it with the installed environment instead of the recorded one; of
            a loop, False checks only the file.
        sample: how many episodes of a loop to rerun, at even distances; None for all that happened.
        tolerance: absolute and relative, for a loop's floating-point observations and rewards; 0 compares
            bytes.
        trust: whether an environment may be made that `runner.replay.trust` refuses.
        report: called with the progress of a job's training a few times a second.

    Raises:
        RecordingError: there is no such file, or it is not a dualtaxi recording.
    """
    found = check(path, damage_of(path), bool(rerun), report, trust)
    if rerun is False or not found.is_loop:
        return found
    from runner.execution.rerun import rerun_loop  # slow to import

    return rerun_loop(found, sample, tolerance, trust)


def damage_of(path: Path, report: BytesReport = lambda *_: None) -> RecordingError | None:
    """Return the first damage of a recording's bytes, if there is any.

    Raises:
        RecordingError: there is no such file, or it is no recording of a version that is read.
    """
    refuse_foreign(path)
    try:
        check_integrity(path, report)
    except OtherVersion:
        raise
    except RecordingError as error:
        return error
    return None


def check(
    path: Path,
    damage: RecordingError | None,
    installed: bool = False,
    report: Report = lambda _: None,
    trust: bool = False,
) -> Verification:
    """Check a recording's file; retrain its job, but do not rerun the environment of a loop.

    Args:
        path: the recording.
        damage: the result of `damage_of`.
        installed: retrain with the installed environment instead of the recorded one.
        report: called with the progress a few times a second.
        trust: whether an installed environment may be made that `runner.replay.trust` refuses.
    """
    is_cut = isinstance(damage, CutOff) and not _states_its_end(path)
    try:
        with open_recording(path) as recording:
            found = _check_content(recording, installed, report, trust)
            found = replace(found, composition=composition_of(recording))
            unreadable = "" if damage is None or is_cut else _first_unreadable(recording)
    except (RecordingError, ConfigError) as error:
        if is_cut and not survey(path).chunks:
            return Verification(path, verdict="interrupted")
        finding = str(damage or error)
        with contextlib.suppress(RecordingError), open_recording(path) as recording:
            finding += _first_unreadable(recording)
        return Verification(path, verdict="damaged", finding=finding)
    if damage is None:
        return found
    if is_cut and found.sound:
        note = str(damage).removeprefix(f"{path}: ")
        return replace(found, verdict="interrupted", content_digest="", notes=(*found.notes, note))
    if found.sound:
        return replace(found, verdict="damaged", finding=f"{damage}{unreadable}", content_digest="")
    verdict = found.verdict if is_cut else "damaged"
    return replace(found, verdict=verdict, notes=(*found.notes, str(damage)), if_rerun=None)


def _states_its_end(path: Path) -> bool:
    """Return whether the run of a recording was closed, as `run.json` states: then its file was whole."""
    with contextlib.suppress(RunnerError):
        run = run_at(path).file
        return run.status != "running" and run.summary.content_digest is not None
    return False


def _first_unreadable(recording: Recording) -> str:
    """Return a sentence that names the first message that cannot be read; empty if all can."""
    for topic in set(schema.ROW_TOPICS) & set(recording.topics):
        name = schema.NUMBERED_BY[topic.message]
        number = 0
        try:
            for block in recording.table(topic).rows():
                number = int(block[name][-1]) + 1
        except RecordingError:
            return f" {topic.name}: {name} {number} is the first that cannot be read."
    return ""


def _check_content(recording: Recording, installed: bool, report: Report, trust: bool) -> Verification:
    verification = Verification(recording.path)
    if recording.lost:
        holes = "; ".join(
            f"{topic}: found none of number {first} to {end - 1}, expected {end - first}"
            for topic, places in recording.lost.items()
            for first, end in places
        )
        finding = f"{recording.path}: {holes}: lost in a repair. `dualtaxi resume` retrains the job."
        return replace(verification, verdict="damaged", finding=finding)
    if unfolded := recording.result.unfolded:
        processes = [f"{name or 'the process that began it'}: {what}" for name, what in unfolded.items()]
        finding = f"{recording.path}: lacks what processes recorded: {' '.join(processes)}"
        return replace(verification, verdict="damaged", finding=finding)
    if not recording.can_train_again:
        return _check_loop(recording)
    job = Job(from_mapping(recording.config), recording.seed or 0)
    if recording.run["job"] != job.identity:
        return with_difference(
            verification, Diverged("metadata run", "job", recording.run["job"], job.identity)
        )
    return _retrain(recording, job, installed, report, trust)


def _retrain(recording: Recording, job: Job, installed: bool, report: Report, trust: bool) -> Verification:
    env, complete = job.config.env, recording.status == "finished"
    verification = Verification(
        recording.path,
        verdict="reproduced" if complete else "interrupted",
        act="retrained",
        environment="installed" if installed else "recorded",
    )
    try:
        if installed:
            require_may_train(recording.path, recording.config, trust)
        mdp = load_mdp(env.id, env.kwargs, job.config.rewards) if installed else recording.mdp
    except (CannotRedo, EnvironmentNotUsable) as error:
        verdict: Verdict = "consistent" if complete else "interrupted"
        return Verification(recording.path, verdict, reason=str(error))
    learner = Learner(job.config, mdp, job.seed, recorded_tables(recording))
    try:
        compare_names(recording, list(learner.agents))
    except Diverged as error:
        return with_difference(verification, error)
    reference = Reference(recording, complete)
    recorder = recorder_for(job, learner, None, reference)
    variable = set(schema.TOPICS) - set(schema.BLOCK_TOPICS) - {schema.LOG_TOPIC}
    recorded = {topic.name: recording.table(topic).count() for topic in variable}

    def all_compared() -> bool:
        return reference.exhausted and all(recorder.counts[name] >= n for name, n in recorded.items())

    session = Session(job, learner, recorder, report, stop=lambda: not complete and all_compared())
    if installed:  # what may explain a difference
        changes = differing_provenance(recording.provenance) | differing_environment(recording, mdp)
        changes = {key: values for key, values in changes.items() if key not in CIRCUMSTANCES}
        verification = replace(verification, changes=changes)
    else:
        verification = replace(verification, not_compared=NAMES_NOT_COMPARED)
    try:
        ended = session.run()
        topics = recorder.drain()
        if complete or ended:
            reference.check_exhausted()
        if installed:
            description = json.loads(json.dumps(mdp.description()))
            for key in sorted(description):
                compare_values(key, recording.environment.get(key), description[key])
    except Diverged as error:
        return with_difference(verification, error, "differs")
    finally:
        recorder.abandon()
    result = recording.result
    # an interrupted run that stated its result is compared with it if all steps of the result are recorded
    whole = complete or bool(result.content_digest and result.steps_recorded)
    steps = {"train": recording.train.steps.count(), "eval": recording.eval.steps.count()}
    if whole:  # else the job was run a little further than it is recorded
        steps = recorder.steps
    verification = replace(
        verification,
        train_steps=steps["train"],
        eval_steps=steps["eval"],
        steps=steps["train"] + steps["eval"],
        episodes=recording.train.episodes.count(),
    )
    return compare_result(verification, recording, session.summary(topics)) if whole else verification


def differing_environment(recording: Recording, mdp: Mdp) -> Differences:
    """Return which arrays of an environment differ from the recorded ones."""
    then, now = recording.mdp.arrays(), mdp.arrays()
    return {
        f"environment.{name}": ("as recorded", "another")
        for name in sorted({*then, *now})
        if name not in then or name not in now or not np.array_equal(then[name], now[name])
    }


def _check_loop(recording: Recording) -> Verification:
    """Check the file of a user's own loop; `runner.execution.rerun` reruns its environment.

    Compared are the numbers of its messages, its steps with the environment's outcomes where it is tabular,
    steps, resets and episodes with one another, and its digest with its messages.
    """
    finished = "content_digest" in recording.result
    notes: list[str] = []
    if recording.leaves_out_steps:
        notes.append("whole steps were left out: digests represent their observations and rewards")
    is_over = finished and recording.status != "interrupted"
    verification = Verification(
        recording.path,
        verdict="consistent" if is_over else "interrupted",
        train_steps=recording.train.steps.total(),
        eval_steps=recording.eval.steps.total(),
        not_compared=LOOP_NOT_COMPARED if has_environment(recording.config) else "",
        is_loop=True,
    )
    try:
        compare_names(recording)
        phases = {phase: check_phase(recording, phase, finished) for phase in schema.PHASES}
        for phase in phases:
            check_extras(recording, phase, finished)
        notes += _check_checkpoints(recording)
        if not_outcomes := sum(findings.not_outcomes for findings in phases.values()):
            reason = "are no outcome of the environment's table: it has other rules too"
            notes.append(f"{not_outcomes:,} steps {reason}")
        for phase, findings in phases.items():
            notes += _unusual(recording, phase, findings)
        steps = verification.train_steps + verification.eval_steps
        last = max(findings.last_time for findings in phases.values())
        if finished and steps and last != steps * schema.STEP_NANOSECONDS:
            taken = last // schema.STEP_NANOSECONDS
            raise Inconsistent(f"found {steps:,} steps, expected {taken:,} by the time of the last")
    except Inconsistent as error:
        finding = f"{recording.path}: {error}"
        return replace(verification, verdict="damaged", notes=tuple(notes), finding=finding)
    except Diverged as error:
        return with_difference(replace(verification, notes=tuple(notes)), error)
    verification = replace(verification, notes=tuple(notes))
    off_table = sum(findings.rewards_off_table for findings in phases.values())
    found = _compare_totals(recording, verification, off_table, finished)
    if found.sound and (unlikely := _unlikely(recording, phases)):
        finding = f"{recording.path}: {unlikely}"
        return replace(found, verdict="damaged", finding=finding, content_digest="", if_rerun=found)
    return found


def _compare_totals(
    recording: Recording, verification: Verification, off_table: int, finished: bool
) -> Verification:
    """Read the messages that nothing else has read, and compare all with the result, if the loop ended.

    Args:
        off_table: steps whose reward the environment's table excludes.
    """
    counts = {
        topic.name: recording.table(topic).count() if recording.table(topic) else 0
        for topic in recording.topics
        if topic not in schema.MACHINE_TOPICS
    }
    if not finished:
        return verification
    digests = content_hash(recording).topics()
    if recording.leaves_out_steps:
        stated = recording.result.topic_digests
        digests |= {name: stated[name] for name in schema.STEP_TOPICS if name in stated}
        counts |= {name: recording.result.messages.get(name, 0) for name in schema.STEP_TOPICS}
    expected = {
        "topic_digests": digests,
        "messages": {name: count for name, count in counts.items() if count},
        "train_steps": counts["/train/step"],
        "eval_steps": counts["/eval/step"],
        "episodes": counts["/train/episode"],
        "content_digest": combined_digest(digests),
    }
    if recording.result.rewards_off_table is not None and not recording.leaves_out_steps:
        expected["rewards_off_table"] = off_table
    return compare_result(verification, recording, expected)


def _check_checkpoints(recording: Recording) -> list[str]:
    """Compare the contents of a run's checkpoints with their digests; return a note if some are not here.

    Raises:
        Inconsistent: one was changed, or the recording has an invalid one.
    """
    missing = []
    try:
        for checkpoint in read_checkpoints(recording, recording.path.absolute().parent.parent):
            if checkpoint.path.exists():
                checkpoint.check()
            else:
                missing.append(checkpoint.reference)
    except RecordingError as error:
        raise Inconsistent(str(error)) from error
    if not missing:
        return []
    return [f"the contents of {len(missing):,} checkpoints are not here, the first {missing[0]}"]


def _unusual(recording: Recording, phase: str, findings: Findings) -> Iterator[str]:
    """Yield notes on what is unusual in a phase of a loop, but possible.

    Raises:
        Inconsistent: the environment cannot have done it.
    """
    topic = recording.phase(phase).steps.topic
    if findings.rewards_off_table:
        where = f"{topic.name}, step {findings.first_off_table}: rewards"
        if recording.result.rewards_off_table == 0:
            raise Inconsistent(f"{where}: found one that the environment's table excludes for this step")
        count = findings.rewards_off_table
        yield f"{where}: {count:,} steps have rewards that are not in the environment's table"
    if findings.begun_without:
        episodes = counted(findings.begun_without, "episode")
        yield f"{topic.name}, step {findings.first_without}: {episodes} began without a reset"


def _unlikely(recording: Recording, phases: Mapping[str, Findings]) -> str:
    """Return what a lost or forged reset would leave: an episode without one; empty if no episode is so.

    A loop may also step its environment after the end of an episode, but few do.
    """
    for phase, findings in phases.items():
        if findings.begun_by_reset >= findings.begun_without > 0:
            where = f"{recording.phase(phase).steps.topic.name}, step {findings.first_without}"
            return f"{where}: found an episode without a reset before it, as others have"
    return ""
