"""The episodes of somebody's own loop as Minari has them: observations as they were, the first of a reset.

Steps are read a block at a time, and split by environment and episode; an episode is given when it is over.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.reader import Recording

MAX_EPISODE_BYTES: Final = 1 << 30
"""The most that one episode may take: Minari wants it whole."""


@dataclass(frozen=True)
class Episode:
    """An episode that ended, as the arrays of Minari; nested as the spaces are."""

    observations: Any
    """T + 1 of them."""
    actions: Any
    rewards: NDArray[np.float64]
    """[T, agents]."""
    acted: NDArray[np.uint32]
    """[T]: bit i, whether agent i took part."""
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    seed: int | None
    """That of its reset, if it was given one."""

    @property
    def abandoned(self) -> bool:
        """Whether it was reset before its end."""
        return not (self.terminated[-1] or self.truncated[-1])


def loop_episodes(
    recording: Recording, phase: str, ranges: Sequence[tuple[int, int | None]]
) -> Iterator[Episode]:
    """Yield the episodes of a phase that ended, as they are numbered, or those in some ranges.

    An episode that a repair took steps or the observation of its reset from is left out.

    Raises:
        RecordingError: one is too large, or the recording is damaged.
    """
    lengths = _ended(recording, phase, ranges)
    if not lengths:
        return
    began = _Began(recording, phase)
    find = _variable if recording.kind == "variable" else _fixed
    for environment, steps in find(recording, phase, lengths):
        first, last = int(steps[0]["step"]), int(steps[-1]["step"])
        seed, seen = began.at(environment, int(steps[0]["episode"]), first)
        began.note(environment, steps[-1])
        if lengths.get(last) == len(steps) and (made := _episode(recording, steps, seen, seed)) is not None:
            yield made


def _ended(recording: Recording, phase: str, ranges: Sequence[tuple[int, int | None]]) -> dict[int, int]:
    """Return the lengths of the episodes that ended in these ranges, by the number of their last step."""
    topic = recording.topic(f"/{phase}/episode")
    found: dict[int, int] = {}
    for start, stop in ranges:
        for block in recording.blocks(topic, start, stop):
            found |= zip(block["last_step"].tolist(), block["length"].tolist(), strict=True)
    return found


class _Began:
    """With what each episode began: the seed of its reset, and the observation."""

    def __init__(self, recording: Recording, phase: str) -> None:
        self._kept = recording.kind != "step"
        self._resets = recording.resets(phase)
        self._next = next(self._resets, None)
        self._known: dict[tuple[int, int], tuple[int | None, Any]] = {}
        self._last: dict[int, Any] = {}

    def at(self, environment: int, episode: int, step: int) -> tuple[int | None, Any]:
        """Return seed and observation of the reset before an episode, else what was observed last there."""
        while self._next is not None and int(self._next["step"]) <= step:
            reset = self._next
            self._known[int(reset["environment"]), int(reset["episode"])] = (
                int(reset["seed"]) if reset["seeded"] else None,
                _own(reset["observation"]),
            )
            self._next = next(self._resets, None)
        return self._known.pop((environment, episode), (None, self._last.get(environment)))

    def note(self, environment: int, step: Any) -> None:
        """Say what was observed last in an environment: an episode may go on after its end."""
        if self._kept:
            self._last[environment] = _own(step["next_observation"])


def _own(value: Any) -> Any:
    """Return a value that does not keep the block it stands in."""
    return value.copy() if isinstance(value, np.ndarray | np.void) else value


def _fixed(
    recording: Recording, phase: str, lengths: Mapping[int, int]
) -> Iterator[tuple[int, NDArray[np.void]]]:
    """Yield environment and steps of each episode, of steps of one size; the last ones may not have ended."""
    topic, n = recording.topic(f"/{phase}/step"), recording.environments
    first = max(min(last - (length - 1) * n for last, length in lengths.items()), 0)
    rest: dict[int, list[NDArray[np.void]]] = {}
    for block in recording.blocks(topic, first, max(lengths) + 1):
        over: list[tuple[int, NDArray[np.void]]] = []
        for environment in range(n):
            rows = block[(environment - int(block["step"][0])) % n :: n]
            rows = rows[rows["t"] != schema.NEVER] if n > 1 else rows
            for piece in np.split(rows, np.flatnonzero(np.diff(rows["episode"])) + 1):
                over += _grown(recording, rest.setdefault(environment, []), piece, environment)
        yield from sorted(over, key=lambda found: int(found[1]["step"][-1]))
    yield from ((environment, np.concatenate(pieces)) for environment, pieces in rest.items() if pieces)


def _grown(
    recording: Recording, pieces: list[NDArray[np.void]], piece: NDArray[np.void], environment: int
) -> Iterator[tuple[int, NDArray[np.void]]]:
    """Add steps to those of the episode under way; yield it if they are another's, or end it."""
    if not len(piece):
        return
    if pieces and pieces[-1]["episode"][-1] != piece["episode"][0]:
        yield environment, np.concatenate(pieces)
        pieces.clear()
    pieces.append(piece.copy())
    if sum(part.nbytes for part in pieces) > MAX_EPISODE_BYTES:
        raise RecordingError(
            f"{recording.path}: episode {piece['episode'][0]} has more than {MAX_EPISODE_BYTES:,} bytes, "
            "which Minari would hold at once; choose others by --episodes, or export parquet."
        )
    if piece["terminated"][-1] or piece["truncated"][-1]:
        yield environment, np.concatenate(pieces)
        pieces.clear()


def _variable(
    recording: Recording, phase: str, lengths: Mapping[int, int]
) -> Iterator[tuple[int, list[dict[str, Any]]]]:
    """Yield the steps of each episode where values vary in size; there is one environment."""
    for _, steps in groupby(recording.transitions(phase), key=lambda step: step["episode"]):
        found = list(steps)
        yield 0, found
        if found[-1]["step"] >= max(lengths):
            return


def _episode(recording: Recording, steps: Any, seen: Any, seed: int | None) -> Episode | None:
    """Return an episode of its steps and what was observed first; None if that is not known."""
    observed, acted = recording.spaces["observation"], recording.spaces["action"]
    if recording.kind == "step":
        states = np.append(steps["state"], steps["next_state"][-1:]).astype(np.int64)
        actions = steps["action"].astype(np.int64) + acted["start"]
        return Episode(states + observed["start"], actions, *_outcomes(steps), seed)
    if seen is None:
        return None
    if recording.kind == "variable":
        observations = _gathered(observed, [seen, *(step["next_observation"] for step in steps)])
        return Episode(observations, _gathered(acted, _column(steps, "action")), *_outcomes(steps), seed)
    after = steps["next_observation"]
    observations = _parted(observed, np.concatenate([np.array([seen], after.dtype), after]))
    return Episode(observations, _parted(acted, steps["action"]), *_outcomes(steps), seed)


def _outcomes(steps: Any) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return rewards, who acted, terminated and truncated."""
    names = ("rewards", "acted", "terminated", "truncated")
    rewards, acted, terminated, truncated = (np.array(_column(steps, name)) for name in names)
    return rewards, acted, terminated, truncated


def _column(steps: Any, name: str) -> Any:
    if isinstance(steps, list):
        return [step[name] for step in steps]
    return steps[name] if name in steps.dtype.names else np.ones(len(steps), np.uint32)


def _parted(description: Mapping[str, Any], values: NDArray[Any]) -> Any:
    """Return values of fixed width as dictionaries and tuples of arrays."""
    if description["type"] == "Dict":
        return {name: _parted(part, values[name]) for name, part in description["spaces"].items()}
    if description["type"] == "Tuple":
        return tuple(_parted(part, values[str(i)]) for i, part in enumerate(description["spaces"]))
    return np.ascontiguousarray(values)


def _gathered(description: Mapping[str, Any], values: Sequence[Any]) -> Any:
    """Return values one by one as dictionaries and tuples of arrays and lists of texts."""
    if description["type"] == "Dict":
        parts = description["spaces"].items()
        return {name: _gathered(part, [value[name] for value in values]) for name, part in parts}
    if description["type"] == "Tuple":
        parts = enumerate(description["spaces"])
        return tuple(_gathered(part, [value[i] for value in values]) for i, part in parts)
    return list(values) if description["type"] == "Text" else np.array(values)
