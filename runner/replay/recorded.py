"""What a loop did to its environments, in the order of time: resets and steps, in pieces of bounded size."""

from __future__ import annotations

import heapq
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from typing import Final, NamedTuple, TypeVar

import numpy as np

from runner.errors import RecordingError, shortened
from runner.recording.description import environment_count
from runner.recording.messages import ResetOptions, ResetState
from runner.recording.reader import Recording
from runner.recording.schema import PHASES, STEP_NANOSECONDS
from runner.recording.spaces import Value, decode
from runner.recording.steps import aligned
from runner.recording.topic_chunks import FOREVER
from runner.util.arrays import Records
from runner.util.jsonable import as_json
from runner.util.values import Json

_PHASE_CHANGES: Final = 100
"""How many changes of the phase are looked at to find out whether both are of one environment."""
_BLOCK_BYTES: Final = 16 << 20
_NOTHING_GIVEN: Final = ResetOptions()
_MAX_WORDS: Final = 200
"""The most letters of a seed or of options in words."""
M = TypeVar("M", ResetOptions, ResetState)


class RecordedReset(NamedTuple):
    """A reset of one environment."""

    phase: str
    number: int
    """Its number in the phase."""
    environment: int
    episode: int
    """The number of the episode that it begins, counted in its environment."""
    step: int
    """Steps of the phase before it."""
    time: int
    """Its `log_time` in nanoseconds."""
    observation: Value
    """As recorded: a NumPy value, or bytes where values vary in size."""
    seed: int | None
    given: ResetOptions = _NOTHING_GIVEN
    """What it was called with besides the seed."""
    state: ResetState | None = None
    """What the reset depends on, if it has no seed and this was recorded."""

    def value(self, recording: Recording) -> Value:
        """Return the observation as a value of its space."""
        if not isinstance(self.observation, bytes):
            return self.observation
        return decode(recording.spaces["observation"], self.observation, f"{recording.path}: a reset")

    @property
    def is_known(self) -> bool:
        """Whether its episode can be repeated without those before it, but for what outlives a reset."""
        state = self.state
        has_state = state is not None and (
            state.np_random_seed is not None or state.bit_generator is not None or state.ale_state != b""
        )
        return self.seed is not None or has_state

    @property
    def arguments(self) -> Json:
        """The seed and the options, as JSON can hold them; None for each that it had not."""
        options = (
            self.given.options if self.given.options is not None else json.loads(self.given.json or "null")
        )
        return {"seed": self.seed, "options": as_json(options)}

    @property
    def in_words(self) -> str:
        """The seed and the options, such as `seed 7 and options {"map": 3}`; empty for neither."""
        given = {name: value for name, value in self.arguments.items() if value is not None}
        return " and ".join(
            f"{name} {shortened(json.dumps(value), _MAX_WORDS)}" for name, value in given.items()
        )

    def may_begin(self, start: RecordedReset | None) -> bool:
        """Return whether a rerun can begin here; with `start`, whether this is that reset."""
        is_start = start is None or (self.phase, self.number) == (start.phase, start.number)
        return self.is_known and is_start


@dataclass(frozen=True, eq=False)
class Piece:
    """Consecutive steps of a phase, as many of each environment, and the resets before and between them."""

    phase: str
    first: int
    """The number of its first step."""
    rows: Records
    """The records, [steps of each environment * environments]; values of varying size are objects."""
    resets: Sequence[RecordedReset]
    """In order; in a piece with steps, each comes before one of the steps."""
    time: int
    """Nanoseconds before its first step, or at its resets."""

    def part(self, begin: int, end: int, resets: Sequence[RecordedReset]) -> Piece:
        """Return the rows from `begin` to `end`, with their resets."""
        time = self.time + begin * STEP_NANOSECONDS
        return Piece(self.phase, self.first + begin, self.rows[begin:end], resets, time)


def pieces(
    recording: Recording, phases: Iterable[str], start_time: int = 0, stop_time: int | None = None
) -> Iterator[Piece]:
    """Yield what happened in some phases, in the order of time.

    Args:
        start_time: the earliest `log_time` of resets; steps come after it.
        stop_time: the last `log_time` of steps; resets after that step are left out. By default all.
    """
    streams = [_pieces_of(recording, phase, start_time, stop_time) for phase in phases]
    last_phase = ""
    resets: list[Piece] = []
    for piece in heapq.merge(*streams, key=lambda piece: (piece.time, len(piece.rows) > 0)):
        if resets and (len(piece.rows) or piece.time != resets[0].time):
            yield from _in_turn(resets, last_phase)
            resets = []
        if len(piece.rows):
            last_phase = piece.phase
            yield piece
        else:
            resets.append(piece)
    yield from _in_turn(resets, last_phase)


def _in_turn(resets: list[Piece], last_phase: str) -> list[Piece]:
    """Return resets of one time in their order: the phase that took the last step reset first."""
    return sorted(resets, key=lambda piece: piece.phase != last_phase)


def resets_of(
    recording: Recording, phase: str, start_time: int = 0, stop_time: int | None = None
) -> Iterator[RecordedReset]:
    """Yield the resets of a phase in order, from `start_time` up to and with `stop_time`."""
    times = range(start_time, FOREVER if stop_time is None else stop_time + 1)
    tables = recording.phase(phase)
    options_of, state_of = _by_reset(tables.reset_options(times)), _by_reset(tables.reset_states(times))
    names = ("reset", "environment", "episode", "step", "log_time", "seed", "seeded")
    for block in tables.resets.rows(times):
        for number, environment, episode, step, time, seed, seeded, observation in zip(
            *(block[name].tolist() for name in names), block["observation"], strict=True
        ):
            given = options_of(number) or _NOTHING_GIVEN
            known_seed = seed if seeded else given.large_seed
            yield RecordedReset(
                phase,
                number,
                environment,
                episode,
                step,
                time,
                observation,
                known_seed,
                given,
                state_of(number),
            )


def _by_reset(messages: Iterator[M]) -> Callable[[int], M | None]:
    """Return a function that returns the message of a reset, given by its number; numbers must ascend."""
    waiting = next(messages, None)

    def message_of(number: int) -> M | None:
        nonlocal waiting
        while waiting is not None and waiting.reset + waiting.resets <= number:
            waiting = next(messages, None)
        return waiting if waiting is not None and waiting.reset <= number else None

    return message_of


def resets_back(recording: Recording, phase: str, time: int) -> Iterator[RecordedReset]:
    """Yield the resets up to a time, from the last to the first, reading no more than needed."""
    width = 1_000 * STEP_NANOSECONDS
    stop = time
    while stop >= 0:
        start = max(stop - width, 0)
        yield from reversed(list(resets_of(recording, phase, start, stop)))
        stop = start - 1
        width = 4 * width


def reset_before(recording: Recording, phase: str, episode: int) -> RecordedReset | None:
    """Return the last reset of an episode's environment at or before its first step; None if it was lost.

    Raises:
        RecordingError: there is no such episode, or its first step was lost.
    """
    steps = recording.phase(phase).episode(episode)
    time = int(steps.table.one(steps.first)["log_time"])
    for reset in resets_back(recording, phase, time):
        if reset.environment == steps.environment and reset.step <= steps.first:
            return reset
    return None


def reset_of(recording: Recording, phase: str, episode: int) -> RecordedReset | None:
    """Return the reset that begins an episode, as `reset_before` does.

    None, too, if the environment was stepped on after the end of the episode before, without a reset.
    """
    steps = recording.phase(phase).episode(episode)
    reset = reset_before(recording, phase, episode)
    return None if reset is None or reset.episode != steps.table.one(steps.first)["episode"] else reset


def calls(resets: Iterable[RecordedReset]) -> Iterator[list[RecordedReset]]:
    """Yield the resets of each call: the environments are in order, and have the same options."""
    call: list[RecordedReset] = []
    for reset in resets:
        is_next = bool(call) and reset.environment > call[-1].environment
        if call and not (is_next and reset.given.json == call[-1].given.json):
            yield call
            call = []
        call.append(reset)
    if call:
        yield call


# --- pieces -------------------------------------------------------------------------------------------


def _pieces_of(recording: Recording, phase: str, start_time: int, stop_time: int | None) -> Iterator[Piece]:
    """Yield the pieces of one phase; one ends where steps of the other phase come between its own."""
    table = recording.phase(phase).steps
    environments = environment_count(recording)
    resets = resets_of(recording, phase, start_time, None if stop_time is None else stop_time - 1)
    waiting = next(resets, None)
    blocks = aligned(_blocks(recording, phase, start_time, stop_time), recording.environments)
    rows = (block for block, _ in blocks if len(block))
    if "content_digest" not in recording.result:
        stop = recording.phase(phase).whole_steps()
        rows = (whole for block in rows if len(whole := block[block["step"] < stop]))
    nothing = np.empty(0, table.row_dtype)
    for block in rows:
        first = int(block["step"][0])
        time = int(block["log_time"][0]) - STEP_NANOSECONDS
        early = []
        while waiting is not None and waiting.time < time and waiting.step <= first:
            early.append(waiting)
            waiting = next(resets, None)
        yield from _without_steps(phase, early, nothing)
        here = []
        while waiting is not None and waiting.step < first + len(block):
            # Environments step in rounds, and a reset comes before a whole round.
            is_within_round = waiting.step > table.round_of(waiting.step).start
            if waiting.step < first or is_within_round or waiting.environment >= environments:
                raise RecordingError(
                    f"{recording.path}: /{phase}/reset {waiting.number}: out of order, or of no environment."
                )
            here.append(waiting)
            waiting = next(resets, None)
        yield Piece(phase, first, block, here, time)
    yield from _without_steps(phase, resets if waiting is None else [waiting, *resets], nothing)


def _without_steps(phase: str, resets: Iterable[RecordedReset], nothing: Records) -> Iterator[Piece]:
    """Yield resets that no step of their phase follows at once, the resets of one time together."""
    for time, group in groupby(resets, key=lambda reset: reset.time):
        here = list(group)
        yield Piece(phase, here[0].step, nothing, here, time)


def _blocks(recording: Recording, phase: str, start_time: int, stop_time: int | None) -> Iterator[Records]:
    """Yield the steps of a phase in blocks, each without steps of the other phase in between."""
    table = recording.phase(phase).steps
    stop = FOREVER if stop_time is None else stop_time + 1
    # A block of actions alone may have more steps than fit into memory when they are whole.
    width = 1 if table.dtype is None else table.dtype.itemsize * recording.environments
    rows = max(_BLOCK_BYTES // width, 1) * recording.environments
    for block in table.rows(range(start_time + 1, stop)):
        others = block["log_time"].astype(np.int64) // STEP_NANOSECONDS - block["step"]
        changes = (np.flatnonzero(np.diff(others)) + 1).tolist()
        for begin, end in pairwise(sorted({*changes, *range(0, len(block), rows), len(block)})):
            yield block[begin:end]


def ended_episode(recording: Recording, phase: str, environment: int, step: int) -> int | None:
    """Return the number of the episode of a step in one of several environments; None if it never ended."""
    for block in recording.phase(phase).episodes.blocks():
        is_later = (block["last_step"] >= step) & (block["environment"] == environment)
        if is_later.any():
            return int(block["episode"][np.argmax(is_later)])
    return None


def last_step_time(recording: Recording) -> int:
    """Return the `log_time` of the last step in a recording that was cut: later resets lost their steps."""
    tables = [phase.steps for phase in recording.phases]
    if "content_digest" in recording.result or any(steps.are_actions for steps in tables):
        return FOREVER
    return max((steps.entry(len(steps) - 1).end_time for steps in tables if steps), default=0)


def are_separate(recording: Recording) -> bool:
    """Return whether training and evaluation have environments of their own.

    One that was cut off does not state it: then they have if one continues an episode after the other.
    """
    have_own_makers = any(phase.own_maker is not None for phase in recording.phases)
    if have_own_makers or "content_digest" in recording.result:
        return have_own_makers
    if not all(phase.steps.are_known for phase in recording.phases):
        return False
    phase, changes = "", 0
    for piece in pieces(recording, PHASES):
        if len(piece.rows) and piece.phase != phase:
            is_continued = piece.rows["t"][0] > 0 and not any(r.step == piece.first for r in piece.resets)
            if (phase and is_continued) or changes == _PHASE_CHANGES:
                return bool(is_continued)
            phase = piece.phase
            changes += 1
    return False
