"""Verify a recording: its bytes, and what its job or its environment gives when it is made again.

A job determines its content, so the strongest check is also the simplest: run the job again, in memory, and
compare. With the environment data in the recording this checks the recording against itself (each step among
the outcomes, each draw as the seed gives it, each metric, episode and table as the steps make them); with the
installed environment, whether the run can be reproduced here and now.

Of a loop, the tables are compared with one another, and its environment takes the recorded actions: this
shows that the recorded returns were really obtained, whatever chose the actions.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import platform
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from runner.config import from_mapping
from runner.config.model import Job
from runner.environments.loading import load_mdp
from runner.environments.mdp import Mdp
from runner.errors import (
    CannotRedo,
    ConfigError,
    CutOff,
    Diverged,
    EnvironmentNotUsable,
    NotInRecording,
    OtherVersion,
    RecordingError,
    RunnerError,
)
from runner.recording import schema
from runner.recording.consistency import Findings, Inconsistent, check_extras, check_phase
from runner.recording.digest import combined_digest
from runner.recording.environment import Composition, composition_of
from runner.recording.integrity import check_integrity, refuse_foreign, survey
from runner.recording.maker import EnvironmentMaker
from runner.recording.reader import Recording, open_recording
from runner.recording.records import Report as BytesReport
from runner.recording.reference import Reference
from runner.recording.rewriting import content_hash
from runner.recording.run_file import has_environment
from runner.replay.makers import stream_from_child, why_not_rerun, why_uncertain
from runner.replay.trust import require_may_train
from runner.runs.checkpoints import read_checkpoints
from runner.runs.provenance import Differences, differing_provenance
from runner.runs.run import run_at
from runner.util.humanize import counted
from runner.util.processes import Report as StepsReport
from runner.util.processes import report_progress
from runner.util.values import Json

if TYPE_CHECKING:  # they load Numba and Gymnasium, of which a verification needs one at most
    from runner.execution.session import Report
    from runner.replay.engine import Difference

_LOOP_NOT_COMPARED: Final = (
    "how its environment is described: scene, names of actions, agents, events and landmarks, step limit"
)
_NAMES_NOT_COMPARED: Final = f"{_LOOP_NOT_COMPARED}; --rerun compares them with the installed environment"
"""What a verification leaves out: the messages do not depend on it."""
_CIRCUMSTANCES: Final = ("command", "directory", "host", "user")  # they cannot explain a difference

Verdict = Literal["reproduced", "consistent", "interrupted", "differs", "damaged"]
"""The verdict on a recording:

- `reproduced`: its job was retrained, or its environment rerun, and everything compared is equal;
- `consistent`: only the file was checked, and agrees with itself; `Verification.reason` is why;
- `interrupted`: the run did not end, and all up to its end is reproduced, or consistent;
- `differs`: the job or the environment gives something else, each time the same;
- `damaged`: the bytes of the file are wrong, or its parts contradict each other.
"""

OUTSIDE: Final = (
    "The environment gives other results each time for the same seed and actions: it depends on more than "
    "its seed, such as the global random generators, the clock, the order of a set, or threads."
)
_HASH_SEEDS: Final = (1, 2, 3, 4)
"""A difference is looked for again with each: two texts in a set may have the same order with one."""
_AHEAD_SECONDS: Final = 3_244_643
"""37 days and some hours, minutes and seconds: an odd number of each."""


@dataclass(frozen=True)
class Verification:
    """The result of a verification."""

    path: Path
    verdict: Verdict = "consistent"
    act: Literal["checked", "retrained", "rerun"] = "checked"
    """What was done: only the file was checked, a job was retrained, or a loop's environment was rerun."""
    environment: Literal["", "recorded", "installed"] = ""
    """The environment with which it was retrained or rerun."""
    composition: Composition | None = None
    """What the environment consists of; None if there is none, or nothing can be read."""
    reason: str = ""
    """Why the environment cannot be rerun, as a sentence; empty if it was, or was not to be."""
    finding: str = ""
    """The first thing that differs or is damaged; empty if nothing is."""
    difference: Diverged | Difference | None = None
    """The first difference with attributes; that of a loop which cannot be rerun shows why."""
    train_steps: int = 0
    """Training steps that were compared, with one another or with the retrained ones."""
    eval_steps: int = 0
    """Evaluation steps that were compared."""
    episodes: int = 0
    """Episodes that were retrained, or rerun; of a job, training episodes."""
    unfinished: int = 0
    """Rerun episodes that were in progress when the recording ended."""
    steps: int = 0
    """Steps that were retrained or rerun; of a loop, all before the first difference were equal."""
    left_out: int = 0
    """Steps that could not be rerun: the random generators' state at their beginning was not recorded."""
    cut_off: int = 0
    """Steps at the end that could not be rerun: their resets were lost when the loop was killed."""
    of_episodes: int | None = None
    """The number of episodes that a rerun sample is of; None if all were to be rerun."""
    tolerance: float = 0.0
    """Absolute and relative, for floating-point values that were rerun; 0 if bytes were compared."""
    assumed: tuple[str, ...] = ()
    """What was rerun with default arguments, as its own were not recorded."""
    content_digest: str = ""
    """The digest of all that was compared; empty if the recording has none, or is not complete."""
    notes: tuple[str, ...] = ()
    """What a reader should know though it is not wrong."""
    changes: Differences = field(default_factory=dict)
    """What is not as recorded here and may explain a difference: packages, platform, code, environment."""
    not_compared: str = ""
    """What of the recording was not compared."""
    can_be_rerun: bool = False
    """Whether its steps are compared by a rerun of its environment, as those of a loop are."""
    if_rerun: Verification | None = None
    """What holds instead if a rerun gives the recorded steps, though their order is unlikely."""

    @property
    def sound(self) -> bool:
        """Whether nothing differs, and nothing is damaged."""
        return self.verdict not in ("differs", "damaged")


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
    verification = check(path, damage_of(path), bool(rerun), report, trust)
    if rerun is False or not verification.can_be_rerun:
        return verification
    return rerun_loop(verification, sample, tolerance, trust)


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
            verification = _check_content(recording, installed, report, trust)
            verification = replace(verification, composition=composition_of(recording))
            unreadable = "" if damage is None or is_cut else _first_unreadable(recording)
    except (RecordingError, ConfigError) as error:
        if is_cut and not survey(path).chunks:
            return Verification(path, verdict="interrupted")
        finding = str(damage or error)
        with contextlib.suppress(RecordingError), open_recording(path) as recording:
            finding += _first_unreadable(recording)
        return Verification(path, verdict="damaged", finding=finding)
    if damage is None:
        return verification
    if is_cut and verification.sound:
        note = str(damage).removeprefix(f"{path}: ")
        return replace(
            verification, verdict="interrupted", content_digest="", notes=(*verification.notes, note)
        )
    if verification.sound:
        return replace(verification, verdict="damaged", finding=f"{damage}{unreadable}", content_digest="")
    verdict = verification.verdict if is_cut else "damaged"
    return replace(verification, verdict=verdict, notes=(*verification.notes, str(damage)), if_rerun=None)


def _states_its_end(path: Path) -> bool:
    """Return whether the run of a recording was closed, as `run.json` states: then its file was whole."""
    with contextlib.suppress(RunnerError):
        run = run_at(path).file
        return run.status != "running" and run.summary.content_digest is not None
    return False


def _first_unreadable(recording: Recording) -> str:
    """Return a sentence that names the first message that cannot be read; empty if all can."""
    for topic in filter(recording.topics.__contains__, schema.ROW_TOPICS):
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
        again = " `dualtaxi resume` retrains the job." if recording.can_train_again else ""
        finding = f"{recording.path}: {holes}: lost in a repair.{again}"
        return replace(verification, verdict="damaged", finding=finding)
    if unfolded := recording.result.unfolded:
        processes = [f"{name or 'the process that began it'}: {what}" for name, what in unfolded.items()]
        finding = f"{recording.path}: lacks what processes recorded: {' '.join(processes)}"
        return replace(verification, verdict="damaged", finding=finding)
    if not recording.can_train_again:
        return _check_loop(recording)
    job = Job(from_mapping(recording.config), recording.seed or 0)
    if recording.run["job"] != job.identity:
        return _with_difference(
            verification, Diverged("metadata run", "job", recording.run["job"], job.identity)
        )
    return _retrain(recording, job, installed, report, trust)


# --- a job, retrained -------------------------------------------------------------------------------


def _retrain(recording: Recording, job: Job, installed: bool, report: Report, trust: bool) -> Verification:
    # They load Numba.
    from runner.execution.session import Session, recorded_tables, recorder_for
    from runner.learning.learner import Learner

    env = job.config.env
    complete = recording.status == "finished"
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
        _compare_names(recording, list(learner.agents))
    except Diverged as error:
        return _with_difference(verification, error)
    reference = Reference(recording, complete)
    recorder = recorder_for(job, learner, None, reference)
    variable = set(schema.JOB_TOPICS) - set(schema.BLOCK_TOPICS) - {schema.LOG_TOPIC}
    recorded = {topic.name: recording.table(topic).count() for topic in variable}

    def all_compared() -> bool:
        return reference.exhausted and all(recorder.counts[name] >= n for name, n in recorded.items())

    session = Session(job, learner, recorder, report, stop=lambda: not complete and all_compared())
    if installed:  # what may explain a difference
        changes = differing_provenance(recording.provenance) | differing_environment(recording, mdp)
        changes = {key: values for key, values in changes.items() if key not in _CIRCUMSTANCES}
        verification = replace(verification, changes=changes)
    else:
        verification = replace(verification, not_compared=_NAMES_NOT_COMPARED)
    try:
        ended, digests = session.finish()
        if complete or ended:
            reference.check_exhausted()
        if installed:
            description = json.loads(json.dumps(mdp.description()))
            for key in sorted(description):
                _compare_values(key, recording.environment.get(key), description[key])
    except Diverged as error:
        return _with_difference(verification, error, "differs")
    result = recording.result
    # An interrupted run that stated its result is compared with it if all steps of the result are recorded.
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
    return _compare_result(verification, recording, session.summary(digests)) if whole else verification


def differing_environment(recording: Recording, mdp: Mdp) -> Differences:
    """Return which arrays of an environment differ from the recorded ones."""
    then = recording.mdp.arrays()
    now = mdp.arrays()
    return {
        f"environment.{name}": ("as recorded", "another")
        for name in sorted({*then, *now})
        if name not in then or name not in now or not np.array_equal(then[name], now[name])
    }


# --- a loop's file ----------------------------------------------------------------------------------


def _check_loop(recording: Recording) -> Verification:
    """Check the file of a user's own loop; `rerun_loop` reruns its environment.

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
        not_compared=_LOOP_NOT_COMPARED if has_environment(recording.config) else "",
        can_be_rerun=True,
    )
    try:
        _compare_names(recording)
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
        verification = replace(verification, verdict="damaged", finding=f"{recording.path}: {error}")
    except Diverged as error:
        verification = _with_difference(verification, error)
    verification = replace(verification, notes=tuple(notes))
    if not verification.sound:
        return verification
    off_table = sum(findings.rewards_off_table for findings in phases.values())
    compared = _compare_totals(recording, verification, off_table, finished)
    if compared.sound and (unlikely := _unlikely(recording, phases)):
        finding = f"{recording.path}: {unlikely}"
        return replace(compared, verdict="damaged", finding=finding, content_digest="", if_rerun=compared)
    return compared


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
    return _compare_result(verification, recording, expected)


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


# --- a loop, rerun ----------------------------------------------------------------------------------


def rerun_loop(
    checked: Verification,
    sample: int | None,
    tolerance: float,
    trust: bool,
    report: StepsReport = lambda _: None,
) -> Verification:
    """Rerun a loop's environment in a child process with limits, and compare every step.

    A difference counts if it comes out again in other processes, with other hash seeds and a later clock.

    Args:
        checked: the result of checking the file, which is returned if it is not sound, or of a loop that was
            interrupted before its first step.
        sample: how many episodes to rerun, at even distances; None for all that happened.
        tolerance: absolute and relative, for floating-point observations and rewards; 0 compares bytes.
    """
    start = (checked.if_rerun if sample is None else None) or checked
    is_doubted = start is not checked
    is_empty = checked.verdict == "interrupted" and not checked.train_steps + checked.eval_steps
    if is_empty or not start.sound:
        return checked
    with open_recording(checked.path) as recording:
        if reason := why_not_rerun(recording, trust):
            return replace(checked, reason=reason)
        if recording.maker is not None:
            start = replace(start, changes=_other_versions(recording.maker))
        assumed = recording.maker.assumed if recording.maker else ()
    verification = replace(start, act="rerun", environment="installed", tolerance=tolerance, assumed=assumed)
    try:
        for message in stream_from_child(_rerun, checked.path, verification, sample, trust):
            if isinstance(message, int):
                report(message)
            else:
                verification = message
        reason, is_different = verification.reason, verification.difference is not None
        if (
            is_different
            and not reason
            and not all(_differs_again(verification, trust, k) for k in _HASH_SEEDS)
        ):
            reason = OUTSIDE
    except CannotRedo as error:
        return replace(checked, changes=start.changes, reason=str(error))
    if reason or (is_doubted and (verification.left_out or not verification.sound)):  # it did not decide
        return replace(checked, changes=start.changes, reason=reason, difference=verification.difference)
    return verification


def _differs_again(verification: Verification, trust: bool, hash_seed: int) -> bool:
    """Return whether another process finds the same difference."""
    messages = stream_from_child(_first_again, verification.path, verification, trust, hash_seed=hash_seed)
    return [message for message in messages if not isinstance(message, int)] == [verification.difference]


def _rerun(path: Path, verification: Verification, sample: int | None, trust: bool) -> None:
    """Report the number of steps taken, and at last the result; runs in a child process."""
    with open_recording(path) as recording:
        if sample is None:
            verification = _rerun_all(recording, verification, trust)
        else:
            verification = _rerun_sample(recording, verification, sample, trust)
        if verification.difference is not None:
            finding = str(verification.difference)
            reason = why_uncertain(recording, trust)
            verification = replace(verification, verdict="differs", finding=finding, reason=reason)
    if verification.verdict == "consistent":
        verification = replace(verification, verdict="reproduced")
    report_progress(verification)


def _rerun_all(recording: Recording, verification: Verification, trust: bool) -> Verification:
    from runner.replay.engine import Rerun  # loads Gymnasium

    total = {phase: recording.phase(phase).steps.total() for phase in schema.PHASES}
    left = total.copy()
    with closing(Rerun(recording, trust, verification.tolerance, report_progress)) as rerun:
        for steps in rerun.all():
            if len(steps):
                after = total[steps.phase] - 1 - int(steps.recorded["step"][-1])
                left[steps.phase] = min(left[steps.phase], after)
            verification = replace(
                verification,
                episodes=verification.episodes + int(np.count_nonzero(steps.recorded["t"] == 0)),
                steps=verification.steps + len(steps),
                difference=steps.difference,
            )
        ended = sum(recording.phase(phase).episodes.count() for phase in schema.PHASES)
        verification = replace(
            verification, left_out=rerun.skipped, unfinished=max(0, verification.episodes - ended)
        )
    if verification.difference is None and "content_digest" not in recording.result:
        verification = replace(verification, cut_off=sum(left.values()))
    if verification.difference is None and not verification.steps:
        raise CannotRedo("No reset had a seed, and the state of the random generators was not recorded.")
    return verification


def _rerun_sample(recording: Recording, verification: Verification, sample: int, trust: bool) -> Verification:
    """Rerun some episodes, at even distances, of training and evaluation together."""
    from runner.replay.environment import rerun  # loads Gymnasium

    ended = [
        (phase, number)
        for phase in schema.PHASES
        for number in range(recording.phase(phase).episodes.count())
    ]
    places = np.unique(np.linspace(0, len(ended) - 1, min(sample, len(ended))).round().astype(int))
    verification = replace(verification, of_episodes=len(ended))
    reason = "No episode ended."
    for phase, number in (ended[place] for place in places):
        taken = verification.steps

        def report(steps: int, taken: int = taken) -> None:
            report_progress(taken + steps)

        try:
            episode = rerun(
                recording, phase, [number], trust=trust, tolerance=verification.tolerance, report=report
            )
            for steps in episode:
                verification = replace(
                    verification, steps=verification.steps + len(steps), difference=steps.difference
                )
        except CannotRedo as error:
            reason = str(error)
            steps_left_out = len(recording.phase(phase).episode(number))
            verification = replace(verification, left_out=verification.left_out + steps_left_out)
            continue
        verification = replace(verification, episodes=verification.episodes + 1)
        if verification.difference is not None:
            return verification
    if not verification.episodes:
        raise CannotRedo(reason)
    return verification


def _first_again(path: Path, verification: Verification, trust: bool) -> None:
    """Report the first difference of the episode that differs, if it differs again; runs in a child process.

    The clock is months ahead, so that an environment that depends on it, however coarsely, is found out.
    """
    from runner.replay.environment import rerun  # loads Gymnasium

    _advance_clocks()
    first = verification.difference
    assert first is not None
    assert not isinstance(first, Diverged)
    episodes = None if first.episode is None else [first.episode]
    with open_recording(path) as recording, contextlib.suppress(NotInRecording):  # an episode without steps
        for steps in rerun(
            recording,
            first.phase,
            episodes,
            trust=trust,
            tolerance=verification.tolerance,
            report=report_progress,
        ):
            if steps.difference is not None:
                report_progress(steps.difference)


def _advance_clocks() -> None:
    """Set the functions of `time` that return a number ahead, before an environment's module takes them."""
    for name in ("time", "monotonic", "perf_counter"):
        for unit, function in ((1, name), (10**9, f"{name}_ns")):
            now: Callable[[], float] = getattr(time, function)
            setattr(time, function, lambda now=now, ahead=_AHEAD_SECONDS * unit: now() + ahead)


def _other_versions(maker: EnvironmentMaker) -> Differences:
    """Return the packages that determine what the environment does, where they are others than recorded."""
    here = {name: _version(name) for name in maker.packages}
    here |= {"platform": platform.platform(), "machine": platform.machine()}
    recorded = {**maker.packages, "platform": maker.platform, "machine": maker.machine}
    return {name: (recorded[name], here[name]) for name in recorded if recorded[name] != here[name]}


def _version(distribution: str) -> str:
    try:
        return importlib.metadata.version(distribution)
    except (importlib.metadata.PackageNotFoundError, ValueError):
        return "not installed"


# --- comparisons ------------------------------------------------------------------------------------


def _with_difference(
    verification: Verification, error: Diverged, verdict: Verdict = "damaged"
) -> Verification:
    """Return a verification with a difference as its finding."""
    return replace(verification, verdict=verdict, finding=str(error), difference=error)


def _compare_names(recording: Recording, learners: list[str] | None = None) -> None:
    """Compare the names that are in a recording more than once.

    Raises:
        Diverged: two of them differ.
    """
    described = recording.environment
    config = recording.config.get("env")
    for key, name in (("env_id", "id"), ("kwargs", "kwargs")):
        expected = config.get(name) if isinstance(config, Mapping) else None
        if described.get(key) != expected:
            raise Diverged("environment.json", key, described.get(key), expected)
    if learners is not None and list(recording.agents) != learners:
        raise Diverged("metadata run", "agents", list(recording.agents), learners)


def _compare_values(path: str, found: object, expected: object) -> None:
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


def _compare_result(verification: Verification, recording: Recording, expected: Json) -> Verification:
    """Compare the result in a recording with the computed one."""
    for key, value in expected.items():
        stated = recording.result.get(key)
        if key == "last_evaluation" and stated and "mean_return" not in stated:  # of an older version
            stated = {**stated, "mean_return": value["mean_return"]} if value else stated
        if stated != value:
            return _with_difference(
                verification, Diverged("metadata result", key, recording.result.get(key), value)
            )
    return replace(verification, content_digest=expected["content_digest"])
