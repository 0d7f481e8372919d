"""Resume an interrupted run, so that it ends as if it had never been interrupted.

The job is run again from its beginning: what the recording has already is compared byte for byte, and
everything after its end is recorded. Learning is much faster than recording: this costs a fraction of
what it saves, and it proves what it continues.

A recording with a hole, or with damage before undamaged chunks, is left alone: the run is recorded again in
`recording.resuming`, which replaces it when it is complete. That is resumed as well.
"""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from runner.config import from_mapping
from runner.config.model import Job
from runner.config.sections import RunTable
from runner.environments.loading import load_mdp
from runner.environments.mdp import Mdp
from runner.errors import ConfigError, Diverged, RecordingError, RunnerError, truncated_message
from runner.execution.session import (
    Report,
    Session,
    configured_tables,
    describe,
    evaluation_brief,
    execute,
    recorded_tables,
    recorder_for,
    resolve_job,
)
from runner.execution.verify import differing_environment
from runner.learning.learner import Learner, NamedTables
from runner.recording import schema
from runner.recording.code import CODE_RECORD
from runner.recording.description import recorded_facts
from runner.recording.index import Index
from runner.recording.integrity import may_be_cut, survey
from runner.recording.metadata import REQUIRED_RECORDS
from runner.recording.reader import Recording, open_recording
from runner.recording.reference import Reference
from runner.recording.run_file import owner
from runner.recording.writer import RecordingFile, writing
from runner.replay.trust import require_may_train
from runner.runs.code import CodeCollector
from runner.runs.provenance import Differences, differing_provenance, provenance
from runner.runs.run import RECORDING_FILE, Run, locked, run_at
from runner.util.files import storage_errors
from runner.util.processes import Stop
from runner.util.values import Json

DECISIVE: Final = (
    "dualtaxi",
    "python",
    "machine",
    "package.numpy",
    "package.numba",
    "package.llvmlite",
)
"""Provenance that must be the same at the beginning of a run and when it is resumed."""
_REPLACEMENT: Final = ".resuming"
"""The suffix of a recording that replaces a damaged one."""


def is_finished(run: Run) -> bool:
    """Return whether a run's recording says that it is finished."""
    try:
        with open_recording(run.recording) as recording:
            return recording.file.finished and recording.status == "finished"
    except RecordingError:
        return False


def resume(
    run: Run,
    accept_changes: bool = False,
    report: Report = lambda _: None,
    stop: Stop = lambda: False,
    trust: bool = False,
) -> Run:
    """Resume a run; return it, finished or interrupted. A finished run is returned as it is.

    Args:
        run: an interrupted or failed run.
        accept_changes: resume although the code, the environment's package or a numerical library changed;
            this is recorded. The recorded steps are compared all the same.
        report: called with the progress a few times a second.
        stop: called every few milliseconds; return True to stop.
        trust: whether an environment may be made that `runner.replay.trust` refuses.

    Raises:
        CannotRedo: the environment may not be made.
        RunnerError: the run is running; something decisive differs; or its folder cannot be used.
        Diverged: what is recorded is not what the job gives.
    """
    if run.stands_alone:
        raise RunnerError(
            f"{run.recording}: found a recording that stands alone, expected a run. To resume it, put it "
            f"into a folder of its own as {RECORDING_FILE}."
        )
    with locked(run) as current:
        if is_finished(current):
            if current.status == "finished":
                return current
            with open_recording(current.recording) as recording:  # its process was killed before it said so
                summary = recorded_facts(recording)["summary"] | {"bytes": recording.file.size}
            return current.update(status="finished", summary=summary)
        return _resume(current, accept_changes, report, stop, trust)


def require_same_makers(run: Run) -> None:
    """Refuse to resume a run with other code or libraries than it was started with."""
    _refuse_changes(run, _changes(run))


def _resume(run: Run, accept_changes: bool, report: Report, stop: Stop, trust: bool) -> Run:
    started = time.monotonic()
    job, described = _job(run)
    require_may_train(run.recording, job.config.to_mapping(), trust)
    if not described:
        job, run = resolve_job(job, run)
    path, contents = _place(run, described)
    changes = _changes(run)
    mdp = load_mdp(job.config.env.id, job.config.env.kwargs, job.config.rewards)
    with contextlib.suppress(RecordingError), open_recording(run.recording) as recording:
        changes |= differing_environment(recording, mdp)
    if not accept_changes:
        _refuse_changes(run, changes)
    learner = Learner(job.config, mdp, job.seed, _first_tables(job, run, mdp))
    # the content digest that the run had when it was finished, if it ever was
    proof = run.summary.content_digest if run.status == "finished" else run.file.proof
    run = run.update(status="running", owner=owner(), summary={}, proof=str(proof) if proof else None)
    try:
        with _opened(path, contents, job, run, learner, changes) as file, open_recording(path) as recording:
            reference = Reference(recording)
            is_recorded = CODE_RECORD in contents.metadata
            code = CodeCollector(run.folder.parent, job.config.recording.code and not is_recorded)
            recorder = recorder_for(job, learner, file, reference, beat=code.beat(run, file))
            session = _ResumedSession(recording, reference, job, learner, recorder, report, stop)
            done = execute(session, file, run, started, code)
    except BaseException as error:
        with contextlib.suppress(RunnerError):
            now = run_at(run.folder)
            if now.file.status == "running":  # it never reached `execute`, which records failures itself
                now.update(status="failed", summary={"error": truncated_message(error)})
        raise
    return _complete(done, path) if done.status == "finished" else done


def _place(run: Run, described: bool) -> tuple[Path, Index]:
    """Return the file to continue, and its undamaged contents: the recording, or its replacement.

    Args:
        described: whether the recording has the job's description.
    """
    if not run.recording.is_file():
        return run.recording, Index()
    contents = survey(run.recording)
    if may_be_cut(run.recording, contents) and (described or not contents.chunks):
        return run.recording, contents
    replacement = run.recording.with_suffix(_REPLACEMENT)
    contents = survey(replacement) if replacement.is_file() else Index()
    return replacement, contents if may_be_cut(replacement, contents) else Index()


def _job(run: Run) -> tuple[Job, bool]:
    """Return the job of a run, and whether it comes from the recording; else it comes from `run.json`.

    Raises:
        Diverged: the recording has the identity of another job than it describes.
    """
    stated = Job(from_mapping(run.file.config), run.seed)
    try:
        with open_recording(run.recording) as recording:
            recorded = Job(from_mapping(recording.config), recording.seed or 0)
            claimed = recording.run["job"]
    except (RecordingError, ConfigError, KeyError, ValueError):
        return stated, False
    if claimed == recorded.identity:
        return recorded, True
    if claimed == stated.identity:
        return stated, False
    raise Diverged("metadata run", "job", claimed, recorded.identity)


def _first_tables(job: Job, run: Run, mdp: Mdp) -> list[NamedTables] | None:
    """Return the tables that the run took from another run; None if it took none."""
    if not isinstance(job.config.initial_q, RunTable):
        return None
    with contextlib.suppress(RecordingError), open_recording(run.recording) as recording:
        if (tables := recorded_tables(recording)) is not None:
            return tables
    return configured_tables(job.config, mdp, run.folder.parent, run.run_id)


@contextlib.contextmanager
def _opened(
    path: Path, contents: Index, job: Job, run: Run, learner: Learner, changes: Differences
) -> Iterator[RecordingFile]:
    """Open the file to continue: cut after its undamaged contents, or new if it has no description."""
    described = bool(contents.chunks) and contents.metadata.keys() >= REQUIRED_RECORDS
    with storage_errors(path):
        if not described:
            path.unlink(missing_ok=True)
        file = RecordingFile(path, contents=contents if described else None)
    with file:
        if not described:
            describe(file, job, run, learner)
        if described or changes:
            number = 1 + sum(name.startswith("resume/") for name in contents.metadata)
            accepted = {key: f"{then} -> {now}" for key, (then, now) in changes.items()}
            note = {**provenance(), "accepted_changes": json.dumps(accepted, sort_keys=True)}
            with writing(file):
                file.add_metadata(f"resume/{number}", note)
        yield file


def _complete(run: Run, path: Path) -> Run:
    """Compare a finished recording's digest with the one it once had; move a replacement into place.

    Raises:
        Diverged: the digests differ; the damaged recording stays.
    """
    found, expected = run.summary["content_digest"], run.file.proof
    if expected and found != expected:
        run.update(status="interrupted")
        raise Diverged("the new recording", "content digest", found, expected)
    if path != run.recording:
        path.replace(run.recording)
    return run.update(proof=None)


class _ResumedSession(Session):
    """A session that covers all that is recorded, also before it has retrained to the end of that."""

    def __init__(self, recording: Recording, reference: Reference, *session: Any) -> None:
        super().__init__(*session)
        self._recording = recording
        self._reference = reference
        steps = (_steps(recording, phase) for phase in schema.PHASES)
        self._recorded = (recording.train.episodes.count(), *steps)

    def done(self) -> tuple[int, ...]:
        """Return how much of the run is done: at least what is recorded, also while it is retrained."""
        return tuple(map(max, super().done(), self._recorded))

    def summary(self, topics: dict[str, str]) -> Json:
        """Return the summary of the run."""
        summary = super().summary(topics)
        recording = self._recording
        if self._reference.exhausted:
            return summary
        counts = {topic.name: recording.table(topic).count() for topic in schema.JOB_TOPICS}
        evaluations = recording.eval.all_metrics()
        return summary | {
            "content_digest": None,
            "topic_digests": {},
            "episodes": self._recorded[0],
            "train_steps": self._recorded[1],
            "eval_steps": self._recorded[2],
            "messages": {name: count for name, count in counts.items() if count},
            "last_evaluation": evaluation_brief(evaluations[-1]) if evaluations else None,
        }


def _steps(recording: Recording, phase: str) -> int:
    """Return the number of steps of a phase, also if the recording leaves them out."""
    records = recording.phase(phase)
    ended = records.episodes.count()
    if ended == 0:
        return records.steps.count()
    return max(records.steps.count(), int(records.episodes.array(ended - 1)[-1]["last_step"]) + 1)


def _changes(run: Run) -> Differences:
    """Return the decisive differences from the provenance at the beginning of the recording."""
    with contextlib.suppress(RecordingError), open_recording(run.recording) as recording:
        differences = differing_provenance(recording.provenance)
        return {key: values for key, values in differences.items() if key in DECISIVE}
    return {}


def _refuse_changes(run: Run, changes: Differences) -> None:
    if not changes:
        return
    lines = [
        f"  {key}: {then or 'unknown'} then, {now or 'unknown'} now" for key, (then, now) in changes.items()
    ]
    raise RunnerError(
        "\n".join(
            [
                f"run {run.run_id} was started with something else than what would resume it:",
                *lines,
                "Bring back what it was started with, or resume it all the same with --accept-changes: every "
                "recorded step is compared either way.",
            ]
        )
    )
