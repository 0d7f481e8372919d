"""Whether a recording is what its job gives: every byte, every step, every figure, every table.

A job fixes its content, so the strongest check is also the simplest one: do the job again, in memory,
and compare. By the environment data in the recording this says whether the recording is true to itself
(each step among the outcomes, each draw as the seed gives it, each metric, episode and table as the
steps make them); by the installed environment, whether the run can be reproduced here and now.
"""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from runner.config import from_mapping
from runner.config.job import Job
from runner.config.sections import RunTable
from runner.environments.loading import load_mdp
from runner.environments.mdp import Mdp
from runner.errors import ConfigError, Diverged, RecordingError
from runner.execution.session import Report, Session, recorder_for
from runner.learning.learner import Held, Learner
from runner.recording import schema
from runner.recording.blocks import message_record
from runner.recording.consistency import Findings, Inconsistent, check_phase
from runner.recording.digest import ContentHash
from runner.recording.integrity import check_integrity, may_be_cut, survey
from runner.recording.reader import Recording, open_recording
from runner.recording.records import Report as BytesReport
from runner.recording.reference import Past
from runner.replay.tables import initially_held
from runner.runs.provenance import provenance
from runner.util.files import open_regular

NAMES_NOT_COMPARED: Final = (
    "how its environment is described: scene, names of actions, agents, events and landmarks, step limit; "
    "--rerun compares them with the installed environment"
)
LOOP_NOT_COMPARED: Final = (
    "how its environment is described: scene, names of actions, agents, events and landmarks, step limit"
)
"""What a verification leaves out: the messages do not depend on it, so that only the environment knows."""
CIRCUMSTANCES: Final = ("command", "directory", "host", "user")
"""Provenance that cannot explain a difference."""


@dataclass(frozen=True)
class Verification:
    """What a verification found."""

    path: Path
    finding: str = ""
    """The first thing that is wrong; empty if nothing is."""
    difference: Diverged | None = None
    """The same by its parts, if a message differs."""
    train_steps: int = 0
    """Training steps that were compared."""
    eval_steps: int = 0
    """Evaluation steps that were compared."""
    content_digest: str = ""
    """Of all that was compared; empty if the recording does not state it, or is not whole."""
    notes: tuple[str, ...] = field(default=())
    """What a reader should know though it is not wrong."""
    provenance: dict[str, tuple[str, str]] = field(default_factory=dict)
    """Where this process and the recording's differ: key to (recording, here)."""

    not_compared: str = ""
    """What of the recording nothing was compared with."""
    nothing_yet: bool = False
    """Whether the run was interrupted before it recorded anything."""

    @property
    def sound(self) -> bool:
        """Whether nothing is wrong."""
        return not self.finding


def damage_of(path: Path, report: BytesReport = lambda *_: None) -> str:
    """Return the first thing that is wrong with a recording's bytes; empty if nothing is.

    Args:
        path: the recording.
        report: called with the bytes that were checked, and those of the file.

    Raises:
        RecordingError: there is no such file, or it is no recording of ours.
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
        damage: what `damage_of` found, if it was called before; else it is called here.

    Raises:
        RecordingError: there is no such file, or it is no recording of ours.
        EnvironmentNotUsable: the environment is not installed, for a rerun.
    """
    damage = damage_of(path) if damage is None else damage
    try:
        with open_recording(path) as recording:
            found = _lost(recording) or _compare(recording, rerun, report)
            damage = damage and damage + _first_unreadable(recording)
    except (RecordingError, ConfigError) as error:
        if damage and _holds_nothing_yet(path):
            return Verification(path, nothing_yet=True)
        return Verification(path, finding=_with_place(path, damage or str(error)))
    if not damage:
        return found
    if _holds_nothing_yet(path):
        return Verification(path, nothing_yet=True)
    if found.sound:
        return replace(found, finding=damage, content_digest="")
    return replace(found, notes=(*found.notes, damage))


def _holds_nothing_yet(path: Path) -> bool:
    """Return whether a recording is cut off before its first messages, and good as far as it goes."""
    try:
        with open_regular(path) as stream:
            stream.seek(-len(MCAP0_MAGIC), os.SEEK_END)
            if stream.tell() and stream.read() == MCAP0_MAGIC:
                return False  # it was closed: a damaged length may look like a cut
        contents = survey(path)
        return not contents.chunks and may_be_cut(path, contents)
    except (RecordingError, OSError):
        return False


def refuse_foreign(path: Path) -> None:
    """Refuse a file that another program's MCAP writer wrote, or that is no MCAP file.

    Raises:
        RecordingError: it is one, or it cannot be read.
    """
    try:
        with open_regular(path) as stream:
            start = stream.read(4096)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror}).") from error
    if not start:
        raise RecordingError(
            f"{path}: found an empty file, expected a recording; `dualtaxi resume` begins it."
        )
    if not start.startswith(MCAP0_MAGIC[: len(start)]):
        raise RecordingError(
            f"{path}: found {start[:8]!r} at its start, expected an MCAP file: not a dualtaxi recording."
        )
    head = start[len(MCAP0_MAGIC) :]
    if len(head) < 13 or head[0] != Opcode.HEADER:
        return
    (length,) = struct.unpack_from("<I", head, 9)
    profile = head[13 : 13 + length]
    if length < len(head) and profile != schema.PROFILE.encode():
        raise RecordingError(
            f"{path}: found an MCAP file of profile {profile.decode(errors='replace')!r}, expected "
            f"{schema.PROFILE!r}: not a dualtaxi recording."
        )


def _lost(recording: Recording) -> Verification | None:
    """Return the finding on a recording of which a repair could not save all."""
    if not recording.lost:
        return None
    holes = "; ".join(
        f"{topic}: found none of number {first} to {behind - 1}, expected {behind - first}"
        for topic, places in recording.lost.items()
        for first, behind in places
    )
    return Verification(
        recording.path, f"{recording.path}: {holes}: lost in a repair. `dualtaxi resume` does the run anew."
    )


def _compare(recording: Recording, rerun: bool, report: Report) -> Verification:
    if not recording.is_job:
        return _compare_loop(recording)
    config = from_mapping(recording.config)
    job = Job(config, recording.seed or 0)
    if recording.job != job.identity:
        return _other_job(recording, job.identity)
    mdp = load_mdp(config.env.id, config.env.kwargs, config.rewards) if rerun else recording.mdp
    complete = recording.status == "finished"
    past = Past(recording, complete, without_steps=config.recording.steps == "none")
    session = rerun_session(job, mdp, recording, past, report)
    found = Verification(
        recording.path,
        not_compared="" if rerun else NAMES_NOT_COMPARED,
        notes=() if complete else ("the run did not end; verified as far as it got",),
        provenance=_explanations(recording, mdp) if rerun else {},
    )
    try:
        _compare_names(recording, list(session.learners))
        ended = session.run()
        topics = session.recorder.drain()
        if complete or ended:
            past.check_over()
        if rerun:
            _compare_description(recording, mdp)
    except Diverged as error:
        return replace(found, finding=str(error), difference=error)
    finally:
        session.recorder.abandon()
    steps, whole = session.recorder.steps, complete or _tells_its_digest(recording)
    if not whole:  # the job was done a little further than it is recorded
        steps = {"train": recording.count(schema.TRAIN_STEP), "eval": recording.count(schema.EVAL_STEP)}
    found = replace(found, train_steps=steps["train"], eval_steps=steps["eval"])
    if not whole:
        return found
    return _compare_result(found, recording, session.summary(topics))


def _compare_names(recording: Recording, learners: list[str] | None = None) -> None:
    """Compare the names that stand in a recording more than once.

    Raises:
        Diverged: two of them differ.
    """
    described, config = recording.environment, recording.config.get("env", {})
    for key, name in (("env_id", "id"), ("kwargs", "kwargs")):
        if described.get(key) != config.get(name):
            raise Diverged("environment.json", key, described.get(key), config.get(name))
    if learners is not None and list(recording.agents) != learners:
        raise Diverged("metadata run", "agents", list(recording.agents), learners)


def _compare_description(recording: Recording, mdp: Mdp) -> None:
    """Compare how a recording describes its environment with the installed environment.

    Raises:
        Diverged: they differ; the first value that does is named by its path.
    """
    expected = json.loads(json.dumps(mdp.description()))
    for key in sorted(expected):
        where, found, value = _first_difference(key, recording.environment.get(key), expected[key])
        if where:
            raise Diverged("environment.json", where, found, value)


def _first_difference(where: str, found: Any, expected: Any) -> tuple[str, Any, Any]:
    """Return the path of the first value that differs, and both values; an empty path if none does."""
    if isinstance(found, dict) and isinstance(expected, dict) and found.keys() == expected.keys():
        parts = [(f"{where}.{key}", found[key], expected[key]) for key in sorted(expected)]
    elif isinstance(found, list) and isinstance(expected, list) and len(found) == len(expected):
        parts = [(f"{where}[{k}]", *pair) for k, pair in enumerate(zip(found, expected, strict=True))]
    else:
        return ("", None, None) if found == expected else (where, found, expected)
    differing = (_first_difference(*part) for part in parts)
    return next((difference for difference in differing if difference[0]), ("", None, None))


def _tells_its_digest(recording: Recording) -> bool:
    """Return whether an interrupted run said what it came to, and holds every step that this counts."""
    return bool(recording.result.get("content_digest") and recording.result.get("steps_recorded"))


def _compare_loop(recording: Recording) -> Verification:
    """Verify a recording of somebody's own loop, which cannot be done again here.

    Compared are the numbers of its messages, its steps with the environment's outcomes where it is
    tabular, and its digest with its messages.
    """
    finished = "content_digest" in recording.result
    notes = ["recorded from a loop, which alone can do it again: its steps were not recomputed"]
    if not finished:
        notes.append("the run did not end; verified as far as it got")
    found = Verification(
        recording.path,
        train_steps=recording.count(schema.TRAIN_STEP),
        eval_steps=recording.count(schema.EVAL_STEP),
        notes=tuple(notes),
        not_compared=LOOP_NOT_COMPARED,
    )
    try:
        _compare_names(recording)
    except Diverged as error:
        return replace(found, finding=str(error), difference=error)
    digest, odd, counts = ContentHash(), 0, {}
    for topic in recording.topics:
        wrong, others, counts[topic.name] = _check_topic(recording, topic, digest)
        odd += others
        if wrong:
            return replace(found, finding=f"{recording.path}: {wrong}")
    if odd:
        odd_note = f"{odd:,} steps are no outcome of the environment's table: it has rules beside it"
        found = replace(found, notes=(*found.notes, odd_note))
    try:
        phases = {phase: check_phase(recording, phase, finished) for phase in ("train", "eval")}
        notes = [note for phase, findings in phases.items() for note in _unusual(recording, phase, findings)]
    except Inconsistent as error:
        return replace(found, finding=f"{recording.path}: {error}")
    found = replace(found, notes=(*found.notes, *notes))
    if not finished:
        return found
    steps, last = found.train_steps + found.eval_steps, max(each.last_time for each in phases.values())
    if last != steps * schema.STEP_NANOSECONDS:
        taken = last // schema.STEP_NANOSECONDS
        return replace(
            found,
            finding=f"{recording.path}: found {steps:,} steps, expected {taken:,} by the time of the last",
        )
    expected = _loop_result(digest, counts)
    if recording.result.rewards_off_table is not None:
        expected["rewards_off_table"] = sum(findings.unpaid for findings in phases.values())
    return _compare_result(found, recording, expected)


def _unusual(recording: Recording, phase: str, findings: Findings) -> Iterator[str]:
    """Yield what is unusual in a phase of a loop, though its environment may have done it.

    Raises:
        Inconsistent: its environment cannot have done it.
    """
    if findings.unpaid:
        where = f"/{phase}/step, step {findings.first_unpaid}: rewards"
        if recording.result.rewards_off_table == 0:
            raise Inconsistent(f"{where}: found one that the environment's table excludes for this step")
        yield f"{where}: {findings.unpaid:,} steps have rewards that are not in the environment's table"
    if findings.begun_without:
        where = f"/{phase}/step, step {findings.first_without}"
        if findings.begun_by_reset >= findings.begun_without:
            raise Inconsistent(f"{where}: found an episode without a reset before it, as others have")
        yield f"{where}: {findings.begun_without:,} episodes began without a reset"


def _loop_result(digest: ContentHash, counts: dict[str, int]) -> dict[str, Any]:
    """Return what the result of a loop says, by its messages."""
    return {
        "topic_digests": digest.topics(),
        "messages": {name: count for name, count in counts.items() if count},
        "train_steps": counts["/train/step"],
        "eval_steps": counts["/eval/step"],
        "episodes": counts["/train/episode"],
        "content_digest": digest.content(),
    }


def _check_topic(recording: Recording, topic: schema.Topic, digest: ContentHash) -> tuple[str, int, int]:
    """Return what is wrong with a topic, its steps that the table lacks, and the number of its messages.

    The messages are taken into the digest.
    """
    if topic not in recording.dtypes:
        count = 0
        for time, payload in recording.messages(topic):
            if topic.digested:
                digest.update(topic, message_record(topic, time, payload))
            count += 1
        return "", 0, count
    number, expected, odd = schema.NUMBERED_BY[topic.message], 0, 0
    for block in recording.blocks(topic):
        digest.update(topic, np.ascontiguousarray(block).view(np.uint8).data)
        if (wrong := np.flatnonzero(block[number] != expected + np.arange(len(block)))).size:
            found = block[number][wrong[0]]
            return f"{topic.name}: found {number} {found}, expected {expected + wrong[0]}", odd, expected
        if topic.message is schema.STEP:
            odd += _impossible(recording, block)
        expected += len(block)
    return "", odd, expected


def _impossible(recording: Recording, steps: NDArray[np.void]) -> int:
    """Return how many steps are not among the outcomes of a tabular environment, if it is one."""
    if not recording.environment["arrays"]:
        return 0
    outcomes = recording.mdp.outcomes_to(steps["state"], steps["action"], steps["next_state"])
    return int(np.count_nonzero(~outcomes.any(axis=1)))


def _compare_result(found: Verification, recording: Recording, summary: dict[str, Any]) -> Verification:
    """Return the finding on what the recording says of itself at its end."""
    for key, expected in summary.items():
        if recording.result.get(key) != expected:
            difference = Diverged("metadata result", key, recording.result.get(key), expected)
            return replace(found, finding=str(difference), difference=difference)
    return replace(found, content_digest=summary["content_digest"])


def _other_job(recording: Recording, expected: str) -> Verification:
    error = Diverged("metadata run", "job", recording.job, expected)
    return Verification(recording.path, str(error), error)


def rerun_session(
    job: Job, mdp: Mdp, recording: Recording, past: Past, report: Report = lambda _: None
) -> Session:
    """Return a session that does a recorded job again, in memory, against its past."""
    learner = Learner(job.config, mdp, job.seed, initial_tables(recording))
    recorder = recorder_for(job, learner, None, past)
    caught_up = _catching_up(recording, past, recorder.counts)
    return Session(job, learner, recorder, report, stop=lambda: not past.complete and caught_up())


def _catching_up(recording: Recording, past: Past, counts: dict[str, int]) -> Callable[[], bool]:
    """Return what says whether everything recorded was compared; `counts` are the messages so far."""
    variable = set(schema.TOPICS) - set(schema.BLOCK_TOPICS) - {schema.LOG_TOPIC}
    recorded = {topic.name: recording.count(topic) for topic in variable}
    return lambda: past.exhausted and all(counts[name] >= count for name, count in recorded.items())


def initial_tables(recording: Recording) -> list[Held] | None:
    """Return what a run took over from another one, from its own first snapshots.

    None if it took over nothing, or was cut off before them: its configuration says what it begins with.
    """
    if not isinstance(from_mapping(recording.config).initial_q, RunTable):
        return None
    return initially_held(recording)


def differing_provenance(recording: Recording) -> dict[str, tuple[str, str]]:
    """Return where the recording was made by something else than this process: key to (recording, here)."""
    here = provenance()
    return {
        key: (recording.provenance.get(key, ""), here.get(key, ""))
        for key in sorted({*recording.provenance, *here})
        if recording.provenance.get(key) != here.get(key)
    }


def differing_environment(recording: Recording, mdp: Mdp) -> dict[str, tuple[str, str]]:
    """Return which arrays of an environment are not the recorded ones, in the same form."""
    then, now = recording.mdp.arrays(), mdp.arrays()
    return {
        f"environment.{name}": ("as recorded", "another")
        for name in sorted({*then, *now})
        if name not in then or name not in now or not np.array_equal(then[name], now[name])
    }


def _explanations(recording: Recording, mdp: Mdp) -> dict[str, tuple[str, str]]:
    """Return what may explain that a rerun differs."""
    differing = differing_provenance(recording) | differing_environment(recording, mdp)
    return {key: values for key, values in differing.items() if key not in CIRCUMSTANCES}


def _with_place(path: Path, damage: str) -> str:
    """Return what is damaged, with the first message that cannot be read for it, if that can be told."""
    try:
        with open_recording(path) as recording:
            return damage + _first_unreadable(recording)
    except RecordingError:
        return damage


def _first_unreadable(recording: Recording) -> str:
    """Return in words which message is the first that cannot be read; empty if all can."""
    for topic in recording.dtypes:
        name = schema.NUMBERED_BY[topic.message]
        number = 0
        try:
            for block in recording.blocks(topic):
                number = int(block[name][-1]) + 1
        except RecordingError:
            return f" {topic.name}: {name} {number} is the first that cannot be read."
    return ""
