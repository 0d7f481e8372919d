"""A loop's episodes, rerun: its environment is made again and takes the recorded resets and actions.

    for steps in rerun_in_child(path, "train", episodes=[5], render=True):
        for row in range(len(steps)):
            show(steps.frames[row], steps.recorded["rewards"][row])
        if steps.difference:
            ...                           # the environment is not the recorded one; nothing follows

`rerun` runs the environment, which is foreign code, in this process; `rerun_in_child` in a child process with
limits on memory and time. `runner.replay.makers` says whether a recording can be rerun, and
`runner.export.pictures` what its pictures are made from.
"""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

from runner.errors import CannotRedo, NotInRecording, RecordingError
from runner.recording import schema
from runner.recording.reader import Recording, open_recording
from runner.recording.schema import STEP_NANOSECONDS
from runner.recording.steps import Steps
from runner.replay.engine import Rerun, RerunSteps
from runner.replay.makers import ALL, environments_of, silence, stream_from_child, why_not_rerun
from runner.replay.recorded import Piece, RecordedReset, pieces, reset_before, resets_back
from runner.replay.steppers import Stepper
from runner.util.processes import Report, report_progress


def rerun(
    recording: Recording,
    phase: str | None = None,
    episodes: Sequence[int] | None = None,
    *,
    render: bool = False,
    trust: bool = False,
    tolerance: float = 0.0,
    report: Report = lambda _: None,
    make: Callable[[], object] | None = None,
    draw_from: int = 0,
) -> Iterator[RerunSteps]:
    """Rerun recorded episodes; yield their steps in blocks of about 0.2 s, compared with the recording.

    An episode alone is begun at its reset, if that has a seed or the state of the random generators was
    recorded there, else at the nearest such reset before it. Where its first steps differ then, as in
    environments that keep more than that from episode to episode, it is rerun with all episodes since an
    earlier seed, and at last since the beginning of the recording.

    Args:
        recording: of a loop.
        phase: `train` or `eval`; None for both, in the order of time, without `episodes`.
        episodes: numbers of ended episodes of the phase, in any order; of a single environment also the
            last, unfinished episode. None for all that happened, in the order of time.
        render: whether to draw a picture after each reset and step.
        trust: whether what the recording names may be imported, see `runner.replay.trust`.
        tolerance: absolute and relative, for floating-point observations and rewards; 0 compares bytes.
        report: called with the number of steps taken so far, also of those before an episode.
        make: returns the environment, which is closed at the end, instead of making it as recorded.
        draw_from: steps of an episode before its first picture.

    Raises:
        CannotRedo: the environment cannot be made again, or draws no pictures; the message is why.
        RecordingError: the recording is damaged, or has no such episode.
    """
    if make is None and (reason := why_not_rerun(recording, trust)):
        raise CannotRedo(reason)
    begin = partial(Rerun, recording, trust, tolerance, report, render, make)
    if episodes is None:
        with closing(begin()) as attempt:
            for steps in attempt.all():
                if phase in (None, steps.phase) or steps.difference is not None:
                    yield steps
        return
    for episode in episodes:
        phase = phase or "train"
        if draw_from:
            recorded = recording.phase(phase).episode(episode)
            is_inside = draw_from <= len(recorded)
            first = int(recorded.one(draw_from - 1)["step"]) if is_inside else recorded.last + 1
            begin = partial(begin, draw_from=first)
        for steps in rerun_episode(recording, phase, episode, begin):
            yield steps
            if steps.difference is not None:
                return


def rerun_in_child(
    path: Path,
    phase: str | None = None,
    episodes: Sequence[int] | None = None,
    *,
    render: bool = False,
    trust: bool = False,
    draw_from: int = 0,
) -> Iterator[RerunSteps]:
    """Rerun recorded episodes in a child process, which ends with the iterator; see `rerun`.

    The child works ahead of the caller by a block at most. A process that is such a child reruns them
    itself, as it may have none.

    Raises:
        CannotRedo: see `rerun`; or the environment hangs, crashes, or needs more memory.
    """
    options: Any = {"render": render, "trust": trust, "draw_from": draw_from}
    if multiprocessing.current_process().daemon:
        silence()
        with open_recording(path) as recording:
            yield from rerun(recording, phase, episodes, **options)
        return
    for message in stream_from_child(_rerun_path, path, phase, episodes, **options):
        if isinstance(message, RerunSteps):  # else steps taken, which show that it does not hang
            yield message


def _rerun_path(path: Path, phase: str | None, episodes: Sequence[int] | None, **arguments: Any) -> None:
    """Pass the rerun steps of a recording to the process that called this one."""
    with open_recording(path) as recording:
        for steps in rerun(recording, phase, episodes, report=report_progress, **arguments):
            report_progress(steps)


# --- one episode alone, begun as late as its environment allows ---------------------------------------

_HELD_STEPS: Final = 64
_HELD_SECONDS: Final = 0.3
_HELD_BYTES: Final = 32 << 20
"""An episode counts as begun in the right state once this many steps agree, or the steps of this many
seconds, or steps with this many bytes of pictures."""


OnReset = Callable[[Stepper, Iterator[object]], None]
"""Takes an environment before the reset that begins an episode, and the episode's recorded actions."""


class _Astray(Exception):
    """An environment differs where it was not begun at the beginning of the recording."""


@dataclass(frozen=True)
class _Target:
    """An episode that is rerun alone."""

    number: int
    reset: RecordedReset
    stop_time: int
    """The `log_time` of its last step, and of the other environments' steps with it."""


def rerun_episode(
    recording: Recording, phase: str, number: int, make: Callable[[], Rerun]
) -> Iterator[RerunSteps]:
    """Yield the steps of one episode, begun as late as possible.

    Args:
        make: returns a new rerun.
    """
    target = _target(recording, phase, number)
    for start in _starts(recording, target):
        try:
            with closing(make()) as attempt:
                yield from _held(_episode(recording, attempt, target, start), is_last=start is None)
            return
        except _Astray:
            continue


@contextmanager
def episode_at(
    recording: Recording, phase: str, number: int, t: int, make: Callable[[], Rerun], on_reset: OnReset
) -> Iterator[None]:
    """Bring an environment to a step of an episode, by the recorded resets and actions; close it afterwards.

    Args:
        t: the number of steps to take.
        on_reset: called before the reset that begins the episode, with the recorded actions from `t` on; it
            may wrap `Stepper.env`.

    Raises:
        CannotRedo: the environment differs from the recording, or cannot be brought there.
    """
    recorded = recording.phase(phase).episode(number)
    if not 0 <= t < len(recorded):
        raise NotInRecording(
            f"{recording.path}: found no step {t:,} of {schema.PHASE_NAMES[phase]} episode {number}; it has "
            f"{len(recorded):,}, from 0."
        )
    if ALL in environments_of(recording):
        raise CannotRedo("The environments of this vector cannot be stepped one by one.")
    target = _target(recording, phase, number)
    environment = target.reset.environment
    turns = recorded.table.round_of(int(recorded.one(t)["step"]))
    time = _step_time(recorded.table, turns.start) - STEP_NANOSECONDS
    until = replace(target, stop_time=max(time, target.reset.time) + 1)
    start = _right_start(recording, target, make)
    with closing(make()) as attempt:
        stepper = attempt.stepper(phase, environment)
        actions = (
            action
            for piece in pieces(recording, [phase], time, target.stop_time)
            for action in stepper.actions(attempt.recorded_steps(piece, environment)[0])
        )
        for steps in _episode(recording, attempt, until, start, lambda: on_reset(stepper, actions)):
            steps.require_equal()
        yield


def _right_start(recording: Recording, target: _Target, make: Callable[[], Rerun]) -> RecordedReset | None:
    """Return the reset from which to begin, so that the episode's first steps agree."""
    for start in filter(None, _starts(recording, target)):
        try:
            with closing(make()) as attempt:
                next(_held(_episode(recording, attempt, target, start), is_last=False), None)
            return start
        except _Astray:
            continue
    return None


def _target(recording: Recording, phase: str, number: int) -> _Target:
    """Return where an episode is, and its reset.

    Raises:
        RecordingError: there is no such episode, or it has no reset.
    """
    steps = recording.phase(phase).episode(number)
    ended = recording.phase(phase).episodes.array(number, number + 1)
    if (reset := reset_before(recording, phase, number)) is None:
        raise RecordingError(f"{recording.path}: {phase} episode {number} has no reset before it.")
    stop_time = int(ended["log_time"][0]) if len(ended) else _step_time(steps.table, steps.last)
    others = steps.table.round_of(steps.last)[-1] - steps.last  # their steps follow at once
    return _Target(number, reset, stop_time + others * STEP_NANOSECONDS)


def _step_time(steps: Steps, number: int) -> int:
    return int(steps.one(number)["log_time"])


def _starts(recording: Recording, target: _Target) -> Iterator[RecordedReset | None]:
    """Yield the resets from which to begin, the best first; None for the beginning of the recording."""
    if ALL in environments_of(recording):
        yield None
        return
    has_state = False
    for reset in resets_back(recording, target.reset.phase, target.reset.time):
        if reset.environment != target.reset.environment or reset.number > target.reset.number:
            continue
        if reset.seed is not None or (reset.is_known and not has_state):
            yield reset
            if reset.seed is not None:
                break
            has_state = True
    yield None


def _episode(
    recording: Recording,
    attempt: Rerun,
    target: _Target,
    start: RecordedReset | None,
    on_reset: Callable[[], None] = lambda: None,
) -> Iterator[RerunSteps]:
    """Yield the steps of one episode, after taking those between `start` and its reset.

    Args:
        on_reset: called before its reset.

    Raises:
        _Astray: steps before the episode differ, and it was not begun at the beginning of the recording.
        CannotRedo: the state of the random generators at its beginning is not known.
    """
    reset = target.reset
    is_whole = ALL in attempt.environments
    is_begun = False
    environment = ALL if is_whole else reset.environment
    attempt.drawn = reset.environment
    for piece, is_target in _approach(recording, target, start, is_whole):
        if is_target and not is_begun:
            on_reset()
            is_begun = True
        for steps in attempt.steps(piece, environment, is_target and attempt.render, start):
            if is_target and steps.environment == reset.environment:
                yield replace(
                    steps, starts=[begun for begun in steps.starts if begun.reset.number >= reset.number]
                )
            elif steps.difference is not None and start is not None:
                raise _Astray
            elif steps.difference is not None:
                yield replace(steps, recorded=steps.recorded[:0], got=steps.got[:0], starts=(), frames=())
                return
        if is_target and not attempt.is_known(reset.phase, environment):
            raise CannotRedo(
                f"{reset.phase} episode {target.number} began with a reset without a seed, and the state of "
                "the random generators before it was not recorded."
            )


def _approach(
    recording: Recording, target: _Target, start: RecordedReset | None, is_whole: bool
) -> Iterator[tuple[Piece, bool]]:
    """Yield pieces from a reset up to the end of an episode, each with whether it belongs to the episode."""
    reset = target.reset
    is_reached = False
    for piece in pieces(recording, schema.PHASES, 0 if start is None else start.time, target.stop_time):
        is_of_phase = piece.phase == reset.phase
        numbers = [other.number for other in piece.resets if is_of_phase]
        if reset.number in numbers:
            # The environments of a vector that are reset with the same step stay together.
            at = [other.step for other in piece.resets].index(reset.step)
            at = at if is_whole else numbers.index(reset.number)
            rows = reset.step - piece.first
            yield piece.part(0, rows, piece.resets[:at]), False
            yield piece.part(rows, len(piece.rows), piece.resets[at:]), True
            is_reached = True
        elif is_of_phase or not is_reached:  # what the other phase does meanwhile is not part of the episode
            yield piece, is_reached


def _held(blocks: Iterator[RerunSteps], is_last: bool) -> Iterator[RerunSteps]:
    """Yield the same blocks, the first ones only once enough steps agree.

    Raises:
        _Astray: they do not, and there is another place to begin.
    """
    held = list[RerunSteps]()
    count = 0
    size = 0
    end = time.monotonic() + _HELD_SECONDS
    if not is_last:
        for steps in blocks:
            if steps.difference is not None:
                raise _Astray
            held.append(steps)
            count += len(steps)
            size += sum(frame.nbytes for frame in steps.frames)
            if count >= _HELD_STEPS or size >= _HELD_BYTES or time.monotonic() >= end:
                break  # what was yielded cannot be taken back
    while held:
        yield held.pop(0)
    yield from blocks
