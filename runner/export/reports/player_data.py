"""What a page plays of an episode, in one form for every recording; as JSON can hold it.

Frame k is the state after k steps, so a part of T steps has T + 1 frames. Texts that repeat are stored once,
with the index of each frame's text.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from itertools import chain, islice
from typing import Final

import numpy as np

from runner.analysis.contents import ENDINGS
from runner.drawing import svg
from runner.environments.naming import exploration_in_words, spoken
from runner.recording import schema
from runner.recording.reader import Recording
from runner.util.arrays import Array, Floats, Ints
from runner.util.humanize import counted
from runner.util.values import Json

MAX_LOGGED: Final = 5000
"""Logged values near a part that a page shows."""
_NEAR: Final = 1000
"""Steps of the run before and after a part in which logged values are near it."""
_MAX_LETTERS: Final = 300
"""Letters of a logged name or text."""
Value = float | int | str | None
"""A number; NaN and infinities as text; None where it is unknown."""


@dataclass(frozen=True)
class Words:
    """The texts of frames, or of steps."""

    agent: str
    """The agent that they are of; empty for all together."""
    name: str
    values: list[str]
    """The different texts."""
    at: list[int]
    """The index of each text."""


@dataclass(frozen=True)
class PlayerSeries:
    """A number at each frame."""

    agent: str
    """The agent that it is of; empty for all together."""
    kind: str
    """What it is a part of, such as `observation`."""
    name: str
    values: list[Value]


@dataclass(frozen=True)
class Logged:
    """The values logged under a name near a part."""

    name: str
    at: list[int]
    """The number of steps of the run before each, as in `Playback.time`."""
    values: list[Value]


@dataclass(frozen=True)
class PlayerGrid:
    """The places of the things of a scene."""

    places: list[list[int]]
    """For each state: x, y (hundredths of a cell) and size (percent) of each thing."""
    at: list[int]
    """The index of each frame's state."""


@dataclass(frozen=True)
class Playback:
    """A part of an episode: T steps and T + 1 frames."""

    title: str
    description: str
    length: int
    """Steps of the whole episode."""
    first: int
    """The step with which this part begins."""
    end: str
    """How the episode ended, as text; empty if it did not."""
    agents: list[str]
    """The names of those that are rewarded."""
    before: list[Value]
    """The sum of each agent's earlier rewards; empty at the beginning."""
    reward: list[list[Value]]
    """For each step the reward of each agent."""
    actions: list[Words]
    """The actions of all agents together, or of each; a text for each step."""
    texts: list[Words]
    """Parts of states or observations that are texts, for each frame."""
    time: list[int]
    """The number of steps of the run before each frame, in training and evaluation together."""
    series: list[PlayerSeries] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    """What is left out, a sentence each."""
    logged: list[Logged] = field(default_factory=list)
    events: list[str] = field(default_factory=list)
    """The names of the environment's events."""
    event: list[int] = field(default_factory=list)
    """For each step, bit i: the i-th of the events occurred."""
    explored: list[int] = field(default_factory=list)
    """For each step, bit i: the i-th agent's part of the action was chosen at random."""
    choices: list[list[str]] = field(default_factory=list)
    """The names of the actions of each Q-table."""
    values: list[Json] = field(default_factory=list)
    """For each Q-table the highest values before each step, and that of the action taken."""
    grid: PlayerGrid | None = None
    trail: int = svg.TRAIL
    """The number of places that a trail joins."""

    def as_json(self) -> dict[str, object]:
        """Return its fields, and as `facts` what a page lists for each frame."""
        return asdict(self) | {"facts": [asdict(fact) for fact in self._facts()]}

    def _facts(self) -> Iterator[Words]:
        """Yield what is known of frames besides `texts`, of each agent or all together; empty for none."""
        rewards = np.array([self.before or [0] * len(self.agents), *self.reward], np.float64)
        with np.errstate(over="ignore", invalid="ignore"):
            returns = rewards.cumsum(axis=0).round(4)
        explored = [
            exploration_in_words(mask, self.agents) for mask in self.explored or [0] * len(self.reward)
        ]
        ways = [f" ({text}: chosen at random)" if text else "" for text in explored]
        for action in self.actions:
            own = [i for i, agent in enumerate(self.agents) if spoken(action.agent) in ("", agent)]
            names = [self.agents[i] for i in own]
            taken = [action.values[i] + way for i, way in zip(action.at, ways, strict=True)]
            yield words(
                action.agent, "last action", ["" if self.first else "none yet: the episode begins", *taken]
            )
            yield words(action.agent, "reward", ["", *(_signed(names, row) for row in rewards[1:, own])])
            if self.events:
                events = [
                    ", ".join(name for i, name in enumerate(self.events) if mask >> i & 1) or "none"
                    for mask in self.event
                ]
                yield words(action.agent, "events", ["", *events])
            yield words(action.agent, "return so far", [_signed(names, row) for row in returns[:, own]])


def words(agent: str, name: str, texts: Iterable[str]) -> Words:
    """Return texts with each different one stored once."""
    numbers: dict[str, int] = {}
    at = [numbers.setdefault(text, len(numbers)) for text in texts]
    return Words(agent, name, list(numbers), at)


def _signed(names: Sequence[str], values: Floats) -> str:
    """Return the rewards of agents as text, without the name where there is one only."""
    texts = [
        f"{'+' * (value > 0)}{value:.10g}" if math.isfinite(value) else str(short(value))
        for value in values.tolist()
    ]
    return ", ".join(map("{} {}".format, names, texts)) if len(names) > 1 else "".join(texts)


def outcome_in_words(length: int, ended: str, total: float | None) -> str:
    """Return length, end and return of an episode as text; a return of None is unknown."""
    rewards = "" if total is None else f" Rewards sum to {total:g}."
    return f"{counted(length, 'step')}, {ENDINGS[ended]}.{rewards}"


def frame_times(after: Ints) -> list[int]:
    """Return the number of steps of the run before each of T + 1 frames, from those after T steps."""
    return [int(after[0]) - 1, *after.tolist()]


def logged_near(recording: Recording, phase: str, time: Sequence[int]) -> list[Logged]:
    """Return what was logged near frames: a loop's numbers and texts, or a job's reports of training.

    `time` is that of the frames, as `Playback.time`; values logged in another phase than theirs are marked.
    """
    tick = schema.STEP_NANOSECONDS
    times = range(max(0, time[0] - _NEAR) * tick, (time[-1] + _NEAR) * tick + 1)
    entries: Iterator[tuple[str, int, Value]]
    if recording.eval.has_metrics:
        entries = (
            (name.replace("_", " "), report["log_time"], short(report[name]))
            for report in recording.train.metrics.decoded(times=times)
            for name in ("epsilon", "step_size", "mean_length")
        )
    else:
        scalars = (
            (
                scalar["name"] if scalar["phase"] == phase else f"{scalar['name']} ({scalar['phase']})",
                scalar["log_time"],
                short(scalar["value"]),
            )
            for scalar in recording.table(schema.SCALAR_TOPIC).decoded(times=times)
        )
        texts = (
            (text["name"], text["log_time"], text["message"][:_MAX_LETTERS])
            for text in recording.table(schema.LOG_TOPIC).decoded(times=times)
        )
        entries = islice(chain(scalars, texts), MAX_LOGGED)
    by_name: dict[str, Logged] = {}
    for name, log_time, value in entries:
        logged = by_name.setdefault(name[:_MAX_LETTERS], Logged(name[:_MAX_LETTERS], [], []))
        logged.at.append(log_time // tick)
        logged.values.append(value)
    return list(by_name.values())


def short(value: float) -> Value:
    """Round a number to five significant digits; NaN and infinities are texts."""
    if not np.isfinite(value):
        return "NaN" if np.isnan(value) else "inf" if value > 0 else "-inf"
    rounded = float(f"{value:.5g}")
    return int(rounded) if rounded == int(rounded) else rounded


def short_rows(rows: Array) -> list[list[Value]]:
    """Round the numbers of rows."""
    return [[short(value) for value in row] for row in rows.tolist()]
