"""Going on with a run that was interrupted, so that it ends as if it never had been.

The job is done again from its beginning, without recording: what the recording holds already is compared
with what comes, byte for byte, and from its end on everything is recorded. Learning is so much faster
than recording that this costs a fraction of what it saves, and it proves what it continues.

A recording with a hole, or with damage that good chunks stand behind, is left alone: the run is recorded
anew beside it, in `recording.anew`, which takes its place when it is complete. That is resumed as well.
"""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from runner.config import from_mapping
from runner.config.job import Job
from runner.config.sections import RunTable
from runner.environments.loading import load_mdp
from runner.environments.mdp import Mdp
from runner.errors import ConfigError, Diverged, RecordingError, RunnerError, kept_message
from runner.execution.initial_tables import configured_tables, settle
from runner.execution.session import (
    Report,
    Session,
    Stop,
    describe,
    evaluation_brief,
    execute,
    recorder_for,
)
from runner.execution.verify import differing_environment, differing_provenance, initial_tables
from runner.learning.learner import Held, Learner
from runner.recording import schema
from runner.recording.integrity import may_be_cut, survey
from runner.recording.liveness import owner
from runner.recording.metadata import NEEDED
from runner.recording.reader import Recording, open_recording
from runner.recording.records import Contents
from runner.recording.reference import Past
from runner.recording.writer import RecordingFile, storage_error
from runner.runs.locking import locked
from runner.runs.provenance import provenance
from runner.runs.run import RECORDING_FILE, Run, run_at
from runner.util.files import storage_errors

DECISIVE: Final = (
    *("dualtaxi", "git", "python", "machine"),
    *("package.numpy", "package.numba", "package.llvmlite"),
)
"""Provenance that a continued run must share with its beginning, unless told otherwise."""
_ANEW: Final = ".anew"

Changes = dict[str, tuple[str, str]]


def is_finished(run: Run) -> bool:
    """Return whether a run came to its end and its recording is whole, as far as it says itself."""
    try:
        with open_recording(run.recording) as recording:
            return recording.finished and recording.status == "finished"
    except RecordingError:
        return False


def resume(
    run: Run, accept_changes: bool = False, report: Report = lambda _: None, stop: Stop = lambda: False
) -> Run:
    """Go on with a run to its end; return it as it then is. A finished one is returned as it is.

    Args:
        run: an interrupted or failed run.
        accept_changes: go on although the code, the environment's package or a numerical library is
            another than at the beginning; recorded. The recorded steps are compared all the same.
        report: called with the progress a few times a second.
        stop: asked every few milliseconds whether to stop.

    Raises:
        RunnerError: the run is running; something decisive differs; or its folder cannot be used.
        Diverged: what is recorded is not what the job gives.
    """
    if run.stands_alone:
        raise RunnerError(
            f"{run.recording}: found a recording that stands alone, expected a run. To go on with it, put it "
            f"into a folder of its own as {RECORDING_FILE}."
        )
    with locked(run) as current:
        if is_finished(current):
            return _settled(current)
        return _go_on(current, accept_changes, report, stop)


def require_same_makers(run: Run) -> None:
    """Refuse a run that would be gone on with by other code or libraries than began it.

    Raises:
        RunnerError: what differs.
    """
    changes = _changes(run)
    if changes:
        raise RunnerError(_refusal(run, changes))


def _settled(run: Run) -> Run:
    """Return a run whose recording is finished; if its owner died before saying so, say it."""
    if run.status == "finished":
        return run
    with open_recording(run.recording) as recording:
        facts = recording.run_facts()
        return run.update(status="finished", summary=facts["summary"] | {"bytes": recording.size})


def _go_on(run: Run, accept_changes: bool, report: Report, stop: Stop) -> Run:
    started = time.monotonic()
    job, described = _job(run)
    if not described:
        job, run = settle(job, run)
    path, contents = _place(run, described)
    changes = _changes(run)
    mdp = load_mdp(job.config.env.id, job.config.env.kwargs, job.config.rewards)
    changes |= _environment_changes(run, mdp)
    if changes and not accept_changes:
        raise RunnerError(_refusal(run, changes))
    learner = Learner(job.config, mdp, job.seed, _first_tables(job, run, mdp))
    proof = _proof(run)
    run = run.update(status="running", owner=owner(), summary={}, proof=proof)
    try:
        with (
            _opened(path, contents, job, run, learner, changes) as file,
            open_recording(path) as recording,
        ):
            past = Past(recording, without_steps=job.config.recording.steps == "none")
            recorder = recorder_for(job, learner, file, past, beat=run.beat)
            session = _Continued(recording, past, job, learner, recorder, report, stop)
            done = execute(session, file, run, started)
    except BaseException as error:
        _mark_failed(run, error)
        raise
    return _put_in_place(done, path) if done.status == "finished" else done


def _mark_failed(run: Run, error: BaseException) -> None:
    """Say that a run failed, if `execute`, which says so itself, was not come to."""
    with contextlib.suppress(RunnerError):
        now = run_at(run.folder)
        if now.file.status == "running":
            now.update(status="failed", summary={"error": kept_message(error)})


def _place(run: Run, described: bool) -> tuple[Path, Contents]:
    """Return the file to go on with, and what of it is good: the recording, or one made anew beside it.

    Args:
        run: whose.
        described: whether the recording says of which job it is.
    """
    anew = run.recording.with_suffix(_ANEW)
    if not run.recording.is_file():
        return run.recording, Contents()
    contents = survey(run.recording)
    if may_be_cut(run.recording, contents) and (described or not contents.chunks):
        return run.recording, contents
    contents = survey(anew) if anew.is_file() else Contents()
    return anew, contents if may_be_cut(anew, contents) else Contents()


def _job(run: Run) -> tuple[Job, bool]:
    """Return the job that a run does, and whether its recording says so; else `run.json` does.

    Raises:
        Diverged: the recording says that it is of another job than it describes.
    """
    told = Job(from_mapping(run.file.config), run.seed)
    try:
        with open_recording(run.recording) as recording:
            recorded = Job(from_mapping(recording.config), recording.seed or 0)
            claimed = recording.job
    except (RecordingError, ConfigError, KeyError, ValueError):
        return told, False
    if claimed in (recorded.identity, told.identity):
        return (recorded, True) if claimed == recorded.identity else (told, False)
    raise Diverged("metadata run", "job", claimed, recorded.identity)


def _proof(run: Run) -> str | None:
    """Return the content digest that the run had when it was finished, if it ever was."""
    if run.status == "finished":
        return run.summary.content_digest
    proof = run.file.proof
    return str(proof) if proof else None


def _first_tables(job: Job, run: Run, mdp: Mdp) -> list[Held] | None:
    """Return the tables that the run began with if it took them over from another; None if it did not."""
    if not isinstance(job.config.initial_q, RunTable):
        return None
    with contextlib.suppress(RecordingError), open_recording(run.recording) as recording:
        if (tables := initial_tables(recording)) is not None:
            return tables
    return configured_tables(job, run, mdp)


@contextlib.contextmanager
def _opened(
    path: Path, contents: Contents, job: Job, run: Run, learner: Learner, changes: Changes
) -> Iterator[RecordingFile]:
    """Give the file to go on with: cut behind what is good of it, or begun anew where that says nothing."""
    described = bool(contents.chunks) and {entry.name for entry in contents.metadata} >= NEEDED
    with storage_errors(path):
        if not described:
            path.unlink(missing_ok=True)
        file = RecordingFile.reopen(path, contents) if described else RecordingFile(path)
    with file:
        if not described:
            describe(file, job, run, learner)
        if described or changes:
            number = 1 + sum(entry.name.startswith("resume/") for entry in contents.metadata)
            _add(file, f"resume/{number}", _note(changes))
        yield file


def _add(file: RecordingFile, name: str, entries: dict[str, str]) -> None:
    try:
        file.add_metadata(name, entries)
    except OSError as error:
        file.cut_back()
        raise storage_error(file, error) from error


def _put_in_place(run: Run, path: Path) -> Run:
    """Prove a finished recording by the digest it once had; let one made anew take the old one's place.

    Raises:
        Diverged: it is another; the damaged recording stays.
    """
    found, expected = run.summary["content_digest"], run.file.proof
    if expected and found != expected:
        run.update(status="interrupted")
        raise Diverged("the recording made anew", "content digest", found, expected)
    if path != run.recording:
        path.replace(run.recording)
    return run.update(proof=None)


class _Continued(Session):
    """A session that, if it is stopped before the end of what is recorded, tells of all that is recorded."""

    def __init__(self, recording: Recording, past: Past, *session: Any) -> None:
        super().__init__(*session)
        self._recording = recording
        self._past = past

    def summary(self, topics: dict[str, str]) -> dict[str, Any]:
        """Return what is worth knowing of the run without opening its recording."""
        own = super().summary(topics)
        return own if self._past.exhausted else own | _recorded(self._recording)


def _recorded(recording: Recording) -> dict[str, Any]:
    """Return how far a recording goes, as a summary says it; its digest is not known."""
    counts = {topic.name: recording.count(topic) for topic in schema.TOPICS}
    evaluations = recording.metrics("eval")
    return {
        "content_digest": None,
        "topic_digests": {},
        "episodes": counts[schema.TRAIN_EPISODE.name],
        "train_steps": _steps(recording, "train"),
        "eval_steps": _steps(recording, "eval"),
        "messages": {name: count for name, count in counts.items() if count},
        "last_evaluation": evaluation_brief(evaluations[-1]) if evaluations else None,
    }


def _steps(recording: Recording, phase: str) -> int:
    """Return how many steps of a phase are recorded, or were taken in the episodes that are."""
    steps, episodes = schema.PHASES[phase]
    ended = recording.count(episodes)
    if ended == 0:
        return recording.count(steps)
    last = recording.episodes(phase, ended - 1, ended)[-1]
    return max(recording.count(steps), int(last["last_step"]) + 1)


def _changes(run: Run) -> Changes:
    """Return what is decisive and differs from the recording's beginning: key to (then, now)."""
    with contextlib.suppress(RecordingError), open_recording(run.recording) as recording:
        found = differing_provenance(recording)
        return {key: values for key, values in found.items() if key in DECISIVE}
    return {}


def _environment_changes(run: Run, mdp: Mdp) -> Changes:
    with contextlib.suppress(RecordingError), open_recording(run.recording) as recording:
        return differing_environment(recording, mdp)
    return {}


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
