"""A loop's recording rerun: its environments take the recorded actions, and what they return is compared."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import dropwhile
from typing import Final, Self

import numpy as np

from runner.environments.interfaces import as_parallel, is_game
from runner.errors import CannotRedo, shortened
from runner.recording import schema
from runner.recording.reader import Recording
from runner.recording.spaces import Value, decode
from runner.recording.steps import EpisodeDigests, after_step, is_of_environment
from runner.replay.makers import ALL, environments_of, make_environment, make_vector, using, why_not_made
from runner.replay.recorded import (
    Piece,
    RecordedReset,
    are_separate,
    ended_episode,
    last_step_time,
    pieces,
)
from runner.replay.steppers import Frame, GameStepper, PlacedReset, Returned, Start, Stepper, VectorStepper
from runner.replay.trust import require_plain, trusting
from runner.util.arrays import Ints, Records
from runner.util.differences import differing_part, first_difference, first_differing_row
from runner.util.processes import Report

BLOCK_SECONDS: Final = 0.2
"""Blocks of steps take about this long, so that progress and a hanging environment can be seen."""
_MAX_ROWS: Final = 16_384
_MAX_PICTURES: Final = 32
"""The most steps in a block with pictures."""
_MAX_PICTURE_BYTES: Final = 8 << 20
"""The most bytes of the pictures in a block of several steps."""
_MAX_TEXT: Final = 200
_Key = tuple[str, int]
"""Phase and number of an environment; without the phase where training and evaluation share it."""


@dataclass(frozen=True)
class Difference:
    """The first value in which an environment differs from a recording."""

    phase: str
    """`train` or `eval`."""
    episode: int | None
    """The number of the episode; None if it never ended, in one of several environments."""
    t: int
    """The step of the episode, from 0."""
    step: int
    """The step of the phase, from 0."""
    environment: int
    """Which environment of a vector."""
    field: str
    """`observation[2]`, `reward`, `terminated`, ...; `first observation[2]` after a reset."""
    recorded: object
    """The value, as JSON can hold it."""
    got: object

    def __str__(self) -> str:
        """Describe the difference in a line."""
        episode = f"episode {self.episode:,}" if self.episode is not None else f"step {self.step:,}"
        return (
            f"{self.phase} {episode}, t {self.t:,}: {self.field}: recorded {_short(self.recorded)}, "
            f"got {_short(self.got)}"
        )


@dataclass(frozen=True, eq=False)
class RerunSteps:
    """Consecutive steps of one environment, rerun; of one or more episodes."""

    phase: str
    environment: int
    """Which environment of a vector; 0 for a single one."""
    recorded: Records
    """The recorded steps, as `Steps.rows` yields them; each environment of a vector counts its episodes."""
    got: Records
    """What the environment returned: the fields `next_state` or `next_observation`, `rewards`, `terminated`,
    `truncated`, and of games `agents_terminated` and `agents_truncated`, each as in a recording."""
    starts: Sequence[Start] = ()
    """The resets in the block, in order."""
    frames: Sequence[Frame] = ()
    """The picture after each step, if pictures are drawn."""
    difference: Difference | None = None
    """The first difference, in the last row, or at the reset after it; the last block has it, if any has."""

    def __len__(self) -> int:
        return len(self.recorded)

    def require_equal(self) -> Self:
        """Return these steps.

        Raises:
            CannotRedo: they differ from the recorded ones.
        """
        if self.difference is not None:
            raise CannotRedo(f"The environment is not the recorded one: {self.difference}.")
        return self


class Rerun:
    """A rerun of a recording, from its beginning or from a reset; runs foreign code in this process.

    Args:
        trust: whether what the recording names may be imported, see `runner.replay.trust`.
        tolerance: absolute and relative, for floating-point observations and rewards; 0 compares bytes.
        make: returns the environment, instead of making it as the recording describes.
    """

    def __init__(
        self,
        recording: Recording,
        trust: bool = False,
        tolerance: float = 0.0,
        report: Report = lambda _: None,
        render: bool = False,
        make: Callable[[], object] | None = None,
        draw_from: int = 0,
    ) -> None:
        self.draw_from = draw_from
        """The number of the first step after which pictures are drawn."""
        self.drawn = 0
        """The environment that is drawn, of a vector that is stepped as a whole."""
        self._recording = recording
        self._trust = trust
        self._make = make
        self._tolerance = tolerance or None
        self._digests = {phase: EpisodeDigests() for phase in schema.PHASES}
        self._report = report
        self.render = render
        self._last_step_time = last_step_time(recording)
        """When the steps end that were recorded: later resets came after steps that were lost."""
        self._steppers: dict[_Key, Stepper] = {}
        self._known: set[_Key] = set()
        """The environments whose random generators are in the recorded state."""
        self._is_separate = are_separate(recording)
        """Whether training and evaluation have environments of their own."""
        self.environments = environments_of(recording)
        self._max_rows = 1 if render else 256
        self.taken = 0
        """Steps taken so far."""
        self.skipped = 0
        """Steps left out, as the state of the random generators at their beginning is not known."""

    def close(self) -> None:
        """Close the environments; what they raise then changes no result."""
        for stepper in self._steppers.values():
            with contextlib.suppress(Exception):
                stepper.env.close()

    def all(self) -> Iterator[RerunSteps]:
        """Yield all steps of both phases in the order of time, up to the first difference."""
        for piece in pieces(self._recording, schema.PHASES):
            for environment in self.environments:
                for steps in self.steps(piece, environment, draws=self.render):
                    yield steps
                    if steps.difference is not None:
                        return

    def steps(
        self, piece: Piece, environment: int, draws: bool, start: RecordedReset | None = None
    ) -> Iterator[RerunSteps]:
        """Yield the steps of one environment in a piece, in blocks, up to the first difference.

        Args:
            environment: one of `environments`; `ALL` yields the steps of each in turn.
            start: where to begin if it was not rerun before; None for the first reset that is known.
        """
        phase = piece.phase
        n = self._recording.environments if environment == ALL else 1
        rows, resets = self.recorded_steps(piece, environment)
        begin = 0
        if not self.is_known(phase, environment):
            resets = list(dropwhile(lambda placed: not placed[1].may_begin(start), resets))
            if not resets:
                self.skipped += len(rows)
                return
            self._known.add(self._key(phase, environment))
            begin = resets[0][0]
            self.skipped += begin * n
        stepper = self.stepper(phase, environment)
        stop = len(rows) // n
        drawn = (
            int(np.searchsorted(rows["step"].astype(np.int64), self.draw_from)) // n if draws else stop + 1
        )
        stepper.draws = False
        end = begin
        while end < stop or resets:
            if end >= drawn and not stepper.draws:
                stepper.draws, self._max_rows = True, 1  # the first picture is to come at once
            begin, end = end, min(end + max(self._max_rows // n, 1), stop)
            if begin < drawn < end:
                end = drawn
            block = rows[begin * n : end * n]
            here = [(row - begin, reset) for row, reset in resets if row < end or end == stop]
            resets = resets[len(here) :]
            if not stepper.is_trusted:
                for _, reset in here:
                    require_plain("option of a reset,", reset.given.options or {}, {})
            started = time.monotonic()
            returned = stepper.run(block, here)
            self._adapt(time.monotonic() - started, returned.frames if stepper.draws else None)
            self.taken += returned.done
            self._report(self.taken)
            for number in range(n) if environment == ALL else [environment]:
                part = self._part(returned, number) if environment == ALL else returned
                steps = self._compared(phase, number, part)
                yield steps
                if steps.difference is not None:
                    return

    def recorded_steps(self, piece: Piece, environment: int) -> tuple[Records, list[PlacedReset]]:
        """Return the steps of one environment, or of `ALL`, and its resets with the step that each precedes.

        Steps at which a vector only reset the environment are left out: the reset stands for them.
        """
        n = self._recording.environments
        rows = piece.rows
        first = piece.first
        resets = [
            reset
            for reset in piece.resets
            if environment in (ALL, reset.environment) and reset.time <= self._last_step_time
        ]
        if environment == ALL:
            return rows, [((reset.step - first) // n, reset) for reset in resets]
        index, places = _of_environment(rows, [reset.step - first for reset in resets], environment)
        return rows if len(index) == len(rows) else rows[index], list(zip(places, resets, strict=True))

    def _part(self, whole: Returned, environment: int) -> Returned:
        """Return the part of one environment of what came of all."""
        n = self._recording.environments
        resets = [placed for placed in whole.resets if placed[1].environment == environment]
        starts = [start for start in whole.starts if start.reset.environment == environment]
        index, places = _of_environment(whole.rows, [n * step for step, _ in resets], environment)
        done = int(np.searchsorted(index, whole.done))
        pictures = index[:done].tolist() if environment == self.drawn and whole.frames else ()
        return Returned(
            whole.rows[index],
            [(row, reset) for row, (_, reset) in zip(places, resets, strict=True)],
            whole.got[index],
            [start._replace(row=row) for row, start in zip(places, starts, strict=False)],
            [whole.frames[row // n] for row in pictures],
            done,
            whole.error,
        )

    def is_known(self, phase: str, environment: int) -> bool:
        """Return whether an environment's random generators are in the recorded state."""
        return self._key(phase, environment) in self._known

    def _key(self, phase: str, environment: int) -> _Key:
        """Return a key of an environment, the same for both phases if both use it."""
        return (phase if self._is_separate else "", environment)

    def _adapt(self, seconds: float, frames: Sequence[Frame] | None) -> None:
        """Adapt the size of blocks to the time that one takes, and to its pictures if it has any."""
        if seconds < BLOCK_SECONDS / 2:
            limit = _MAX_ROWS
            if frames is not None:
                size = max((frame.nbytes for frame in frames), default=0)
                limit = min(_MAX_PICTURES, max(_MAX_PICTURE_BYTES // size, 1) if size else 1)
            self._max_rows = min(2 * self._max_rows, limit)
        elif seconds > 2 * BLOCK_SECONDS:
            self._max_rows = max(self._max_rows // 2, 1)

    def stepper(self, phase: str, environment: int) -> Stepper:
        """Return an environment, made when it is first needed.

        Raises:
            CannotRedo: it cannot be made, or has other spaces.
        """
        key = self._key(phase, environment)
        maker = self._recording.phase(phase).maker_of(environment)
        if key in self._steppers:
            return self._steppers[key]
        if self._make is not None:
            env, is_trusted = self._make(), True
        elif maker is None:
            raise CannotRedo(why_not_made(maker, self._trust))
        else:
            with trusting(self._recording.path, maker, self._trust) as is_trusted:
                make = make_vector if environment == ALL else make_environment
                env = make(maker, is_trusted, self.render)
        with using("The environment cannot be used"):
            vector = None if maker is None else maker.vector
            if environment == ALL and vector is not None:
                stepper: Stepper = VectorStepper(env, self._recording, vector.autoreset, self.drawn)
            elif is_game(env):
                stepper = GameStepper(as_parallel(env), self._recording)
            else:
                stepper = Stepper(env, self._recording)
                stepper.ends_once = vector is not None and vector.is_vec_env
            stepper.is_trusted = is_trusted
        self._steppers[key] = stepper
        return stepper

    def _compared(self, phase: str, environment: int, returned: Returned) -> RerunSteps:
        """Return the steps of an environment up to the first difference."""
        rows, got, starts, done = returned.rows, returned.got, returned.starts, returned.done
        names = [name for name in got.dtype.names or () if name in (rows.dtype.names or ())]
        first = first_difference(rows[:done], got[:done], names, self._tolerance)
        digest = self._first_digest(phase, environment, rows[:done], got[:done])
        if digest is not None and (first is None or digest < first[0]):
            first = digest, "digest"
        failed = self._first_start(starts)
        differing = None
        if first is not None and (failed is None or starts[failed].row > first[0]):
            row, name = first
            done = row + 1
            starts = [start for start in starts if start.row <= row]
            differing = _place_of(rows[row]), self._values(name, rows[row], got[row])
        elif failed is not None:
            done = starts[failed].row
            starts = starts[: failed + 1]
            _, reset, value, _ = starts[failed]
            part, was, now = self._observation(reset.observation, value)
            differing = (reset.episode, 0, reset.step), (f"first {part}", was, now)
        elif returned.error is not None:
            text = f"{type(returned.error).__name__}: {returned.error}"
            differing = _failed_at(returned, text), ("error", None, text)
        difference = None
        if differing is not None:
            (episode, t, step), values = differing
            number: int | None = episode
            if self._recording.environments > 1:
                number = ended_episode(self._recording, phase, environment, step)
            difference = Difference(phase, number, t, step, environment, *values)
        frames = returned.frames[:done]
        return RerunSteps(phase, environment, rows[:done], got[:done], starts, frames, difference)

    def _first_start(self, starts: Sequence[Start]) -> int | None:
        """Return the number of the first reset with another observation; None if all are equal."""
        if not starts:
            return None
        values = np.empty((2, len(starts)), self._recording.train.resets.row_dtype["observation"])
        for k, start in enumerate(starts):
            values[0, k] = start.reset.observation
            values[1, k] = start.got
        return first_differing_row(values[0], values[1], self._tolerance)

    def _first_digest(self, phase: str, environment: int, rows: Records, got: Records) -> int | None:
        """Return the first row at which the episode so far has another digest than was recorded."""
        if not len(rows) or "digest" not in (rows.dtype.names or ()):
            return None
        after = got[after_step(got.dtype)]
        t = rows["t"]
        recorded = np.ascontiguousarray(rows["digest"])
        marked = set(np.flatnonzero(recorded.view(np.uint8).reshape(len(rows), -1).any(axis=1)).tolist())
        ends = got["terminated"], got["truncated"]
        digests = self._digests[phase].add(environment, t, after, got["rewards"], *ends, marked)
        wrong = (row for row, digest in digests if row in marked and digest != recorded[row].tobytes())
        return next(wrong, None)

    def _values(self, name: str, recorded: np.void, got: np.void) -> tuple[str, object, object]:
        """Return a field that differs, such as `observation[2]`, and its values."""
        if name == "digest":
            return "digest of the episode so far", recorded[name].tobytes().hex(), "another one"
        if name == after_step(got.dtype):
            return self._observation(recorded[name], got[name])
        if name != "rewards":
            return name, recorded[name].item(), got[name].item()
        agents = self._recording.agents
        paid, pays = (dict(zip(agents, row[name], strict=True)) for row in (recorded, got))
        agent, was, now = differing_part(paid, pays, self._tolerance)
        return f"reward{agent if len(agents) > 1 else ''}", was, now

    def _observation(self, recorded: Value, got: Value) -> tuple[str, object, object]:
        if isinstance(recorded, bytes):
            space = self._recording.spaces["observation"]
            recorded, got = (decode(space, data, "an observation") for data in (recorded, got))
        path, was, now = differing_part(recorded, got, self._tolerance)
        return f"observation{path}", was, now


def _of_environment(rows: Records, places: Sequence[int], environment: int) -> tuple[Ints, list[int]]:
    """Return which of the rows of all environments are steps that one took, and places among these.

    Args:
        places: numbers of rows.
    """
    index = np.flatnonzero(is_of_environment(rows, environment))
    return index, np.searchsorted(index, places).tolist()


def _place_of(row: np.void) -> tuple[int, int, int]:
    """Return episode, step of the episode, and step of the phase."""
    return int(row["episode"]), int(row["t"]), int(row["step"])


def _failed_at(returned: Returned, text: str) -> tuple[int, int, int]:
    """Return where an environment raised an error: in the first row or reset that it did not return from."""
    rows = returned.rows
    done = returned.done
    waiting = returned.resets[len(returned.starts) :]
    if waiting and (waiting[0][0] <= done or done >= len(rows)):
        _, reset = waiting[0]
        return reset.episode, 0, reset.step
    if not len(rows):  # another environment of the vector raised it
        raise CannotRedo(f"The vector environment fails: {text}")
    return _place_of(rows[min(done, len(rows) - 1)])


def _short(value: object) -> str:
    text = repr(value) if isinstance(value, str) else str(value)
    return shortened(text, _MAX_TEXT)
