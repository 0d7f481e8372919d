"""Values of a loop's spaces for display: their numbers with names, images, texts, and any value in words."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Final

import numpy as np

from runner.analysis.contents import Step
from runner.analysis.episodes import EpisodeRef
from runner.drawing.raster import Pixels
from runner.environments.naming import agent_actions, numbered_actions, spoken
from runner.recording import schema
from runner.recording.environment import observation_names
from runner.recording.reader import Recording
from runner.recording.spaces import Leaf, Value, decode, least_number, leaves_of
from runner.recording.steps import is_of_environment
from runner.replay.recorded import reset_of
from runner.replay.steps import transitions_of
from runner.util.arrays import Floats, Records

MAX_NUMBERS: Final = 64
"""Leaves of more numbers are not shown number by number."""
FEW: Final = 8
"""Arrays of up to this many numbers are written out in words."""
_LEAST_SIDE: Final = 16
"""An array of bytes is an image if it has at least this height and width."""

Seen = tuple[Value | None, Step | None]
"""An observation, and the step that led to it; none for the observation after a reset."""


class Values:
    """Flattens observations of a recording for display; `name` labels a value without parts.

    Attributes:
        names: the names of the numbers, in the order of `numbers_in`.
        image: the first part that is an image; None if there is none.
    """

    def __init__(self, recording: Recording, name: str = "observation") -> None:
        leaves = leaves_of(recording.spaces["observation"], "the observation space")
        known = observation_names(recording)
        self._leaves = [
            leaf
            for leaf in leaves
            if leaf.dtype is not None and 0 < math.prod(leaf.dtype.shape) <= MAX_NUMBERS
        ]
        self._texts = [leaf for leaf in leaves if leaf.dtype is None]
        self.names = [label for leaf in self._leaves for label in number_names(leaf, name, known=known)]
        self.image = next((leaf for leaf in leaves if is_image(leaf)), None)

    def numbers_in(self, value: object) -> Floats:
        """Return the numbers of a value, float64 [names]."""
        parts = [np.asarray(part_of(value, leaf), np.float64).ravel() for leaf in self._leaves]
        return np.concatenate([np.empty(0), *parts])

    def texts_in(self, value: object) -> str:
        """Return the texts of a value on one line."""
        return ", ".join(f"{'.'.join(leaf.path)} {part_of(value, leaf)!r}".strip() for leaf in self._texts)

    def pixels_in(self, value: object) -> Pixels:
        """Return the image of a value as red, green and blue; of stacked ones the last."""
        assert self.image is not None
        pixels = np.asarray(part_of(value, self.image))
        while pixels.ndim > 3:
            pixels = pixels[-1]
        if pixels.ndim == 3 and pixels.shape[0] < _LEAST_SIDE:  # channels, or stacked pictures, first
            pixels = np.moveaxis(pixels, 0, -1)
        if pixels.ndim == 3:
            pixels = pixels if pixels.shape[2] == 3 else pixels[..., -1]
        return np.ascontiguousarray(np.stack([pixels] * 3, axis=-1) if pixels.ndim == 2 else pixels)


def observed(recording: Recording, steps: Step | Records) -> Value:
    """Return the observation after a step, or those after steps; numbers where the space is `Discrete`.

    Those of varying size are a list.
    """
    if recording.has_states:
        return steps["next_state"].astype(np.int64) + least_number(recording.spaces["observation"])
    return _decoded(recording, "observation", steps["next_observation"])


def acted(recording: Recording, steps: Step | Records) -> Value:
    """Return the action of a step, or those of steps, as `observed` returns observations."""
    if recording.has_states:
        return steps["action"].astype(np.int64) + least_number(recording.spaces["action"])
    return _decoded(recording, "action", steps["action"])


def _decoded(recording: Recording, space: str, values: Value) -> Value:
    """Return values of a space; those of varying size are recorded as bytes."""
    if isinstance(values, bytes):
        return decode(recording.spaces[space], values, str(recording.path))
    if isinstance(values, np.ndarray) and values.dtype.hasobject:
        return [decode(recording.spaces[space], value, str(recording.path)) for value in values]
    return values


def observations_of(recording: Recording, phase: str, episode: int, start: int = 0) -> Iterator[Seen]:
    """Yield what was observed after each step of an episode, from the observation after `start` steps on.

    The first one, without a step, is None if it was lost.

    Raises:
        RecordingError: there is no such episode, or a step has a state that the environment does not have.
    """
    first = max(0, start - 1)
    for t, step in enumerate(transitions_of(recording, phase, episode, first), first):
        if recording.tabular:
            where = str(recording.path)
            name = schema.PHASE_NAMES[phase]
            recording.mdp.check_steps(np.asarray(step).reshape(1), where, name)
        if start == 0 and t == 0:
            yield first_observed(recording, phase, episode, step), None
        yield observed(recording, step), step


def first_observed(recording: Recording, phase: str, number: int, step: Step) -> Value | None:
    """Return the observation before the first step of an episode; None if it was lost.

    Where a loop stepped on without a reset, it is the last observation of the environment before.

    Args:
        recording: the run.
        phase: `train` or `eval`.
        number: the episode's number in the phase.
        step: its first step.

    Raises:
        RecordingError: there is no such episode, or its first step was lost.
    """
    if recording.has_states:
        return step["state"].astype(np.int64) + least_number(recording.spaces["observation"])
    if (reset := reset_of(recording, phase, number)) is not None:
        return reset.value(recording)
    episode = recording.phase(phase).episode(number)
    first = None
    if not episode.table.are_actions:
        earlier = range(max(0, episode.first - recording.environments), episode.first)
        for block in episode.table.numbered(earlier):
            rows = block[is_of_environment(block, episode.environment)]
            first = observed(recording, rows[-1]) if len(rows) else first
    return first


def value_in_words(value: object, limit: int = FEW) -> str:
    """Return a value of any space as text on one line: `3`, `[0.12 -0.5]`, `go 3, push [0.5]`.

    Arrays of more numbers than `limit` are described by their shape.
    """
    value = plain_value(value)
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {value_in_words(part, limit)}" for name, part in value.items())
    if isinstance(value, tuple):
        return f"({', '.join(value_in_words(part, limit) for part in value)})"
    if isinstance(value, str):
        return repr(value)
    array = np.asarray(value)
    if array.size > limit:
        return f"{array.dtype} [{', '.join(map(str, array.shape))}]"
    if array.ndim:
        return f"[{' '.join(f'{number:.3g}' for number in array.ravel().tolist())}]"
    return f"{array.item():.3g}" if array.dtype.kind == "f" else f"{array.item()}"


def step_actions_in_words(recording: Recording, phase: str) -> Callable[[Step], dict[str, str]]:
    """Return how to put the actions of a step in words, by agent: `left`, or a value without a name.

    An agent that took no part is left out; a single agent has no name.
    """
    agents = recording.agents if len(recording.agents) > 1 else ("",)
    by_agent = {agent: _action_in_words(recording, phase, agent) for agent in agents}

    def in_words(step: Step) -> dict[str, str]:
        action = acted(recording, step)
        if "" in by_agent:
            return {"": by_agent[""](action)}
        numbered = enumerate(by_agent.items())
        return {
            agent: text_of(action[agent]) for i, (agent, text_of) in numbered if int(step["acted"]) >> i & 1
        }

    return in_words


def actions_at(recording: Recording, at: EpisodeRef) -> dict[str, str]:
    """Return the recorded actions at a step in words, by agent; a single agent of a loop has no name.

    Raises:
        RecordingError: there is no such step, or it was not recorded.
    """
    step = recording.phase(at.phase).episode(at.number_in(recording)).one(at.t)
    if not recording.can_train_again:
        return step_actions_in_words(recording, at.phase)(step)
    mdp = recording.mdp
    mdp.check_steps(np.asarray(step).reshape(1), str(recording.path), schema.PHASE_NAMES[at.phase])
    per_agent = zip(mdp.agents, numbered_actions(mdp), agent_actions(mdp, int(step["action"])), strict=True)
    return {agent: names[number] for agent, names, number in per_agent}


def _action_in_words(recording: Recording, phase: str, agent: str) -> Callable[[Value], str]:
    """Return how to put an agent's action in words; a single agent has no name."""
    space = recording.spaces["action"]
    least = least_number(space["spaces"][agent] if agent else space)
    names = [spoken(name) for name in recording.phase(phase).action_names(agent)]

    def in_words(action: Value) -> str:
        if not names and not recording.has_states:
            return value_in_words(action)
        index = int(action) - least
        return names[index] if 0 <= index < len(names) else str(int(action))

    return in_words


def plain_value(value: object) -> object:
    """Return a value whose records are dictionaries, or tuples if their fields are numbered."""
    if not isinstance(value, np.void) or not value.dtype.names:
        return value
    parts = {name: plain_value(value[name]) for name in value.dtype.names}
    return tuple(parts.values()) if list(parts) == [str(i) for i in range(len(parts))] else parts


def part_of(value: Value, leaf: Leaf) -> Value:
    """Return the part of a value, or of records of values, that a leaf describes."""
    for key in leaf.path:
        value = value[int(key) if isinstance(value, tuple) else key]
    return value


def number_names(leaf: Leaf, name: str, skip: int = 0, known: Sequence[str] = ()) -> Iterator[str]:
    """Yield a name for each number of a leaf: the `known` ones, or `position[0]`.

    A leaf without a path has the `name`; the first `skip` keys of a path are left out.
    """
    label = ".".join(leaf.path[skip:]) or name
    return iter(known) if known else names_in(label, leaf.dtype.shape if leaf.dtype is not None else ())


def names_in(array: str, shape: tuple[int, ...]) -> Iterator[str]:
    """Yield a name for each number of an array, row by row: `position[0]`; a single number is named as it."""
    for place in np.ndindex(shape):
        yield f"{array}[{', '.join(map(str, place))}]" if place else array


def is_image(leaf: Leaf) -> bool:
    """Return whether a leaf holds bytes of a picture: [height, width], perhaps with channels or stacked."""
    if leaf.dtype is None or leaf.dtype.base != np.uint8:
        return False
    large = [side for side in leaf.dtype.shape if side >= _LEAST_SIDE]
    return len(large) == 2 and len(leaf.dtype.shape) <= 4
