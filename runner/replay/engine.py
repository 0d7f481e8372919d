"""One replay of a loop's recording: its environments, its pieces done again one after the other, compared."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.recording import schema
from runner.recording.reader import Recording
from runner.replay.comparing import Difference, differing_rows, differing_value
from runner.replay.makers import make_environment
from runner.replay.recorded import Piece, RecordedReset, pieces
from runner.replay.redone import RedoneStart, RedoneSteps, Values
from runner.replay.stepping import EnvironmentStepper, GameStepper, Results, Stepper

BLOCK_SECONDS: Final = 0.2
"""Blocks of steps take about this long, so that progress and a hanging environment can be seen."""
_MAX_ROWS: Final = 16_384
_MAX_PICTURES: Final = 32
"""The most steps in a block with pictures."""

Report = Callable[[int], None]


class Replay:
    """A replay of a recording, from its beginning or from a reset; runs foreign code in this process.

    Args:
        recording: of a loop.
        trust: whether what the recording names may be imported, see `runner.replay.makers`.
        tolerance: absolute and relative, for floating-point observations and rewards; 0 compares bytes.
        report: called with the number of steps taken so far, after each block.
        render: whether the environments can draw.
        make: returns the environment, instead of making it as the recording describes.
    """

    def __init__(
        self,
        recording: Recording,
        trust: bool,
        tolerance: float,
        report: Report,
        render: bool,
        make: Callable[[], Any] | None = None,
    ) -> None:
        self._recording, self._trust, self._tolerance, self._make = recording, trust, tolerance, make
        self._report, self.render = report, render
        self._steppers: dict[int, Stepper] = {}
        self.known: set[int] = set()
        """The environments whose random generators are in the recorded state."""
        self._max_rows = 1 if render else 256
        self.taken = 0
        """Steps taken so far."""
        self.skipped = 0
        """Steps left out, as the state of the random generators at their beginning is not known."""

    def close(self) -> None:
        """Close the environments."""
        for stepper in self._steppers.values():
            stepper.env.close()

    def all(self) -> Iterator[RedoneSteps]:
        """Yield all steps of both phases in the order of time, up to the first difference."""
        for piece in pieces(self._recording, schema.PHASES):
            for environment in range(self._recording.environments):
                for steps in self.steps(piece, environment, draws=self.render):
                    yield steps
                    if steps.difference is not None:
                        return

    def steps(self, piece: Piece, environment: int, draws: bool) -> Iterator[RedoneSteps]:
        """Yield the steps of one environment in a piece, in blocks, up to the first difference."""
        rows, resets = _own(piece, environment, self._recording.environments)
        begin = 0
        if environment not in self.known:
            known = next((k for k, (_, reset) in enumerate(resets) if reset.is_known), None)
            if known is None:
                self.skipped += len(rows)
                return
            self.known.add(environment)
            begin, resets = resets[known][0], resets[known:]
            self.skipped += begin
        stepper = self._stepper(environment)
        stepper.draws = draws
        if (other := stepper.other_space()) is not None:
            yield self._at_reset(piece, rows[:0], resets[0][1], *other)
            return
        end = begin
        while end < len(rows) or resets:
            begin, end = end, min(end + self._max_rows, len(rows))
            here = [(row - begin, reset) for row, reset in resets if row < end or end == len(rows)]
            resets = resets[len(here) :]
            started = time.monotonic()
            results = stepper.run(rows[begin:end], here)
            self._adapt(time.monotonic() - started, draws)
            self.taken += results.done
            self._report(self.taken)
            steps = self._compared(piece.phase, environment, rows[begin:end], here, results)
            yield steps
            if steps.difference is not None:
                return

    def _adapt(self, seconds: float, draws: bool) -> None:
        """Adapt the size of blocks to the time that one takes."""
        if seconds < BLOCK_SECONDS / 2:
            self._max_rows = min(2 * self._max_rows, _MAX_PICTURES if draws else _MAX_ROWS)
        elif seconds > 2 * BLOCK_SECONDS:
            self._max_rows = max(self._max_rows // 2, 1)

    def _stepper(self, environment: int) -> Stepper:
        if environment not in self._steppers:
            maker = self._recording.maker
            if self._make is not None:
                env = self._make()
            else:
                assert maker is not None  # or `why_not_redone` gave a reason
                env = make_environment(maker, self._trust, self.render)
            kind = GameStepper if maker and maker.kind == "pettingzoo" else EnvironmentStepper
            self._steppers[environment] = kind(env, self._recording)
        return self._steppers[environment]

    # --- comparing ------------------------------------------------------------------------------------

    def _compared(
        self,
        phase: str,
        environment: int,
        rows: NDArray[np.void],
        resets: Sequence[tuple[int, RecordedReset]],
        results: Results,
    ) -> RedoneSteps:
        """Return steps that were done again, up to the first difference."""
        recorded = _recorded_values(rows)
        done, resets_done = results.done, results.resets_done
        place = self._first_row(rows, recorded, results)
        failed_reset = self._first_reset(resets, results)
        if place is not None and (failed_reset is None or resets[failed_reset][0] > place[0]):
            done = place[0] + 1
            difference = self._row_difference(phase, environment, rows, recorded, results, *place)
        elif failed_reset is not None:
            done, reset = resets[failed_reset]
            first = differing_value(
                reset.observation,
                results.first_observations[failed_reset],
                self._recording.spaces["observation"],
                self._tolerance,
            )
            difference = self._difference(
                phase, environment, reset.episode, 0, reset.step, f"first observation{first[0]}", *first[1:]
            )
            resets_done = failed_reset + 1
        elif results.error is not None:
            got = f"{type(results.error).__name__}: {results.error}"
            if resets_done < len(resets) and resets[resets_done][0] == done:
                reset = resets[resets_done][1]
                episode, t, step = reset.episode, 0, reset.step
            else:
                episode, t, step = (int(rows[done][name]) for name in ("episode", "t", "step"))
            difference = self._difference(phase, environment, episode, t, step, "error", None, got)
        else:
            difference = None
        starts = [
            RedoneStart(
                row,
                reset.episode,
                reset.seed,
                reset.observation,
                results.first_observations[k],
                results.first_frames[k] if results.first_frames else None,
            )
            for k, (row, reset) in enumerate(resets[:resets_done])
            if row <= done
        ]
        return RedoneSteps(
            phase=phase,
            environment=environment,
            step=rows["step"][:done].astype(np.int64),
            episode=rows["episode"][:done].astype(np.int64),
            t=rows["t"][:done].astype(np.int64),
            actions=rows["action"][:done],
            recorded=recorded.first(done),
            got=results.values.first(done),
            starts=tuple(starts),
            frames=results.frames[:done],
            difference=difference,
        )

    def _first_row(
        self, rows: NDArray[np.void], recorded: Values, results: Results
    ) -> tuple[int, str] | None:
        """Return the first row that differs, and the first field of it that does; None if none does."""
        done, found = results.done, []
        for name in ("observations", "rewards", "terminated", "truncated"):
            different = differing_rows(
                getattr(recorded, name)[:done], getattr(results, name)[:done], self._tolerance
            )
            if different is not None:
                found.append((int(np.argmax(different)), name))
        for name in ("agents_terminated", "agents_truncated"):
            got = getattr(results, name)[:done]
            if len(got) and (rows[name][:done] != got).any():
                found.append((int(np.argmax(rows[name][:done] != got)), name))
        return min(found, key=lambda place: place[0]) if found else None

    def _first_reset(self, resets: Sequence[tuple[int, RecordedReset]], results: Results) -> int | None:
        """Return the number of the first reset whose observation differs; None if none does."""
        done = results.resets_done
        recorded = np.empty_like(results.first_observations[:done])
        for k, (_, reset) in enumerate(resets[:done]):
            recorded[k] = reset.observation
        different = differing_rows(recorded, results.first_observations[:done], self._tolerance)
        return None if different is None else int(np.argmax(different))

    def _row_difference(
        self,
        phase: str,
        environment: int,
        rows: NDArray[np.void],
        recorded: Values,
        results: Results,
        row: int,
        name: str,
    ) -> Difference:
        """Return the difference in a field of a row."""
        was, got = (
            (rows[name][row], getattr(results, name)[row])
            if name.startswith("agents_")
            else (getattr(recorded, name)[row], getattr(results, name)[row])
        )
        if name == "observations":
            place, was, got = differing_value(
                was, got, self._recording.spaces["observation"], self._tolerance
            )
            field = f"observation{place}"
        elif name == "rewards":
            agent = int(np.argmax(was != got)) if len(was) > 1 else 0
            field = f"reward[{self._recording.agents[agent]!r}]" if len(was) > 1 else "reward"
            was, got = float(was[agent]), float(got[agent])
        else:
            field, was, got = name, was.item(), got.item()
        episode, t, step = (int(rows[row][each]) for each in ("episode", "t", "step"))
        return self._difference(phase, environment, episode, t, step, field, was, got)

    def _difference(
        self,
        phase: str,
        environment: int,
        episode: int,
        t: int,
        step: int,
        field: str,
        recorded: Any,
        got: Any,
    ) -> Difference:
        number: int | None = episode
        if self._recording.environments > 1:
            number = _ended_episode(self._recording, phase, environment, step)
        return Difference(phase, number, t, step, environment, field, recorded, got)

    def _at_reset(
        self,
        piece: Piece,
        no_rows: NDArray[np.void],
        reset: RecordedReset,
        field: str,
        recorded: Any,
        got: Any,
    ) -> RedoneSteps:
        """Return no steps, with a difference at a reset."""
        phase, environment = piece.phase, reset.environment
        nothing = _recorded_values(no_rows) if no_rows.dtype.names else _NOTHING
        difference = self._difference(phase, environment, reset.episode, 0, reset.step, field, recorded, got)
        none = np.empty(0, np.int64)
        return RedoneSteps(
            phase, environment, none, none, none, none, nothing, nothing, difference=difference
        )


_NOTHING: Final = Values(np.empty(0), np.empty((0, 1)), np.empty(0, np.bool_), np.empty(0, np.bool_))


def _own(
    piece: Piece, environment: int, environments: int
) -> tuple[NDArray[np.void], list[tuple[int, RecordedReset]]]:
    """Return the steps of one environment, and its resets with the row that each comes before.

    Steps at which a vector only reset the environment are left out: the reset stands for them.
    """
    rows = piece.rows[environment::environments]
    own = [reset for reset in piece.resets if reset.environment == environment]
    if not len(rows):
        return rows, [(0, reset) for reset in own]
    at = [(reset.step - piece.first) // environments for reset in own]
    if environments > 1:
        taken = rows["t"] != schema.RESET_ONLY
        if not taken.all():
            before = np.concatenate([[0], np.cumsum(taken)])
            at, rows = before[at].tolist(), rows[taken]
    return rows, list(zip(at, own, strict=True))


def _recorded_values(rows: NDArray[np.void]) -> Values:
    names = rows.dtype.names or ()
    observations = rows["next_state" if "next_state" in names else "next_observation"]
    return Values(observations, rows["rewards"], rows["terminated"], rows["truncated"])


def _ended_episode(recording: Recording, phase: str, environment: int, step: int) -> int | None:
    """Return the number of the episode that a step of an environment belongs to; None if it never ended."""
    for block in recording.blocks(recording.topic(f"/{phase}/episode")):
        own = (block["last_step"] >= step) & (block["last_step"] % recording.environments == environment)
        if own.any():
            return int(block["episode"][np.argmax(own)])
    return None
