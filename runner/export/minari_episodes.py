"""The episodes of a run as Minari stores them: with one more observation than steps, that of the reset.

Steps are read a block at a time; an episode is yielded when it has ended.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.export.values import acted, observed
from runner.recording.reader import Recording
from runner.recording.spaces import Description, Value, least_number
from runner.recording.steps import turns_of
from runner.util.arrays import Flags, Floats, Records
from runner.util.values import Ranges

MAX_EPISODE_BYTES: Final = 1 << 30
"""The limit of one episode, which Minari needs in memory."""


@dataclass(frozen=True)
class MinariEpisode:
    """The T steps of an episode that ended; observations and actions are nested as their spaces."""

    observations: Value
    """T + 1 of them."""
    actions: Value
    rewards: Floats
    """[T, agents]."""
    terminated: Flags
    truncated: Flags
    acted: NDArray[np.uint32] | None = None
    """[T]: bit i, whether agent i took part; None where all always do."""
    seed: int | None = None
    """The seed of its reset, if it had one."""

    @property
    def is_abandoned(self) -> bool:
        """Whether it was reset before its end."""
        return not (self.terminated[-1] or self.truncated[-1])


def episodes_in(recording: Recording, phase: str, ranges: Ranges) -> Iterator[MinariEpisode]:
    """Yield the episodes of a phase that ended, in these ranges.

    An episode of a loop is left out if a repair lost steps of it or the observation of its reset.
    """
    starts: list[int] = []
    lengths: dict[int, int] = {}
    """The lengths of the episodes, by the number of their last step."""
    for start, stop in ranges:
        for block in recording.phase(phase).episodes.blocks(start, stop):
            lengths |= zip(block["last_step"].tolist(), block["length"].tolist(), strict=True)
            starts += block["first_step"].tolist()
    if not lengths:
        return
    numbers = range(max(min(starts), 0), max(lengths) + 1)
    resets = _EpisodeResets(recording, phase)
    for environment, steps in _steps(recording, phase, numbers, lengths):
        seed, first = resets.before(environment, steps)
        resets.keep_last(environment, steps[-1])
        if first is not None and lengths.get(int(steps[-1]["step"])) == len(steps):
            yield _episode(recording, steps, first, seed)


class _EpisodeResets:
    """The seed and the observation that each episode begins with."""

    def __init__(self, recording: Recording, phase: str) -> None:
        self._recording = recording
        self._remaining = recording.phase(phase).reset_values()
        self._next = next(self._remaining, None)
        self._read: dict[tuple[int, int], tuple[int | None, Value]] = {}
        """By environment and episode."""
        self._last: dict[int, Value] = {}

    def before(self, environment: int, steps: Records) -> tuple[int | None, Value]:
        """Return seed and observation of the reset before steps, or None and the last observation."""
        while self._next is not None and int(self._next["step"]) <= int(steps[0]["step"]):
            reset = self._next
            seed = int(reset["seed"]) if reset["seeded"] else None
            key = int(reset["environment"]), int(reset["episode"])
            self._read[key] = seed, _copy(reset["observation"])
            self._next = next(self._remaining, None)
        key = environment, int(steps[0]["episode"])
        seed, first = self._read.pop(key, (None, self._last.get(environment)))
        if self._recording.has_states:
            first = steps[0]["state"].astype(np.int64) + least_number(self._recording.spaces["observation"])
        return seed, first

    def keep_last(self, environment: int, step: np.void) -> None:
        """Keep the last observation of an environment, since an episode may continue after its end."""
        self._last[environment] = _copy(observed(self._recording, step))


def _copy(value: Value) -> Value:
    """Return a value that does not keep its block in memory."""
    return value.copy() if isinstance(value, np.ndarray | np.void) else value


def _steps(
    recording: Recording, phase: str, numbers: range, lengths: Mapping[int, int]
) -> Iterator[tuple[int, Records]]:
    """Yield environment and steps of each episode; the last one of an environment may not have ended."""
    open_parts: defaultdict[int, list[Records]] = defaultdict(list)
    for block in recording.phase(phase).steps.numbered(numbers):
        ended: list[tuple[int, Records]] = []
        for environment, places in turns_of(block):
            rows, parts = block[places], open_parts[environment]
            for part in np.split(rows, np.flatnonzero(np.diff(rows["episode"])) + 1):
                is_last = int(part["step"][-1]) in lengths
                ended += ((environment, steps) for steps in _extend(recording, parts, part, is_last))
        yield from sorted(ended, key=lambda found: int(found[1]["step"][-1]))
    yield from ((environment, np.concatenate(parts)) for environment, parts in open_parts.items() if parts)


def _extend(recording: Recording, parts: list[Records], part: Records, is_last: bool) -> Iterator[Records]:
    """Add steps to the parts of the current episode; yield it if they belong to another one, or end it.

    Args:
        is_last: whether an episode is known to end with these steps.
    """
    if parts and parts[-1]["episode"][-1] != part["episode"][0]:
        yield np.concatenate(parts)
        parts.clear()
    parts.append(part.copy())
    if sum(part.nbytes for part in parts) > MAX_EPISODE_BYTES:
        raise RecordingError(
            f"{recording.path}: episode {part['episode'][0]} has more than {MAX_EPISODE_BYTES:,} bytes, "
            "which Minari would hold at once; choose others by --episodes, or export parquet."
        )
    if is_last or part["terminated"][-1] or part["truncated"][-1]:
        yield np.concatenate(parts)
        parts.clear()


def _episode(recording: Recording, steps: Records, first: Value, seed: int | None) -> MinariEpisode:
    """Return an episode of its steps and the observation of its reset."""
    after, actions = observed(recording, steps), acted(recording, steps)
    seen, done = (recording.spaces[name] for name in ("observation", "action"))
    if isinstance(after, list):
        observations = _collected(seen, [first, *after])
    else:
        observations = _split(seen, np.concatenate([np.array([first], after.dtype), after]))
    taken = _collected(done, actions) if isinstance(actions, list) else _split(done, actions)
    fields = {"rewards", "terminated", "truncated", "acted"} & {*(steps.dtype.names or ())}
    outcomes: dict[str, Any] = {name: steps[name].copy() for name in fields}
    return MinariEpisode(observations, taken, seed=seed, **outcomes)


def _split(description: Description, values: NDArray[Any]) -> Value:
    """Return records as dictionaries and tuples of arrays."""
    if description["type"] == "Dict":
        return {name: _split(part, values[name]) for name, part in description["spaces"].items()}
    if description["type"] == "Tuple":
        return tuple(_split(part, values[str(i)]) for i, part in enumerate(description["spaces"]))
    return np.ascontiguousarray(values)


def _collected(description: Description, values: Sequence[Value]) -> Value:
    """Return single values as dictionaries and tuples of arrays and lists of texts."""
    if description["type"] == "Dict":
        parts = description["spaces"].items()
        return {name: _collected(part, [value[name] for value in values]) for name, part in parts}
    if description["type"] == "Tuple":
        parts = enumerate(description["spaces"])
        return tuple(_collected(part, [value[i] for value in values]) for i, part in parts)
    return list(values) if description["type"] == "Text" else np.array(values)
