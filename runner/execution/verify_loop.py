"""Verify the recording of a loop: its bytes, and what in it follows from the rest."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from runner.errors import Diverged, RecordingError
from runner.execution.verification import (
    LOOP_NOT_COMPARED,
    Verification,
    compare_names,
    compare_result,
    with_difference,
)
from runner.recording import schema
from runner.recording.consistency import Findings, Inconsistent, check_extras, check_phase
from runner.recording.digest import combined_digest
from runner.recording.reader import Recording
from runner.recording.rewriting import content_hash
from runner.recording.run_file import has_environment
from runner.runs.checkpoints import read_checkpoints


def verify_loop(recording: Recording) -> Verification:
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
            strange = f"{not_outcomes:,} steps"
            notes.append(f"{strange} are no outcome of the environment's table: it has other rules too")
        for phase, findings in phases.items():
            notes += _unusual(recording, phase, findings)
        steps, last = (
            verification.train_steps + verification.eval_steps,
            max(each.last_time for each in phases.values()),
        )
        if finished and steps and last != steps * schema.STEP_NANOSECONDS:
            taken = last // schema.STEP_NANOSECONDS
            raise Inconsistent(f"found {steps:,} steps, expected {taken:,} by the time of the last")
    except Inconsistent as error:
        finding = f"{recording.path}: {error}"
        return replace(verification, verdict="damaged", notes=tuple(notes), finding=finding)
    except Diverged as error:
        return with_difference(replace(verification, notes=tuple(notes)), error)
    verification = replace(verification, notes=tuple(notes))
    counts = {  # reads the messages that nothing above has read
        topic.name: recording.table(topic).count() if recording.table(topic) else 0
        for topic in recording.topics
        if topic not in schema.MACHINE_TOPICS
    }
    if not finished:
        return verification
    digests = content_hash(recording).topics()
    if recording.leaves_out_steps:
        stated = recording.result.topic_digests
        for name in schema.STEP_TOPICS:
            counts[name] = recording.result.messages.get(name, 0)
            digests |= {each: digest for each, digest in stated.items() if each == name}
    expected = {
        "topic_digests": digests,
        "messages": {name: count for name, count in counts.items() if count},
        "train_steps": counts["/train/step"],
        "eval_steps": counts["/eval/step"],
        "episodes": counts["/train/episode"],
        "content_digest": combined_digest(digests),
    }
    if recording.result.rewards_off_table is not None and not recording.leaves_out_steps:
        expected["rewards_off_table"] = sum(findings.rewards_off_table for findings in phases.values())
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
        where = f"{topic.name}, step {findings.first_without}"
        if findings.begun_by_reset >= findings.begun_without:
            raise Inconsistent(f"{where}: found an episode without a reset before it, as others have")
        yield f"{where}: {findings.begun_without:,} episodes began without a reset"
