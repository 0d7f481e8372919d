"""Verify that a recording is what its job gives: every byte, step, metric and table.

A job determines its content, so the strongest check is also the simplest: run the job again, in memory, and
compare. With the environment data in the recording this checks the recording against itself (each step among
the outcomes, each draw as the seed gives it, each metric, episode and table as the steps make them); with the
installed environment, whether the run can be reproduced here and now.
"""

from __future__ import annotations

import contextlib
import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
from mcap.writer import MCAP0_MAGIC

from runner.config import from_mapping
from runner.config.job import Job
from runner.environments.loading import load_mdp
from runner.environments.mdp import Mdp
from runner.errors import ConfigError, Diverged, RecordingError
from runner.execution.initial_tables import recorded_tables
from runner.execution.session import Report, Session, recorder_for
from runner.execution.verification import (
    CIRCUMSTANCES,
    NAMES_NOT_COMPARED,
    NOT_COMPLETE,
    Verification,
    compare_names,
    compare_result,
    compare_values,
    with_difference,
)
from runner.execution.verify_loop import verify_loop
from runner.learning.learner import Learner
from runner.recording import schema
from runner.recording.integrity import check_integrity, may_be_cut, refuse_foreign, survey
from runner.recording.reader import Recording, open_recording
from runner.recording.records import Report as BytesReport
from runner.recording.reference import Reference
from runner.runs.provenance import Differences, differing_provenance
from runner.util.files import open_regular


def damage_of(path: Path, report: BytesReport = lambda *_: None) -> str:
    """Return the first damage of a recording's bytes; empty if there is none."""
    refuse_foreign(path)
    try:
        check_integrity(path, report)
    except RecordingError as error:
        return str(error)
    return ""


def verify(
    path: Path, rerun: bool = False, report: Report = lambda _: None, damage: str | None = None
) -> Verification:
    """Verify a recording.

    Args:
        path: the recording.
        rerun: compare with the installed environment's job instead of the recorded environment's.
        report: called with the progress a few times a second.
        damage: the result of `damage_of`, if it was called before; by default it is called here.

    Raises:
        RecordingError: there is no such file, or it is not a dualtaxi recording.
        EnvironmentNotUsable: the environment is not installed, for a rerun.
    """
    damage = damage_of(path) if damage is None else damage
    try:
        with open_recording(path) as recording:
            verification = _verify_content(recording, rerun, report)
            damage = damage and damage + _first_unreadable(recording)
    except (RecordingError, ConfigError) as error:
        if damage and _is_empty(path):
            return Verification(path, nothing_yet=True)
        finding = damage or str(error)
        with contextlib.suppress(RecordingError), open_recording(path) as recording:
            finding += _first_unreadable(recording)
        return Verification(path, finding=finding)
    if not damage:
        return verification
    if _is_empty(path):
        return Verification(path, nothing_yet=True)
    if verification.sound:
        return replace(verification, finding=damage, content_digest="")
    return replace(verification, notes=(*verification.notes, damage))


def _is_empty(path: Path) -> bool:
    """Return whether a recording is cut off before its first messages, and not damaged otherwise."""
    try:
        with open_regular(path) as stream:
            stream.seek(-len(MCAP0_MAGIC), os.SEEK_END)
            if stream.tell() and stream.read() == MCAP0_MAGIC:
                return False  # it was closed: a damaged length may look like a cut
        contents = survey(path)
        return not contents.chunks and may_be_cut(path, contents)
    except (RecordingError, OSError):
        return False


def _first_unreadable(recording: Recording) -> str:
    """Return a sentence that names the first message that cannot be read; empty if all can."""
    for topic in recording.dtypes:
        name = schema.NUMBERED_BY[topic.message]
        number = 0
        try:
            for block in recording.blocks(topic):
                number = int(block[name][-1]) + 1
        except RecordingError:
            return f" {topic.name}: {name} {number} is the first that cannot be read."
    return ""


def _verify_content(recording: Recording, rerun: bool, report: Report) -> Verification:
    verification = Verification(recording.path)
    if recording.lost:
        holes = "; ".join(
            f"{topic}: found none of number {first} to {end - 1}, expected {end - first}"
            for topic, places in recording.lost.items()
            for first, end in places
        )
        finding = f"{recording.path}: {holes}: lost in a repair. `dualtaxi resume` runs the job again."
        return replace(verification, finding=finding)
    if not recording.can_train_again:
        return verify_loop(recording)
    job = Job(from_mapping(recording.config), recording.seed or 0)
    if recording.job != job.identity:
        return with_difference(verification, Diverged("metadata run", "job", recording.job, job.identity))
    return _verify_job(recording, job, rerun, report)


def _verify_job(recording: Recording, job: Job, rerun: bool, report: Report) -> Verification:
    env, complete = job.config.env, recording.status == "finished"
    mdp = load_mdp(env.id, env.kwargs, job.config.rewards) if rerun else recording.mdp
    reference = Reference(recording, complete, without_steps=job.config.recording.steps == "none")
    learner = Learner(job.config, mdp, job.seed, recorded_tables(recording))
    recorder = recorder_for(job, learner, None, reference)
    variable = set(schema.TOPICS) - set(schema.BLOCK_TOPICS) - {schema.LOG_TOPIC}
    recorded = {topic.name: recording.count(topic) for topic in variable}

    def all_compared() -> bool:
        return reference.exhausted and all(recorder.counts[name] >= n for name, n in recorded.items())

    session = Session(job, learner, recorder, report, stop=lambda: not complete and all_compared())
    verification = Verification(recording.path, notes=() if complete else (NOT_COMPLETE,))
    if rerun:  # what may explain a difference
        changes = differing_provenance(recording.provenance) | differing_environment(recording, mdp)
        changes = {key: values for key, values in changes.items() if key not in CIRCUMSTANCES}
        verification = replace(verification, provenance=changes)
    else:
        verification = replace(verification, not_compared=NAMES_NOT_COMPARED)
    try:
        compare_names(recording, list(session.learners))
        ended = session.run()
        topics = recorder.drain()
        if complete or ended:
            reference.check_exhausted()
        if rerun:
            description = json.loads(json.dumps(mdp.description()))
            for key in sorted(description):
                compare_values(key, recording.environment.get(key), description[key])
    except Diverged as error:
        return with_difference(verification, error)
    finally:
        recorder.abandon()
    result = recording.result
    # an interrupted run that stated its result is compared with it if all steps of the result are recorded
    whole = complete or bool(result.content_digest and result.steps_recorded)
    steps = {"train": recording.count(schema.TRAIN_STEP), "eval": recording.count(schema.EVAL_STEP)}
    if whole:  # else the job was run a little further than it is recorded
        steps = recorder.steps
    verification = replace(verification, train_steps=steps["train"], eval_steps=steps["eval"])
    return compare_result(verification, recording, session.summary(topics)) if whole else verification


def differing_environment(recording: Recording, mdp: Mdp) -> Differences:
    """Return which arrays of an environment differ from the recorded ones."""
    then, now = recording.mdp.arrays(), mdp.arrays()
    return {
        f"environment.{name}": ("as recorded", "another")
        for name in sorted({*then, *now})
        if name not in then or name not in now or not np.array_equal(then[name], now[name])
    }
