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
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from runner.config import from_mapping
from runner.config.job import Job
from runner.environments.loading import load_mdp
from runner.environments.mdp import Mdp
from runner.errors import ConfigError, Diverged, RecordingError
from runner.execution.initial_tables import recorded_tables
from runner.execution.session import Report, Session, recorder_for
from runner.learning.learner import Learner
from runner.recording import schema
from runner.recording.blocks import message_record
from runner.recording.consistency import Findings, check_extras, check_phase
from runner.recording.digest import ContentHash
from runner.recording.integrity import check_integrity, may_be_cut, refuse_foreign, survey
from runner.recording.loop_blocks import Inconsistent
from runner.recording.reader import Recording, open_recording
from runner.recording.records import Report as BytesReport
from runner.recording.reference import Reference
from runner.runs.checkpoints import read_checkpoints
from runner.runs.provenance import Differences, differing_provenance
from runner.util.files import open_regular

LOOP_NOT_COMPARED: Final = (
    "how its environment is described: scene, names of actions, agents, events and landmarks, step limit"
)
NAMES_NOT_COMPARED: Final = f"{LOOP_NOT_COMPARED}; --rerun compares them with the installed environment"
"""What a verification leaves out: the messages do not depend on it."""
CIRCUMSTANCES: Final = ("command", "directory", "host", "user")  # they cannot explain a difference
_NOT_COMPLETE: Final = "the run did not end; verified as far as it got"


@dataclass(frozen=True)
class Verification:
    """The result of a verification."""

    path: Path
    finding: str = ""
    """The first thing that is wrong, or empty."""
    difference: Diverged | None = None
    """The finding as an error with attributes, if a message or a value differs."""
    train_steps: int = 0
    """Training steps that were compared."""
    eval_steps: int = 0
    """Evaluation steps that were compared."""
    content_digest: str = ""
    """The digest of all that was compared; empty if the recording has none, or is not complete."""
    notes: tuple[str, ...] = ()
    """What a reader should know though it is not wrong."""
    provenance: Differences = field(default_factory=dict)
    """The differences between the recording's provenance and this process's."""
    not_compared: str = ""
    """What of the recording was not compared."""
    needs_redo: bool = False
    """Whether its steps are compared with their environment by `runner.execution.redo` only."""
    nothing_yet: bool = False
    """Whether the run was interrupted before it recorded anything."""

    @property
    def sound(self) -> bool:
        """Whether nothing is wrong."""
        return not self.finding


def damage_of(path: Path, report: BytesReport = lambda *_: None) -> str:
    """Return the first damage of a recording's bytes; empty if there is none.

    Args:
        path: the recording.
        report: called with the bytes checked so far, and those of the file.

    Raises:
        RecordingError: there is no such file, or it is not a dualtaxi recording.
    """
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
            found = _verify_content(recording, rerun, report)
            damage = damage and damage + _first_unreadable(recording)
    except (RecordingError, ConfigError) as error:
        if damage and _is_empty(path):
            return Verification(path, nothing_yet=True)
        finding = damage or str(error)
        with contextlib.suppress(RecordingError), open_recording(path) as recording:
            finding += _first_unreadable(recording)
        return Verification(path, finding=finding)
    if not damage:
        return found
    if _is_empty(path):
        return Verification(path, nothing_yet=True)
    if found.sound:
        return replace(found, finding=damage, content_digest="")
    return replace(found, notes=(*found.notes, damage))


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
    found = Verification(recording.path)
    if recording.lost:
        holes = "; ".join(
            f"{topic}: found none of number {first} to {end - 1}, expected {end - first}"
            for topic, places in recording.lost.items()
            for first, end in places
        )
        finding = f"{recording.path}: {holes}: lost in a repair. `dualtaxi resume` runs the job again."
        return replace(found, finding=finding)
    if not recording.can_train_again:
        return _verify_loop(recording)
    job = Job(from_mapping(recording.config), recording.seed or 0)
    if recording.job != job.identity:
        return _with_difference(found, Diverged("metadata run", "job", recording.job, job.identity))
    return _verify_job(recording, job, rerun, report)


def _with_difference(found: Verification, error: Diverged) -> Verification:
    return replace(found, finding=str(error), difference=error)


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
    found = Verification(recording.path, notes=() if complete else (_NOT_COMPLETE,))
    if rerun:  # what may explain a difference
        changes = differing_provenance(recording.provenance) | differing_environment(recording, mdp)
        changes = {key: values for key, values in changes.items() if key not in CIRCUMSTANCES}
        found = replace(found, provenance=changes)
    else:
        found = replace(found, not_compared=NAMES_NOT_COMPARED)
    try:
        _compare_names(recording, list(session.learners))
        ended = session.run()
        topics = recorder.drain()
        if complete or ended:
            reference.check_exhausted()
        if rerun:
            description = json.loads(json.dumps(mdp.description()))
            for key in sorted(description):
                _compare_values(key, recording.environment.get(key), description[key])
    except Diverged as error:
        return _with_difference(found, error)
    finally:
        recorder.abandon()
    result = recording.result
    # an interrupted run that stated its result is compared with it if all steps of the result are recorded
    whole = complete or bool(result.content_digest and result.steps_recorded)
    steps = {"train": recording.count(schema.TRAIN_STEP), "eval": recording.count(schema.EVAL_STEP)}
    if whole:  # else the job was run a little further than it is recorded
        steps = recorder.steps
    found = replace(found, train_steps=steps["train"], eval_steps=steps["eval"])
    return _compare_result(found, recording, session.summary(topics)) if whole else found


def _compare_names(recording: Recording, learners: list[str] | None = None) -> None:
    """Compare the names that are in a recording more than once.

    Raises:
        Diverged: two of them differ.
    """
    described, config = recording.environment, recording.config.get("env", {})
    for key, name in (("env_id", "id"), ("kwargs", "kwargs")):
        if described.get(key) != config.get(name):
            raise Diverged("environment.json", key, described.get(key), config.get(name))
    if learners is not None and list(recording.agents) != learners:
        raise Diverged("metadata run", "agents", list(recording.agents), learners)


def _compare_values(path: str, found: Any, expected: Any) -> None:
    """Compare two values of the environment's description.

    Raises:
        Diverged: they differ; the error has the path of the first value that does.
    """
    if isinstance(found, dict) and isinstance(expected, dict) and found.keys() == expected.keys():
        for key in sorted(expected):
            _compare_values(f"{path}.{key}", found[key], expected[key])
    elif isinstance(found, list) and isinstance(expected, list) and len(found) == len(expected):
        for k, pair in enumerate(zip(found, expected, strict=True)):
            _compare_values(f"{path}[{k}]", *pair)
    elif found != expected:
        raise Diverged("environment.json", path, found, expected)


def _compare_result(found: Verification, recording: Recording, expected: dict[str, Any]) -> Verification:
    """Compare the result in a recording with the computed one."""
    for key, value in expected.items():
        if recording.result.get(key) != value:
            return _with_difference(found, Diverged("metadata result", key, recording.result.get(key), value))
    return replace(found, content_digest=expected["content_digest"])


def _verify_loop(recording: Recording) -> Verification:
    """Verify the recording of a user's own loop; `runner.execution.redo` does its steps again.

    Compared are the numbers of its messages, its steps with the environment's outcomes where it is tabular,
    steps, resets and episodes with one another, and its digest with its messages.
    """
    finished = "content_digest" in recording.result
    notes = [] if finished else [_NOT_COMPLETE]
    found = Verification(
        recording.path,
        train_steps=recording.count(schema.TRAIN_STEP),
        eval_steps=recording.count(schema.EVAL_STEP),
        not_compared=LOOP_NOT_COMPARED,
        needs_redo=True,
    )
    try:
        _compare_names(recording)
        content = _Content(recording)
        phases = {phase: check_phase(recording, phase, finished, content.add) for phase in ("train", "eval")}
        for phase in phases:
            check_extras(recording, phase, finished, content.add)
        content.add_other_topics()
        notes += _check_checkpoints(recording)
        if content.off_table:
            strange = f"{content.off_table:,} steps"
            notes.append(f"{strange} are no outcome of the environment's table: it has other rules too")
        for phase, findings in phases.items():
            notes += _unusual(recording, phase, findings)
        steps, last = found.train_steps + found.eval_steps, max(each.last_time for each in phases.values())
        if finished and last != steps * schema.STEP_NANOSECONDS:
            taken = last // schema.STEP_NANOSECONDS
            raise Inconsistent(f"found {steps:,} steps, expected {taken:,} by the time of the last")
    except Inconsistent as error:
        return replace(found, notes=tuple(notes), finding=f"{recording.path}: {error}")
    except Diverged as error:
        return _with_difference(replace(found, notes=tuple(notes)), error)
    found = replace(found, notes=tuple(notes))
    if not finished:
        return found
    digest, counts = content.digest, content.counts
    expected = {
        "topic_digests": digest.topics(),
        "messages": {name: count for name, count in counts.items() if count},
        "train_steps": counts["/train/step"],
        "eval_steps": counts["/eval/step"],
        "episodes": counts["/train/episode"],
        "content_digest": digest.content(),
    }
    if recording.result.rewards_off_table is not None:
        expected["rewards_off_table"] = sum(findings.rewards_off_table for findings in phases.values())
    return _compare_result(found, recording, expected)


class _Content:
    """Digest and number of the messages of a loop's recording, and its steps outside the outcome table."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self.digest = ContentHash()
        self.counts = {topic.name: 0 for topic in recording.topics}
        self.off_table = 0

    def add(self, topic: schema.Topic, block: NDArray[np.void]) -> None:
        """Add messages of a fixed-width topic."""
        self.digest.update(topic, np.ascontiguousarray(block).view(np.uint8).data)
        self.counts[topic.name] += len(block)
        if topic.message is schema.STEP and self._recording.tabular:
            outcomes = self._recording.mdp.outcomes_to(block["state"], block["action"], block["next_state"])
            self.off_table += int(np.count_nonzero(~outcomes.any(axis=1)))

    def add_other_topics(self) -> None:
        """Add all messages of the topics of varying size whose number a result states."""
        for topic in self._recording.topics:
            is_added = topic in self._recording.dtypes or topic.message is schema.EXTRA
            if is_added or topic in schema.MACHINE_TOPICS:
                continue
            for time, payload in self._recording.messages(topic):
                if topic.digested:
                    self.digest.update(topic, message_record(topic, time, payload))
                self.counts[topic.name] += 1


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
    if findings.rewards_off_table:
        where = f"/{phase}/step, step {findings.first_off_table}: rewards"
        if recording.result.rewards_off_table == 0:
            raise Inconsistent(f"{where}: found one that the environment's table excludes for this step")
        count = findings.rewards_off_table
        yield f"{where}: {count:,} steps have rewards that are not in the environment's table"
    if findings.begun_without:
        where = f"/{phase}/step, step {findings.first_without}"
        if findings.begun_by_reset >= findings.begun_without:
            raise Inconsistent(f"{where}: found an episode without a reset before it, as others have")
        yield f"{where}: {findings.begun_without:,} episodes began without a reset"


def differing_environment(recording: Recording, mdp: Mdp) -> Differences:
    """Return which arrays of an environment differ from the recorded ones."""
    then, now = recording.mdp.arrays(), mdp.arrays()
    return {
        f"environment.{name}": ("as recorded", "another")
        for name in sorted({*then, *now})
        if name not in then or name not in now or not np.array_equal(then[name], now[name])
    }
