"""What a page plays of an episode of a loop: its actions, its rewards, and the values of its observations.

Only what the page shows is kept in memory: not the other steps, and nothing of observations that are images.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.environments.naming import spoken
from runner.errors import RecordingError, shortened
from runner.export.contents import ENDINGS, ending_of
from runner.export.episodes import EpisodePlace, no_step
from runner.export.reports.player_data import (
    Playback,
    Series,
    Words,
    frame_times,
    logged_near,
    outcome_in_words,
    short,
    short_rows,
    words,
)
from runner.export.values import action_in_words, is_image
from runner.recording import schema
from runner.recording.reader import Recording
from runner.recording.spaces import leaves_of
from runner.replay.steps import reset_of
from runner.replay.whole_steps import whole_steps

MAX_SERIES: Final = 32
_LEAST_SERIES: Final = 20
"""Numbers of an observation that a page shows, of each of several agents at least the second."""
_MAX_LETTERS: Final = 200
"""Letters of a text that are shown."""

Column = NDArray[Any] | list[str]
"""A part of a value at each of T steps: numbers [T, n], or texts."""


@dataclass(frozen=True)
class _ShownPart:
    """A part of a space, and what is shown of it."""

    agent: str
    """Whose part it is; empty where there is one agent."""
    names: tuple[str, ...]
    """Of its numbers, or of its text."""
    path: tuple[str, ...]
    is_text: bool

    def column(self, values: Any) -> Column:
        """Return this part of T values: records, arrays, or decoded values."""
        if not isinstance(values, list):
            for name in self.path:
                values = values[name]
            numbers: NDArray[Any] = values.reshape(len(values), -1)[:, : len(self.names)]
            return numbers.copy()
        for name in self.path:
            values = [each[int(name) if isinstance(each, tuple) else name] for each in values]
        if self.is_text:
            return [shortened(value, _MAX_LETTERS) for value in values]
        return np.array(values).reshape(len(values), -1)[:, : len(self.names)]


@dataclass(frozen=True)
class _Steps:
    """T consecutive steps of an episode; what is shown of the actions and of the observations after them."""

    rewards: NDArray[np.float64]
    """[T, agents]."""
    log_time: NDArray[np.int64]
    actions: dict[str, list[str]]
    """Of each agent, or of the only one under an empty name."""
    observations: list[Column]


def loop_playback(recording: Recording, place: EpisodePlace, limit: int, first: int) -> Playback:
    """Return what a page plays of an episode: at most `limit` steps from step `first` on."""
    span = recording.episode_span(place.phase, place.number)
    if not 0 <= first < len(span):
        raise no_step(recording, place.title, len(span), first)
    observed, notes = _shown_parts(recording)
    reader = _Reader(recording, place.phase, observed)
    before, steps = reader.part(place.number, span, first, limit)
    time = frame_times(steps.log_time // schema.STEP_NANOSECONDS)
    ended = ending_of(recording, place.phase, place.number)
    total = None
    if ended != "cut off":
        total = float(recording.episodes(place.phase, place.number, place.number + 1)["returns"].sum())
    elif first + limit >= len(span):
        total = float(before.sum() + steps.rewards.sum())
    texts, series = _frames(observed, reader.before(place, span, first), steps.observations)
    title = place.title[0].upper() + place.title[1:]
    return Playback(
        title=title if span.step == 1 else f"{title}, in environment {span.start % span.step}",
        description=outcome_in_words(len(span), ended, total),
        length=len(span),
        first=first,
        end=ENDINGS[ended],
        agents=[spoken(agent) for agent in recording.agents],
        before=[short(value) for value in before.tolist()] if first else [],
        reward=short_rows(steps.rewards),
        actions=[words(agent, "action", texts) for agent, texts in steps.actions.items()],
        texts=texts,
        time=time,
        series=[*series, *_extras(recording, place.phase, span[first : first + limit], notes)],
        notes=notes,
        logged=logged_near(recording, place.phase, time),
    )


class _Reader:
    """Reads steps of a phase."""

    def __init__(self, recording: Recording, phase: str, observed: Sequence[_ShownPart]) -> None:
        self._recording, self._phase, self._observed = recording, phase, observed

    def part(self, episode: int, span: range, first: int, limit: int) -> tuple[NDArray[np.float64], _Steps]:
        """Return the sum of each agent's rewards before a part of an episode, and the steps of the part."""
        part = span[first : first + limit]
        before, found = np.zeros(len(self._recording.agents)), []
        for records in self._records(episode, range(span.start, part[-1] + 1, span.step)):
            numbers = np.array([record["step"] for record in records])
            rewards = np.array([record["rewards"] for record in records], np.float64)
            earlier = int(np.searchsorted(numbers, part.start))
            before += rewards[:earlier].sum(axis=0)
            if earlier < len(records):
                found.append(self._steps(records[earlier:], rewards[earlier:]))
        if sum(len(steps.rewards) for steps in found) != len(part):
            raise RecordingError(f"{self._recording.path}: steps of this part of the episode were lost.")
        return before, _joined(found)

    def before(self, place: EpisodePlace, span: range, first: int) -> list[Column]:
        """Return the observation before a step of an episode, as columns of one value; empty if unknown."""
        if first:
            number = span[first - 1]
            records = next(self._records(place.number, range(number, number + 1, span.step)), None)
            return [] if records is None or not len(records) else self._observations(records)
        reset = reset_of(self._recording, place.phase, place.number)
        if reset is None:
            return []
        value = reset["observation"]
        values = [value] if self._recording.kind == "variable" else np.array([value])
        return [part.column(values) for part in self._observed]

    def _records(self, episode: int, numbers: range) -> Iterator[Any]:
        """Yield the steps of an episode with these numbers, some at a time."""
        recording, phase = self._recording, self._phase
        if recording.has_actions_alone(phase):
            steps = whole_steps(recording, phase, episode)
            yield steps[(steps["step"] >= numbers.start) & (steps["step"] < numbers.stop)]
            return
        if recording.kind != "variable":
            for block in recording.blocks(recording.topic(f"/{phase}/step"), numbers.start, numbers.stop):
                yield block[(numbers.start - int(block["step"][0])) % numbers.step :: numbers.step]
            return
        for step in recording.transitions(phase):
            if step["step"] >= numbers.stop:
                return
            if step["step"] >= numbers.start:
                yield [step]

    def _steps(self, records: Any, rewards: NDArray[np.float64]) -> _Steps:
        return _Steps(
            rewards=rewards,
            log_time=np.array([record["log_time"] for record in records], np.int64),
            actions=self._actions(records),
            observations=self._observations(records),
        )

    def _actions(self, records: Any) -> dict[str, list[str]]:
        """Return the actions of each agent in words; a dash where it took no part."""
        agents = self._recording.agents
        if len(agents) == 1:
            in_words = action_in_words(self._recording, self._phase)
            return {"": [shortened(in_words(record["action"]), _MAX_LETTERS) for record in records]}
        words_of = {agent: action_in_words(self._recording, self._phase, agent) for agent in agents}
        return {
            agent: [
                shortened(words_of[agent](record["action"][agent]), _MAX_LETTERS)
                if int(record["acted"]) >> i & 1
                else "–"
                for record in records
            ]
            for i, agent in enumerate(agents)
        }

    def _observations(self, records: Any) -> list[Column]:
        """Return what is shown of the observations after steps."""
        if self._recording.kind == "step":
            start = self._recording.spaces["observation"]["start"]
            after = records["next_state"].astype(np.int64) + start
        elif isinstance(records, list):
            after = [record["next_observation"] for record in records]
        else:
            after = records["next_observation"]
        return [part.column(after) for part in self._observed]


def _joined(found: Sequence[_Steps]) -> _Steps:
    def join(columns: Sequence[Column]) -> Column:
        if isinstance(columns[0], list):
            return [text for column in columns for text in column]
        return np.concatenate(columns)

    return _Steps(
        np.concatenate([steps.rewards for steps in found]),
        np.concatenate([steps.log_time for steps in found]),
        {agent: [text for steps in found for text in steps.actions[agent]] for agent in found[0].actions},
        [join(columns) for columns in zip(*(steps.observations for steps in found), strict=True)],
    )


def _extras(recording: Recording, phase: str, part: range, notes: list[str]) -> list[Series]:
    """Return the values that the loop recorded with these steps, each at the frame before its step."""
    series = []
    agents = recording.agents if len(recording.agents) > 1 else ()
    extras = recording.extras(phase)
    found = extras.at(np.arange(part.start, part.stop, part.step)) if extras else {}
    for name, values in found.items():
        agent = next((one for one in agents if name.startswith(f"{one}/")), "")
        shape = values.shape[1:]
        columns = values.reshape(len(part), -1)
        if columns.shape[1] > MAX_SERIES:
            notes.append(f"{name}: {_sizes(shape)} numbers with each step")
            continue
        for k in range(columns.shape[1]):
            own = f"{name.removeprefix(f'{agent}/')}{_index(k, shape)}"
            numbers = [None if value is None else short(value) for value in columns[:, k].tolist()]
            series.append(Series(agent, "extras", own, [*numbers, None]))
    return series


def _shown_parts(recording: Recording) -> tuple[list[_ShownPart], list[str]]:
    """Return what is shown of the observations, and a sentence on each thing that is not."""
    agents = recording.agents if len(recording.agents) > 1 else ()
    leaves = leaves_of(recording.spaces["observation"], f"{recording.path}: the observation space")
    shown, notes, unseen = [], [], 0
    left = max(MAX_SERIES // len(agents), _LEAST_SERIES) if agents else MAX_SERIES
    budget = dict.fromkeys(agents or ("",), left)
    for leaf in leaves:
        agent = leaf.path[0] if leaf.path and leaf.path[0] in agents else ""
        path = leaf.path[1:] if agent else leaf.path
        name = ".".join(path)
        if leaf.dtype is None:
            shown.append(_ShownPart(agent, (name,), leaf.path, is_text=True))
            continue
        shape, count = leaf.dtype.shape, math.prod(leaf.dtype.shape)
        if len(shape) > 1 and count > left:
            what = "an image" if is_image(leaf) else "an array"
            notes.append(f"{' '.join(filter(None, (agent, name))) or 'observation'}: {what}, {_sizes(shape)}")
            continue
        taken = min(count, budget.get(agent, left))
        budget[agent] = budget.get(agent, left) - taken
        unseen += count - taken
        names = tuple(f"{name}{_index(i, shape)}" for i in range(taken))
        if names:
            shown.append(_ShownPart(agent, names, leaf.path, is_text=False))
    if unseen:
        notes.append(f"{unseen:,} more numbers of each observation are in the recording")
    return shown, notes


def _sizes(shape: tuple[int, ...]) -> str:
    return " × ".join(map(str, shape))


def _index(number: int, shape: tuple[int, ...]) -> str:
    """Return the index of a number in an array as text; empty for the only one."""
    return f"[{', '.join(map(str, np.unravel_index(number, shape)))}]" if shape else ""


def _frames(
    parts: Sequence[_ShownPart], first: Sequence[Column], after: Sequence[Column]
) -> tuple[list[Words], list[Series]]:
    """Return the texts and the numbers of T + 1 frames from the first observation and those after steps."""
    texts, series = [], []
    for i, part in enumerate(parts):
        own: Any = after[i]
        start: Any = first[i] if first else None
        if part.is_text:
            texts.append(words(part.agent, part.names[0] or "observation", [*(start or [""]), *own]))
            continue
        for k, name in enumerate(part.names):
            begin = [None] if start is None else [short(float(start[0, k]))]
            numbers = [*begin, *(short(value) for value in own[:, k].astype(np.float64).tolist())]
            series.append(Series(part.agent, "observation", name or "observation", numbers))
    return texts, series
