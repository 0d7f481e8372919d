"""Verify a loop by a rerun: its environment takes the recorded actions, and every result is compared.

This shows that the recorded returns were really obtained, whatever chose the actions.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import platform
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from runner.errors import CannotRedo, NotInRecording
from runner.execution.verification import Verification
from runner.recording import schema
from runner.recording.maker import EnvironmentMaker
from runner.recording.reader import Recording, open_recording
from runner.replay.engine import Difference, Replay
from runner.replay.environment import rerun, stream_from_child
from runner.replay.makers import why_not_rerun, why_uncertain
from runner.runs.provenance import Differences
from runner.util.processes import Report, report_progress

OUTSIDE: Final = (
    "The environment gives other results each time for the same seed and actions: it depends on more than "
    "its seed, such as the global random generators, the clock, the order of a set, or threads."
)
_HASH_SEEDS: Final = (1, 2, 3, 4)
"""A difference is looked for again with each: two texts in a set may have the same order with one."""
_AHEAD_SECONDS: Final = 3_244_643
"""37 days and some hours, minutes and seconds: an odd number of each."""


def rerun_loop(
    checked: Verification,
    sample: int | None = None,
    tolerance: float = 0.0,
    trust: bool = False,
    report: Report = lambda _: None,
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
    found = replace(start, act="rerun", environment="installed", tolerance=tolerance, assumed=assumed)
    try:
        for message in stream_from_child(_rerun, checked.path, found, sample, trust):
            if isinstance(message, int):
                report(message)
            else:
                found = message
        reason, is_different = found.reason, found.difference is not None
        if is_different and not reason and not all(_differs_again(found, trust, k) for k in _HASH_SEEDS):
            reason = OUTSIDE
    except CannotRedo as error:
        return replace(checked, changes=start.changes, reason=str(error))
    if reason or (is_doubted and (found.left_out or not found.sound)):  # it did not decide
        return replace(checked, changes=start.changes, reason=reason, difference=found.difference)
    return found


def _differs_again(found: Verification, trust: bool, hash_seed: int) -> bool:
    """Return whether another process finds the same difference."""
    messages = stream_from_child(_first_again, found.path, found, trust, hash_seed=hash_seed)
    return [message for message in messages if not isinstance(message, int)] == [found.difference]


def _rerun(path: Path, found: Verification, sample: int | None, trust: bool) -> None:
    """Report the number of steps taken, and at last the result; runs in a child process."""
    with open_recording(path) as recording:
        if sample is None:
            found = _rerun_all(recording, found, trust)
        else:
            found = _rerun_sample(recording, found, sample, trust)
        if found.difference is not None:
            finding, reason = str(found.difference), why_uncertain(recording, trust)
            found = replace(found, verdict="differs", finding=finding, reason=reason)
    if found.verdict == "consistent":
        found = replace(found, verdict="reproduced")
    report_progress(found)


def _rerun_all(recording: Recording, found: Verification, trust: bool) -> Verification:
    total = {phase: recording.phase(phase).steps.total() for phase in schema.PHASES}
    left = total.copy()
    with closing(Replay(recording, trust, found.tolerance, report_progress)) as replay:
        for steps in replay.all():
            if len(steps):
                after = total[steps.phase] - 1 - int(steps.recorded["step"][-1])
                left[steps.phase] = min(left[steps.phase], after)
            found = replace(
                found,
                episodes=found.episodes + int(np.count_nonzero(steps.recorded["t"] == 0)),
                steps=found.steps + len(steps),
                difference=steps.difference,
            )
        ended = sum(recording.phase(phase).episodes.count() for phase in schema.PHASES)
        found = replace(found, left_out=replay.skipped, unfinished=max(0, found.episodes - ended))
    if found.difference is None and "content_digest" not in recording.result:
        found = replace(found, cut_off=sum(left.values()))
    if found.difference is None and not found.steps:
        raise CannotRedo("No reset had a seed, and the state of the random generators was not recorded.")
    return found


def _rerun_sample(recording: Recording, found: Verification, sample: int, trust: bool) -> Verification:
    """Rerun some episodes, at even distances, of training and evaluation together."""
    ended = [
        (phase, number)
        for phase in schema.PHASES
        for number in range(recording.phase(phase).episodes.count())
    ]
    places = np.unique(np.linspace(0, len(ended) - 1, min(sample, len(ended))).round().astype(int))
    found = replace(found, of_episodes=len(ended))
    reason = "No episode ended."
    for phase, number in (ended[place] for place in places):
        taken = found.steps

        def report(steps: int, taken: int = taken) -> None:
            report_progress(taken + steps)

        try:
            episode = rerun(recording, phase, [number], trust=trust, tolerance=found.tolerance, report=report)
            for steps in episode:
                found = replace(found, steps=found.steps + len(steps), difference=steps.difference)
        except CannotRedo as error:
            reason = str(error)
            steps_left_out = len(recording.phase(phase).episode(number))
            found = replace(found, left_out=found.left_out + steps_left_out)
            continue
        found = replace(found, episodes=found.episodes + 1)
        if found.difference is not None:
            return found
    if not found.episodes:
        raise CannotRedo(reason)
    return found


def _first_again(path: Path, found: Verification, trust: bool) -> None:
    """Report the first difference of the episode that differs, if it differs again; runs in a child process.

    The clock is months ahead, so that an environment that depends on it, however coarsely, is found out.
    """
    _advance_clocks()
    first = found.difference
    assert isinstance(first, Difference)
    episodes = None if first.episode is None else [first.episode]
    with open_recording(path) as recording, contextlib.suppress(NotInRecording):  # an episode without steps
        for steps in rerun(
            recording,
            first.phase,
            episodes,
            trust=trust,
            tolerance=found.tolerance,
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
