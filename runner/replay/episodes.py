"""One recorded episode, rerun alone: begun as late as its environment allows."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from runner.errors import CannotRedo, NotInRecording, RecordingError
from runner.recording import schema
from runner.recording.reader import Recording
from runner.recording.schema import STEP_NANOSECONDS
from runner.replay.engine import ALL, Replay, own_steps
from runner.replay.recorded import Piece, RecordedReset, pieces, resets_of
from runner.replay.redone import RedoneSteps
from runner.replay.stepping import RowStepper

_HELD_STEPS: Final = 64
_HELD_SECONDS: Final = 0.3
_HELD_BYTES: Final = 32 << 20
"""An episode counts as begun in the right state if this many steps agree, or those of this time, or as many
as have pictures of this size."""


OnReset = Callable[[RowStepper, Iterator[object]], None]
"""Takes an environment before the reset that begins an episode, and the episode's recorded actions."""


class _Astray(Exception):
    """An environment differs where it was not begun at the beginning of the recording."""


@dataclass(frozen=True)
class _Target:
    """An episode that is rerun alone."""

    phase: str
    number: int
    environment: int
    reset: RecordedReset
    stop_time: int
    """The `log_time` of its last step, and of the other environments' steps with it."""


def redo_episode(
    recording: Recording, phase: str, number: int, make: Callable[[], Replay]
) -> Iterator[RedoneSteps]:
    """Yield the steps of one episode, begun as late as possible.

    Args:
        make: returns a new replay.
    """
    target = _target(recording, phase, number)
    with closing(make()) as replay:
        if ALL in replay.environments:
            yield from _episode_of_whole(recording, replay, target)
            return
    for start in _starts(recording, target):
        try:
            with closing(make()) as replay:
                yield from _held(_episode(recording, replay, target, start), is_last=start is None)
            return
        except _Astray:
            continue


@contextmanager
def episode_at(
    recording: Recording, phase: str, number: int, t: int, make: Callable[[], Replay], on_reset: OnReset
) -> Iterator[None]:
    """Bring an environment to a step of an episode, by the recorded resets and actions; close it afterwards.

    Args:
        t: the number of steps to take.
        on_reset: called before the reset that begins the episode, with the recorded actions from `t` on; it
            may wrap `RowStepper.env`.

    Raises:
        CannotRedo: the environment differs from the recording, or cannot be brought there.
    """
    span, n = recording.phase(phase).episode_span(number), recording.environments
    if not 0 <= t < len(span):
        raise NotInRecording(
            f"{recording.path}: found no step {t:,} of {schema.PHASE_NAMES[phase]} episode {number}; it has "
            f"{len(span):,}, from 0."
        )
    target = _target(recording, phase, number)
    time = _step_time(recording, phase, span[t] // n * n) - STEP_NANOSECONDS
    until = replace(target, stop_time=max(time, target.reset.time) + 1)
    start = _right_start(recording, target, make)
    with closing(make()) as replay:
        if ALL in replay.environments:
            raise CannotRedo("The environments of this vector cannot be stepped one by one.")
        stepper = replay.stepper(phase, target.environment)
        assert isinstance(stepper, RowStepper)  # or the vector is stepped as a whole
        actions = (
            action
            for piece in pieces(recording, [phase], time, target.stop_time)
            for action in stepper.actions(own_steps(piece, target.environment, n)[0])
        )
        for steps in _episode(recording, replay, until, start, lambda: on_reset(stepper, actions)):
            steps.require_equal()
        yield


def _right_start(recording: Recording, target: _Target, make: Callable[[], Replay]) -> RecordedReset | None:
    """Return the reset from which to begin, so that the episode's first steps agree."""
    for start in _starts(recording, target):
        try:
            with closing(make()) as replay:
                if start is not None and ALL not in replay.environments:
                    next(_held(_episode(recording, replay, target, start), is_last=False), None)
            return start
        except _Astray:
            continue
    return None


def _target(recording: Recording, phase: str, number: int) -> _Target:
    """Return where an episode is, and its reset.

    Raises:
        RecordingError: there is no such episode, or it has no reset.
    """
    own, n = recording.phase(phase), recording.environments
    span, ended = own.episode_span(number), own.episodes.array(number, number + 1)
    stop_time = int(ended["log_time"][0]) if len(ended) else _step_time(recording, phase, span[-1])
    for reset in _resets_back(recording, phase, stop_time):
        if reset.environment % n == span[0] % n and reset.step <= span[0]:
            others = n - 1 - reset.environment % n  # their steps follow at once
            return _Target(phase, number, reset.environment, reset, stop_time + others * STEP_NANOSECONDS)
    raise RecordingError(f"{recording.path}: {phase} episode {number} has no reset before it.")


def _step_time(recording: Recording, phase: str, step: int) -> int:
    return int(recording.phase(phase).steps.one(step)["log_time"])


def _resets_back(recording: Recording, phase: str, time: int) -> Iterator[RecordedReset]:
    """Yield the resets up to a time, from the last to the first, reading no more than needed."""
    width, stop = 1_000 * STEP_NANOSECONDS, time
    while stop >= 0:
        start = max(stop - width, 0)
        yield from reversed(list(resets_of(recording, phase, start, stop)))
        stop, width = start - 1, 4 * width


def _starts(recording: Recording, target: _Target) -> Iterator[RecordedReset | None]:
    """Yield the resets from which to begin, the best first; None for the beginning of the recording."""
    has_state = False
    for reset in _resets_back(recording, target.phase, target.reset.time):
        if reset.environment != target.environment or reset.number > target.reset.number:
            continue
        if reset.seed is not None or (reset.is_known and not has_state):
            yield reset
            if reset.seed is not None:
                break
            has_state = True
    yield None


def _episode(
    recording: Recording,
    replay: Replay,
    target: _Target,
    start: RecordedReset | None,
    on_reset: Callable[[], None] = lambda: None,
) -> Iterator[RedoneSteps]:
    """Yield the steps of one episode, after taking those between `start` and its reset.

    `on_reset` is called before its reset.

    Raises:
        _Astray: steps before the episode differ, and it was not begun at the beginning of the recording.
        CannotRedo: the state of the random generators at its beginning is not known.
    """
    is_begun = False
    for piece, is_target in _approach(recording, target, start):
        if is_target and not is_begun:
            on_reset()
            is_begun = True
        for steps in replay.steps(piece, target.environment, draws=is_target and replay.render):
            if is_target:
                yield _numbered(steps, target.number)
            elif steps.difference is not None and start is not None:
                raise _Astray
            elif steps.difference is not None:
                yield steps.without_rows()
                return
        if is_target and not replay.is_known(target.phase, target.environment):
            raise CannotRedo(
                f"{target.phase} episode {target.number} began with a reset without a seed, and the state of "
                "the random generators before it was not recorded."
            )


def _episode_of_whole(recording: Recording, replay: Replay, target: _Target) -> Iterator[RedoneSteps]:
    """Yield the steps of one episode of a vector that is stepped as a whole, from its beginning."""
    replay.drawn, replay.draw_from = target.environment, max(replay.draw_from, target.reset.step)
    for piece in pieces(recording, schema.PHASES, stop_time=target.stop_time):
        for steps in replay.steps(piece, ALL, draws=replay.render and piece.phase == target.phase):
            own = steps.without_rows()
            if piece.phase == target.phase and steps.environment == target.environment:
                own = steps.since(target.reset.step)
                starts = tuple(start for start in own.starts if start.episode == target.reset.episode)
                own = replace(own, starts=starts)
            if len(own) or own.starts or own.difference is not None:
                yield _numbered(own, target.number)
            if own.difference is not None:
                return


def _numbered(steps: RedoneSteps, number: int) -> RedoneSteps:
    """Return steps with the number of the episode among all environments."""
    starts = tuple(start._replace(episode=number) for start in steps.starts)
    return replace(steps, episode=np.full(len(steps), number), starts=starts)


def _approach(
    recording: Recording, target: _Target, start: RecordedReset | None
) -> Iterator[tuple[Piece, bool]]:
    """Yield pieces from a reset up to the end of an episode, each with whether it belongs to the episode."""
    is_reached, is_waiting = False, start is not None
    start_time = 0 if start is None else start.time
    for piece in pieces(recording, schema.PHASES, start_time, target.stop_time):
        own = piece
        if is_waiting and start is not None:
            if not _has(piece, target.phase, start):
                continue
            own, is_waiting = _split(piece, start)[1], False
        if not is_reached and _has(own, target.phase, target.reset):
            before, own = _split(own, target.reset)
            yield before, False
            is_reached = True
        if not is_reached or own.phase == target.phase:  # what the other phase does meanwhile is not its own
            yield own, is_reached


def _has(piece: Piece, phase: str, reset: RecordedReset) -> bool:
    return piece.phase == phase and any(each.number == reset.number for each in piece.resets)


def _held(found: Iterator[RedoneSteps], is_last: bool) -> Iterator[RedoneSteps]:
    """Yield the same blocks, the first ones only once enough steps agree.

    Raises:
        _Astray: they do not, and there is another place to begin.
    """
    held: list[RedoneSteps] = []
    count = 0
    size = 0
    is_holding, begun = not is_last, time.monotonic()
    for steps in found:
        is_early = count < _HELD_STEPS and size < _HELD_BYTES
        if is_holding and is_early and (not held or time.monotonic() < begun + _HELD_SECONDS):
            if steps.difference is not None:
                raise _Astray
            held.append(steps)
            count, size = count + len(steps), size + sum(frame.nbytes for frame in steps.frames)
            continue
        is_holding = False  # what was yielded cannot be taken back
        while held:
            yield held.pop(0)
        yield steps
    yield from held


def _split(piece: Piece, reset: RecordedReset) -> tuple[Piece, Piece]:
    """Return what comes before a reset, and the rest, which begins with it."""
    at = next(k for k, each in enumerate(piece.resets) if each.number == reset.number)
    rows = reset.step - piece.first
    before = replace(piece, rows=piece.rows[:rows], resets=piece.resets[:at])
    return before, replace(piece, first=reset.step, rows=piece.rows[rows:], resets=piece.resets[at:])
