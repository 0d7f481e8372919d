"""Verify a loop by doing it again: its environment takes the recorded actions, and every result is compared.

This shows that the recorded returns were really obtained, whatever chose the actions.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import platform
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, Literal

import numpy as np

from runner.errors import CannotRedo, RecordingError
from runner.recording import schema
from runner.recording.maker import EnvironmentMaker
from runner.recording.reader import Recording, open_recording
from runner.replay.differences import Difference
from runner.replay.engine import Replay
from runner.replay.environment import redo, stream_from_child
from runner.replay.makers import why_not_redone, why_uncertain
from runner.runs.provenance import Differences
from runner.util.processes import report_progress

Report = Callable[[int], None]
_OUTSIDE: Final = (
    "The environment gives other results each time for the same seed and actions: it depends on more than "
    "its seed, such as the global random generators, the clock or threads."
)


@dataclass(frozen=True)
class Redone:
    """What came of doing the episodes of a loop again."""

    verdict: Literal["reproduced", "differs", "impossible"]
    episodes: int = 0
    """Episodes that were compared."""
    unfinished: int = 0
    """Those of them that were in progress when the recording ended."""
    steps: int = 0
    """Steps that were compared; all before the first difference were equal."""
    left_out: int = 0
    """Steps that could not be compared: the random generators' state at their beginning was not recorded."""
    cut_off: int = 0
    """Steps at the end that could not be compared: their resets were lost when the loop was killed."""
    difference: Difference | None = None
    """The first difference; of an impossible verdict that with which the environment was found out."""
    reason: str = ""
    """Why it is impossible, as a sentence."""
    of_episodes: int | None = None
    """The number of episodes that a sample was compared of; None if all were to be compared."""
    tolerance: float = 0.0
    """Absolute and relative, for floating-point values; 0 if bytes were compared."""
    assumed: tuple[str, ...] = ()
    """The classes whose arguments are not known for certain: those of their attributes, or the defaults, were
    taken."""
    versions: Differences = field(default_factory=dict)
    """The packages, and the platform, that are others than recorded."""


def verify_by_redoing(
    path: Path,
    sample: int | None = None,
    tolerance: float = 0.0,
    trust: bool = False,
    report: Report = lambda _: None,
) -> Redone:
    """Do the episodes of a loop again, in a child process with limits, and compare every step.

    Args:
        sample: how many episodes to do again, at even distances; None for all that happened.
        tolerance: absolute and relative, for floating-point observations and rewards; 0 compares bytes.
    """
    result = Redone("impossible", tolerance=tolerance)
    with open_recording(path) as recording:
        if reason := why_not_redone(recording, trust):
            return replace(result, reason=reason)
        if recording.maker is not None:
            result = replace(
                result, versions=_other_versions(recording.maker), assumed=recording.maker.assumed
            )
    try:
        for message in stream_from_child(_compare, path, sample, tolerance, trust):
            if isinstance(message, int):
                report(message)
            else:
                result = replace(message, versions=result.versions, assumed=result.assumed)
    except CannotRedo as error:
        return replace(result, reason=str(error))
    return result


def _compare(path: Path, sample: int | None, tolerance: float, trust: bool) -> None:
    """Report the number of steps taken, and at last the result; runs in a child process."""
    with open_recording(path) as recording:
        if sample is None:
            outcome = _compare_all(recording, tolerance, trust)
        else:
            outcome = _compare_sample(recording, sample, tolerance, trust)
        if outcome.difference is not None and (reason := why_uncertain(recording, trust)):
            outcome = replace(outcome, verdict="impossible", reason=reason)
        elif outcome.difference is not None and not _is_repeatable(recording, outcome, trust):
            outcome = replace(outcome, verdict="impossible", reason=_OUTSIDE)
    report_progress(outcome)


def _compare_all(recording: Recording, tolerance: float, trust: bool) -> Redone:
    outcome = Redone("reproduced", tolerance=tolerance)
    total = {phase: recording.step_count(phase) for phase in schema.PHASES}
    left = total.copy()
    with closing(Replay(recording, trust, tolerance, report_progress)) as replay:
        for steps in replay.all():
            if len(steps):
                after = total[steps.phase] - 1 - int(steps.step[-1])
                left[steps.phase] = min(left[steps.phase], after)
            outcome = replace(
                outcome,
                episodes=outcome.episodes + int(np.count_nonzero(steps.t == 0)),
                steps=outcome.steps + len(steps),
                difference=steps.difference,
            )
        ended = sum(recording.count(recording.topic(f"/{phase}/episode")) for phase in schema.PHASES)
        outcome = replace(outcome, left_out=replay.skipped, unfinished=max(0, outcome.episodes - ended))
    if outcome.difference is None and "content_digest" not in recording.result:
        outcome = replace(outcome, cut_off=sum(left.values()))
    if outcome.difference is not None:
        return replace(outcome, verdict="differs")
    if not outcome.steps:
        reason = "No reset had a seed, and the state of the random generators was not recorded."
        return replace(outcome, verdict="impossible", reason=reason)
    return outcome


def _compare_sample(recording: Recording, sample: int, tolerance: float, trust: bool) -> Redone:
    """Compare some episodes, at even distances, of training and evaluation together."""
    ended = [
        (phase, number)
        for phase in schema.PHASES
        for number in range(recording.count(recording.topic(f"/{phase}/episode")))
    ]
    places = np.unique(np.linspace(0, len(ended) - 1, min(sample, len(ended))).round().astype(int))
    outcome = Redone("reproduced", of_episodes=len(ended), tolerance=tolerance)
    reason = "No episode ended."
    for phase, number in (ended[place] for place in places):
        taken = outcome.steps

        def report(steps: int, taken: int = taken) -> None:
            report_progress(taken + steps)

        try:
            for steps in redo(recording, phase, [number], trust=trust, tolerance=tolerance, report=report):
                outcome = replace(outcome, steps=outcome.steps + len(steps), difference=steps.difference)
        except CannotRedo as error:
            reason = str(error)
            span = recording.episode_span(phase, number)
            outcome = replace(outcome, left_out=outcome.left_out + len(span))
            continue
        outcome = replace(outcome, episodes=outcome.episodes + 1)
        if outcome.difference is not None:
            return replace(outcome, verdict="differs")
    return outcome if outcome.episodes else replace(outcome, verdict="impossible", reason=reason)


def _is_repeatable(recording: Recording, found: Redone, trust: bool) -> bool:
    """Return whether the environment differs in the same way when it is done again once more."""
    first = found.difference
    assert first is not None

    def report(_: int) -> None:
        report_progress(found.steps)

    episodes = None if first.episode is None else [first.episode]
    with contextlib.suppress(RecordingError):  # an episode without steps
        for steps in redo(
            recording, first.phase, episodes, trust=trust, tolerance=found.tolerance, report=report
        ):
            if steps.difference is not None:
                return steps.difference == first
    return False


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
