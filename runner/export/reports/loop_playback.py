"""What a page plays of an episode of a loop: its actions, its rewards, and the values of its observations.

Only what the page shows is kept in memory: not the other steps, and nothing of observations that are images.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.analysis.contents import ENDINGS, ending_of
from runner.analysis.episodes import EpisodeRef
from runner.environments.naming import spoken
from runner.errors import RecordingError, shortened
from runner.export.reports.player_data import (
    Playback,
    PlayerSeries,
    Words,
    frame_times,
    logged_near,
    outcome_in_words,
    short,
    short_rows,
    words,
)
from runner.export.values import is_image, names_in, number_names, observed, step_actions_in_words
from runner.recording import schema
from runner.recording.environment import observation_names
from runner.recording.extras import filled
from runner.recording.reader import Recording
from runner.recording.spaces import Value, leaves_of
from runner.replay.recorded import reset_of
from runner.replay.steps import whole_steps
from runner.util.arrays import Array, Ints, Records

MAX_SERIES: Final = 32
_LEAST_SERIES: Final = 20
"""Numbers of an observation that a page shows, of each of several agents at least the second."""
_MAX_LETTERS: Final = 200
"""Letters of a text that are shown."""

Values = NDArray[Any] | list[Value]
"""Values of a space, of one size or not."""
Column = Array | list[str]
"""A part of a value at each of T steps: numbers [T, n], or texts."""


@dataclass(frozen=True)
class _ShownPart:
    """A part of a space, and what is shown of it."""

    agent: str
    """The agent that it is of; empty where there is only one."""
    names: tuple[str, ...]
    """The names of its numbers, or of its text."""
    path: tuple[str, ...]
    is_text: bool

    def column(self, values: Values) -> Column:
        """Return this part of T values."""
        if not isinstance(values, list):
            part = values
            for name in self.path:
                part = part[name]
            return part.reshape(len(part), -1)[:, : len(self.names)].copy()
        for name in self.path:
            values = [value[int(name) if isinstance(value, tuple) else name] for value in values]
        if self.is_text:
            return [shortened(value, _MAX_LETTERS) for value in values]
        return np.array(values).reshape(len(values), -1)[:, : len(self.names)]


def loop_playback(recording: Recording, at: EpisodeRef, limit: int, first: int) -> Playback:
    """Return what a page plays of an episode: at most `limit` steps from step `first` on."""
    phase, number = recording.phase(at.phase), at.number_in(recording)
    length = len(episode := phase.episode(number))
    if not 0 <= first < length:
        raise at.no_step(recording, length, max(first, at.t))
    parts, notes = _shown_parts(recording)
    in_words = step_actions_in_words(recording, at.phase)
    agents = recording.agents if len(recording.agents) > 1 else ("",)
    before = np.zeros(len(recording.agents))
    rewards = [np.empty((0, len(before)))]
    numbers = [np.empty(0, np.int64)]
    log_times = [np.empty(0, np.int64)]
    actions: list[dict[str, str]] = []
    observations: list[list[Column]] = []
    reset = reset_of(recording, at.phase, number)
    if reset is not None and not first:
        value = reset.value(recording)
        values: Values = [value] if phase.steps.dtype is None else np.array([value])
        observations.append([part.column(values) for part in parts])
    for steps in _steps(recording, at.phase, number, first + limit):
        paid = steps["rewards"].astype(np.float64)
        earlier, seen = np.searchsorted(steps["t"], [first, first - 1]).tolist()
        before += paid[:earlier].sum(axis=0)
        shown = steps[earlier:]
        rewards.append(paid[earlier:])
        log_times.append(shown["log_time"].astype(np.int64))
        numbers.append(shown["step"])
        actions += map(in_words, shown)
        if seen < len(steps):
            after = observed(recording, steps[seen:])
            observations.append([part.column(after) for part in parts])
    reward = np.concatenate(rewards)
    if len(reward) != min(limit, length - first):
        raise RecordingError(f"{recording.path}: steps of this part of the episode were lost.")
    frames = frame_times(np.concatenate(log_times) // schema.STEP_NANOSECONDS)
    ended = ending_of(recording, at.phase, number)
    total = None
    if len(records := phase.episodes.array(number, number + 1)):  # none if the file was cut off
        total = float(records["returns"].sum())
    elif first + limit >= length:
        total = float(before.sum() + reward.sum())
    begun = f" Reset with {reset.in_words}." if reset is not None and reset.in_words else ""
    texts, series = _frames(parts, observations, len(frames))
    extra_texts, extra_series = _extras(recording, at.phase, np.concatenate(numbers), notes)
    return Playback(
        title=at.heading + (f", in environment {episode.environment}" if recording.environments > 1 else ""),
        description=outcome_in_words(length, ended, total) + begun,
        length=length,
        first=first,
        end=ENDINGS[ended],
        agents=[spoken(agent) for agent in recording.agents],
        before=[short(value) for value in before.tolist()] if first else [],
        reward=short_rows(reward),
        actions=[
            words(agent, "action", (shortened(own.get(agent, "–"), _MAX_LETTERS) for own in actions))
            for agent in agents
        ],
        texts=[*texts, *extra_texts],
        time=frames,
        series=[*series, *extra_series],
        notes=notes,
        logged=logged_near(recording, at.phase, frames),
    )


def _steps(recording: Recording, phase: str, episode: int, stop: int) -> Iterator[Records]:
    """Yield the steps of an episode to before t = `stop`, some at a time."""
    if not recording.phase(phase).steps.are_actions:
        yield from recording.phase(phase).episode(episode).rows(0, stop)
        return
    yield whole_steps(recording, phase, episode)[:stop]


def _extras(
    recording: Recording, phase: str, steps: Ints, notes: list[str]
) -> tuple[list[Words], list[PlayerSeries]]:
    """Return the values that the loop recorded with these steps, each at the frame before its step.

    Texts and arrays of varying length are words, all others series of numbers.
    """
    texts, series = [], []
    agents = recording.agents if len(recording.agents) > 1 else ()
    extras = recording.phase(phase).extras
    by_name = extras.at(steps) if extras else {}
    for name, values in by_name.items():
        agent = next((one for one in agents if name.startswith(f"{one}/")), "")
        if values.dtype.hasobject:
            shown = [_shortened(value) for value in filled(values).tolist()]
            texts.append(words(agent, name.removeprefix(f"{agent}/"), [*shown, ""]))
            continue
        shape = values.shape[1:]
        columns = values.reshape(len(steps), -1)
        if columns.shape[1] > MAX_SERIES:
            notes.append(f"{name}: {_sizes(shape)} numbers with each step")
            continue
        for own, column in zip(names_in(name.removeprefix(f"{agent}/"), shape), columns.T, strict=True):
            numbers = [None if value is None else short(value) for value in column.tolist()]
            series.append(PlayerSeries(agent, "extras", own, [*numbers, None]))
    return texts, series


def _shortened(value: Any) -> str:
    """Return the beginning of a text or of an array; nothing for None."""
    if value is None or isinstance(value, str):
        return shortened(value or "", _MAX_LETTERS)
    return shortened(str(value[:_MAX_LETTERS].tolist()), _MAX_LETTERS)


def _shown_parts(recording: Recording) -> tuple[list[_ShownPart], list[str]]:
    """Return what is shown of the observations, and a sentence on each thing that is not."""
    agents = recording.agents if len(recording.agents) > 1 else ()
    leaves = leaves_of(recording.spaces["observation"], f"{recording.path}: the observation space")
    shown = []
    notes = []
    unseen = 0
    known = observation_names(recording)
    left = max(MAX_SERIES // len(agents), _LEAST_SERIES) if agents else MAX_SERIES
    budget: defaultdict[str, int] = defaultdict(lambda: left)
    for leaf in leaves:
        agent = leaf.path[0] if leaf.path and leaf.path[0] in agents else ""
        skip = 1 if agent else 0
        name = ".".join(leaf.path[skip:])
        if leaf.dtype is None:
            shown.append(_ShownPart(agent, (name,), leaf.path, is_text=True))
            continue
        shape = leaf.dtype.shape
        count = math.prod(leaf.dtype.shape)
        if len(shape) > 1 and count > left:
            what = "an image" if is_image(leaf) else "an array"
            notes.append(f"{' '.join(filter(None, (agent, name))) or 'observation'}: {what}, {_sizes(shape)}")
            continue
        taken = min(count, budget[agent])
        budget[agent] -= taken
        unseen += count - taken
        names = tuple(islice(number_names(leaf, "", skip, known), taken))
        if names:
            shown.append(_ShownPart(agent, names, leaf.path, is_text=False))
    if unseen:
        notes.append(f"{unseen:,} more numbers of each observation are in the recording")
    return shown, notes


def _sizes(shape: tuple[int, ...]) -> str:
    return " × ".join(map(str, shape))


def _frames(
    parts: Sequence[_ShownPart], observations: Sequence[Sequence[Column]], frames: int
) -> tuple[list[Words], list[PlayerSeries]]:
    """Return the texts and the numbers of frames.

    The observations are columns of each part, without the first frame's if it is unknown.
    """
    texts, series = [], []
    for i, part in enumerate(parts):
        columns = [observation[i] for observation in observations]
        if part.is_text:
            shown = [text for column in columns for text in column]
            unknown = [""] * (frames - len(shown))
            texts.append(words(part.agent, part.names[0] or "observation", unknown + shown))
            continue
        numbers = np.concatenate(columns).astype(np.float64)
        for name, own in zip(part.names, numbers.T.tolist(), strict=True):
            values: list[Value] = [None] * (frames - len(own)) + [*map(short, own)]
            series.append(PlayerSeries(part.agent, "observation", name or "observation", values))
    return texts, series
