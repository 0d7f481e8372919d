"""Steps that were rerun, compared with the recorded ones: what differs first, and in which episode."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from runner.errors import CannotRedo
from runner.recording import schema
from runner.recording.actions import EpisodeDigests, after_step
from runner.recording.reader import Recording
from runner.recording.spaces import Value
from runner.replay.differences import Difference, differing_value, first_differing_row
from runner.replay.recorded import RecordedReset, ended_episode
from runner.replay.redone import RedoneStart, RedoneSteps, Values
from runner.replay.stepping import Results

_Place = tuple[int, int, int]
"""Episode, step of the episode, and step of the phase."""


class Part(NamedTuple):
    """Steps of one environment, or of all, and what came of them."""

    phase: str
    environment: int
    rows: NDArray[np.void]
    resets: Sequence[tuple[int, RecordedReset]]
    """Row and reset, in order; each comes before its row."""
    results: Results


def parts_of(whole: Part, n: int) -> Iterator[Part]:
    """Yield the steps of each of the n environments of a vector."""
    for environment in range(n):
        rows = whole.rows[environment::n]
        taken = rows["t"] != schema.RESET_ONLY
        before = np.concatenate([[0], np.cumsum(taken)])
        here = [k for k, (_, reset) in enumerate(whole.resets) if reset.environment == environment]
        resets = [(int(before[whole.resets[k][0]]), whole.resets[k][1]) for k in here]
        yield Part(
            whole.phase, environment, rows[taken], resets, whole.results.part(environment, n, taken, here)
        )


class Comparison:
    """Compares what came of steps with a recording.

    Args:
        tolerance: absolute and relative, for floating-point observations and rewards; 0 compares bytes.
    """

    def __init__(self, recording: Recording, tolerance: float) -> None:
        self._recording, self._tolerance = recording, tolerance
        self._digests = {phase: EpisodeDigests() for phase in schema.PHASES}

    def of(self, part: Part) -> RedoneSteps:
        """Return steps that were rerun, up to the first difference."""
        phase, environment, rows, resets, results = part
        recorded = _recorded_values(rows, results)
        done, resets_done = results.done, results.resets_done
        place = self._first_row(part, recorded)
        failed_reset = self._first_reset(resets, results)
        if place is not None and (failed_reset is None or resets[failed_reset][0] > place[0]):
            done = place[0] + 1
            resets_done = sum(row < done for row, _ in resets[:resets_done])
            difference = self._row_difference(part, recorded, *place)
        elif failed_reset is not None:
            (done, reset), resets_done = resets[failed_reset], failed_reset + 1
            field, *values = self._observation(reset.observation, results.first_observations[failed_reset])
            difference = self._difference(part, _of_reset(reset), f"first {field}", *values)
        elif results.error is not None:
            difference = self._failure(part, results.error)
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
        ]
        return RedoneSteps(
            phase=phase,
            environment=environment,
            step=rows["step"][:done].astype(np.int64),
            episode=rows["episode"][:done].astype(np.int64),
            t=rows["t"][:done].astype(np.int64),
            actions=rows["action"][:done],
            recorded=recorded.part(slice(done)),
            got=results.values.part(slice(done)),
            starts=tuple(starts),
            frames=results.frames[:done],
            difference=difference,
        )

    def _failure(self, part: Part, error: Exception) -> Difference:
        """Return the difference that the environment raised an error where the recorded one did not."""
        _, _, rows, resets, results = part
        got = f"{type(error).__name__}: {error}"
        waiting = resets[results.resets_done :]
        if waiting and (waiting[0][0] <= results.done or results.done >= len(rows)):
            return self._difference(part, _of_reset(waiting[0][1]), "error", None, got)
        if not len(rows):  # another environment of the vector raised it
            raise CannotRedo(f"The vector environment fails: {got}")
        row = rows[min(results.done, len(rows) - 1)]
        return self._difference(part, _of_row(row), "error", None, got)

    def _first_row(self, part: Part, recorded: Values) -> tuple[int, str] | None:
        """Return the first row that differs, and the first field of it that does; None if none does."""
        rows, results = part.rows, part.results
        done, places = results.done, []
        for name in ("observations", "rewards", "terminated", "truncated"):
            was, got = getattr(recorded, name)[:done], getattr(results, name)[:done]
            if (row := first_differing_row(was, got, self._tolerance)) is not None:
                places.append((row, name))
        for name in ("agents_terminated", "agents_truncated"):
            got = getattr(results, name)[:done]
            if len(got) and (rows[name][:done] != got).any():
                places.append((int(np.argmax(rows[name][:done] != got)), name))
        if (wrong := self._first_digest(part)) is not None:
            places.append((wrong, "digest"))
        return min(places, key=lambda place: place[0]) if places else None

    def _first_digest(self, part: Part) -> int | None:
        """Return the first row at which the episode so far has another digest than was recorded."""
        phase, environment, rows, _, results = part
        done, got = results.done, results.values
        if not done or "digest" not in (rows.dtype.names or ()):
            return None
        outcomes = got.observations[:done], got.rewards[:done], got.terminated[:done], got.truncated[:done]
        recorded = np.ascontiguousarray(rows["digest"][:done])
        marked = set(np.flatnonzero(recorded.view(np.uint8).reshape(done, -1).any(axis=1)).tolist())
        digests = self._digests[phase]
        for row, digest in digests.add(environment, rows["t"][:done], *outcomes, marked):
            if row in marked and digest != recorded[row].tobytes():
                return row
        return None

    def _first_reset(self, resets: Sequence[tuple[int, RecordedReset]], results: Results) -> int | None:
        """Return the number of the first reset whose observation differs; None if none does."""
        done = results.resets_done
        recorded = np.empty_like(results.first_observations[:done])
        for k, (_, reset) in enumerate(resets[:done]):
            recorded[k] = reset.observation
        return first_differing_row(recorded, results.first_observations[:done], self._tolerance)

    def _row_difference(self, part: Part, recorded: Values, row: int, name: str) -> Difference:
        rows, results = part.rows, part.results
        place = _of_row(rows[row])
        if name == "digest":
            was = rows[row]["digest"].tobytes().hex()
            return self._difference(part, place, "digest of the episode so far", was, "another one")
        was = rows[name][row] if name.startswith("agents_") else getattr(recorded, name)[row]
        got = getattr(results, name)[row]
        if name == "observations":
            name, was, got = self._observation(was, got)
        elif name == "rewards":
            agent = int(np.argmax(was != got)) if len(was) > 1 else 0
            name = f"reward[{self._recording.agents[agent]!r}]" if len(was) > 1 else "reward"
            was, got = float(was[agent]), float(got[agent])
        else:
            was, got = was.item(), got.item()
        return self._difference(part, place, name, was, got)

    def _observation(self, recorded: Value, got: Value) -> tuple[str, object, object]:
        """Return the first differing part of two observations, such as `observation[2]`, and its values."""
        space = self._recording.spaces["observation"]
        place, recorded, got = differing_value(recorded, got, space, self._tolerance)
        return f"observation{place}", recorded, got

    def _difference(self, part: Part, place: _Place, field: str, recorded: object, got: object) -> Difference:
        episode, t, step = place
        number: int | None = episode
        if self._recording.environments > 1:
            number = ended_episode(self._recording, part.phase, part.environment, step)
        return Difference(part.phase, number, t, step, part.environment, field, recorded, got)


def _of_row(row: np.void) -> _Place:
    return int(row["episode"]), int(row["t"]), int(row["step"])


def _of_reset(reset: RecordedReset) -> _Place:
    return reset.episode, 0, reset.step


def _recorded_values(rows: NDArray[np.void], results: Results) -> Values:
    """Return what was recorded of steps; of observations and rewards without a record what came of them."""
    names = rows.dtype.names or ()
    if "rewards" not in names:
        got = results.values
        return Values(got.observations, got.rewards, rows["terminated"], rows["truncated"])
    return Values(rows[after_step(rows.dtype)], rows["rewards"], rows["terminated"], rows["truncated"])
