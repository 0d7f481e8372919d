"""A loop's recording rerun: its environments take the recorded pieces, and their steps are compared."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import dropwhile
from typing import Any, Final, Self

import numpy as np

from runner.environments.games import as_parallel, is_game
from runner.errors import CannotRedo, shortened
from runner.recording import schema
from runner.recording.actions import EpisodeDigests, after_step
from runner.recording.description import environment_count
from runner.recording.maker import EnvironmentMaker
from runner.recording.reader import Recording
from runner.recording.spaces import Description, Value, decode
from runner.recording.topic_chunks import FOREVER
from runner.recording.turns import is_of_environment
from runner.replay.makers import is_whole_vector, make_environment, make_vector, using, why_not_made
from runner.replay.recorded import Piece, RecordedReset, ended_episode, pieces
from runner.replay.stepping import (
    Frame,
    GameStepper,
    PlacedReset,
    Returned,
    Start,
    Stepper,
    VectorStepper,
)
from runner.replay.trust import require_plain, trusting
from runner.util.arrays import Array, Ints, Records
from runner.util.differences import first_difference, first_differing_row
from runner.util.jsonable import as_json
from runner.util.processes import Report

BLOCK_SECONDS: Final = 0.2
"""Blocks of steps take about this long, so that progress and a hanging environment can be seen."""
_MAX_ROWS: Final = 16_384
_PHASE_CHANGES: Final = 100
"""How many changes of the phase are looked at to find out whether both are of one environment."""
_MAX_PICTURES: Final = 32
"""The most steps in a block with pictures."""
_MAX_PICTURE_BYTES: Final = 8 << 20
"""The most bytes of the pictures in a block of several steps."""

ALL: Final = -1
"""The number that stands for all environments of a vector."""
_MAX_TEXT: Final = 200
_Key = tuple[str, int]
_Steps = tuple[Records, list[PlacedReset]]


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


class Replay:
    """A replay of a recording, from its beginning or from a reset; runs foreign code in this process.

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
        self._recording, self._trust, self._make = recording, trust, make
        self._comparison = RerunComparison(recording, tolerance)
        self._report, self.render = report, render
        self._last_step_time = _last_step_time(recording)
        """When the steps end that were recorded: later resets came after steps that were lost."""
        self._steppers: dict[_Key, Stepper] = {}
        self._known: set[_Key] = set()
        """The environments whose random generators are in the recorded state."""
        self._is_separate = _are_separate(recording)
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
        phase, n = piece.phase, self._recording.environments if environment == ALL else 1
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
        stepper.draws, end = False, begin
        while end < stop or resets:
            if end >= drawn and not stepper.draws:
                stepper.draws, self._max_rows = True, 1  # the first picture is to come at once
            begin, end = end, min(end + max(self._max_rows // n, 1), stop)
            if begin < drawn < end:
                end = drawn
            block = rows[begin * n : end * n]
            here = [(row - begin, reset) for row, reset in resets if row < end or end == stop]
            resets = resets[len(here) :]
            for _, reset in () if stepper.is_trusted else here:
                require_plain("option of a reset,", reset.given.options or {}, {})
            started = time.monotonic()
            returned = stepper.run(block, here)
            self._adapt(time.monotonic() - started, returned.frames if stepper.draws else None)
            self.taken += returned.done
            self._report(self.taken)
            for number in range(n) if environment == ALL else [environment]:
                part = self._part(returned, number) if environment == ALL else returned
                steps = self._comparison.of(phase, number, part)
                yield steps
                if steps.difference is not None:
                    return

    def recorded_steps(self, piece: Piece, environment: int) -> _Steps:
        """Return the steps of one environment, or of `ALL`, and its resets with the step that each precedes.

        Steps at which a vector only reset the environment are left out: the reset stands for them.
        """
        n, rows, first = self._recording.environments, piece.rows, piece.first
        resets = [reset for reset in piece.resets if environment in (ALL, reset.environment)]
        resets = [reset for reset in resets if reset.time <= self._last_step_time]
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
            [Start(row, *start[1:]) for row, start in zip(places, starts, strict=False)],
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
        key, maker = self._key(phase, environment), self._recording.phase(phase).maker_of(environment)
        if key in self._steppers:
            return self._steppers[key]
        env, is_trusted = self._environment(maker, environment)
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

    def _environment(self, maker: EnvironmentMaker | None, environment: int) -> tuple[object, bool]:
        """Return an environment, and whether it may get all that is recorded."""
        if self._make is not None:
            return self._make(), True
        if maker is None:
            raise CannotRedo(why_not_made(maker, self._trust))
        with trusting(self._recording.path, maker, self._trust) as trust:
            make = make_vector if environment == ALL else make_environment
            return make(maker, trust, self.render), trust


def environments_of(recording: Recording) -> Sequence[int]:
    """Return the environments that can be stepped alone; `ALL` where only the whole vector can be."""
    makers = (recording.phase(phase).maker_of() for phase in schema.PHASES)
    if not recording.shards and any(maker is not None and is_whole_vector(maker) for maker in makers):
        return [ALL]
    return range(environment_count(recording))


def _last_step_time(recording: Recording) -> int:
    """Return the `log_time` of the last step in a recording that was cut: later resets lost their steps."""
    tables = [phase.steps for phase in recording.phases]
    if "content_digest" in recording.result or any(steps.are_actions for steps in tables):
        return FOREVER
    return max((steps.entry(len(steps) - 1).end_time for steps in tables if steps), default=0)


def _are_separate(recording: Recording) -> bool:
    """Return whether training and evaluation have environments of their own.

    One that was cut off does not state it: then they have if one continues an episode after the other.
    """
    have_own_makers = any(phase.own_maker is not None for phase in recording.phases)
    if have_own_makers or "content_digest" in recording.result:
        return have_own_makers
    if not all(phase.steps.are_known for phase in recording.phases):
        return False
    phase, changes = "", 0
    for piece in pieces(recording, schema.PHASES):
        if len(piece.rows) and piece.phase != phase:
            is_continued = piece.rows["t"][0] > 0 and not any(r.step == piece.first for r in piece.resets)
            if (phase and is_continued) or changes == _PHASE_CHANGES:
                return bool(is_continued)
            phase, changes = piece.phase, changes + 1
    return False


def _of_environment(rows: Records, places: Sequence[int], environment: int) -> tuple[Ints, list[int]]:
    """Return which of the rows of all environments are steps that one took, and places among these.

    Args:
        places: numbers of rows.
    """
    index = np.flatnonzero(is_of_environment(rows, environment))
    return index, np.searchsorted(index, places).tolist()


# --- compared with the recording ----------------------------------------------------------------------


class RerunComparison:
    """Compares rerun steps with a recording.

    Args:
        tolerance: absolute and relative, for floating-point observations and rewards; 0 compares bytes.
    """

    def __init__(self, recording: Recording, tolerance: float) -> None:
        self._recording, self._tolerance = recording, tolerance or None
        self._digests = {phase: EpisodeDigests() for phase in schema.PHASES}

    def of(self, phase: str, environment: int, returned: Returned) -> RerunSteps:
        """Return the steps of an environment up to the first difference."""
        rows, got, starts, done = returned.rows, returned.got, returned.starts, returned.done
        first = self._first_row(phase, environment, rows[:done], got[:done])
        failed, differing = self._first_start(starts), None
        if first is not None and (failed is None or starts[failed].row > first[0]):
            row, name = first
            done, starts = row + 1, [start for start in starts if start.row <= row]
            differing = _place_of(rows[row]), self._values(name, rows[row], got[row])
        elif failed is not None:
            done, starts = starts[failed].row, starts[: failed + 1]
            _, reset, value, _ = starts[failed]
            field, was, now = self._observation(reset.observation, value)
            differing = _place_of_reset(reset), (f"first {field}", was, now)
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

    def _first_row(self, phase: str, environment: int, rows: Records, got: Records) -> tuple[int, str] | None:
        """Return the first row that differs, and its first field that does; None if none does."""
        names = [name for name in got.dtype.names or () if name in (rows.dtype.names or ())]
        first = first_difference(rows, got, names, self._tolerance)
        digest = self._first_digest(phase, environment, rows, got)
        return (digest, "digest") if digest is not None and (first is None or digest < first[0]) else first

    def _first_start(self, starts: Sequence[Start]) -> int | None:
        """Return the number of the first reset with another observation; None if all are equal."""
        if not starts:
            return None
        values = np.empty((2, len(starts)), self._recording.train.resets.row_dtype["observation"])
        for k, start in enumerate(starts):
            values[0, k], values[1, k] = start.reset.observation, start.got
        return first_differing_row(values[0], values[1], self._tolerance)

    def _first_digest(self, phase: str, environment: int, rows: Records, got: Records) -> int | None:
        """Return the first row at which the episode so far has another digest than was recorded."""
        if not len(rows) or "digest" not in (rows.dtype.names or ()):
            return None
        after, t = got[after_step(got.dtype)], rows["t"]
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
        agent, was, now = differing_value(paid, pays, {}, self._tolerance)
        return f"reward{agent if len(agents) > 1 else ''}", was, now

    def _observation(self, recorded: Value, got: Value) -> tuple[str, object, object]:
        space = self._recording.spaces["observation"]
        path, recorded, got = differing_value(recorded, got, space, self._tolerance)
        return f"observation{path}", recorded, got


def _place_of(row: np.void) -> tuple[int, int, int]:
    """Return episode, step of the episode, and step of the phase."""
    return int(row["episode"]), int(row["t"]), int(row["step"])


def _place_of_reset(reset: RecordedReset) -> tuple[int, int, int]:
    return reset.episode, 0, reset.step


def _failed_at(returned: Returned, text: str) -> tuple[int, int, int]:
    """Return where an environment raised an error: in the first row or reset that it did not return from."""
    rows, done, waiting = returned.rows, returned.done, returned.resets[len(returned.starts) :]
    if waiting and (waiting[0][0] <= done or done >= len(rows)):
        return _place_of_reset(waiting[0][1])
    if not len(rows):  # another environment of the vector raised it
        raise CannotRedo(f"The vector environment fails: {text}")
    return _place_of(rows[min(done, len(rows) - 1)])


def differing_value(
    recorded: Value, got: Value, description: Description, tolerance: float | None = None
) -> tuple[str, object, object]:
    """Return where in two observations the first difference is, such as `[2]`, and both values there.

    Args:
        recorded: a NumPy value of a space, or its bytes.
    """
    if isinstance(recorded, bytes):
        recorded, got = (decode(description, data, "an observation") for data in (recorded, got))
    for path, left, right in _leaves("", recorded, got):
        if left.shape != right.shape or left.dtype != right.dtype:
            return path, _plain(left), _plain(right)
        first = first_differing_row(left.reshape(-1), right.reshape(-1), tolerance)
        if first is not None:
            at = np.unravel_index(first, left.shape)
            index = f"[{', '.join(map(str, at))}]" if at else ""
            return path + index, _plain(left[at]), _plain(right[at])
    return "", _plain(recorded), _plain(got)


def _leaves(path: str, recorded: Value, got: Value) -> Iterator[tuple[str, Array, Array]]:
    """Yield the arrays in two values of a space, with their paths."""
    names: Any = getattr(getattr(recorded, "dtype", None), "names", None)
    if names or isinstance(recorded, dict):
        for name in names or recorded:
            yield from _leaves(f"{path}[{name!r}]", recorded[name], got[name])
    elif isinstance(recorded, tuple):
        for i, (left, right) in enumerate(zip(recorded, got, strict=True)):
            yield from _leaves(f"{path}[{i}]", left, right)
    else:
        yield path, np.asarray(recorded), np.asarray(got)


def _plain(value: object) -> object:
    return as_json(value.item() if isinstance(value, np.ndarray | np.generic) and not value.shape else value)


def _short(value: object) -> str:
    text = repr(value) if isinstance(value, str) else str(value)
    return shortened(text, _MAX_TEXT)
