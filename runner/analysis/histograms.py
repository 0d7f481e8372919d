"""Histograms over training: returns and lengths of episodes, actions and rewards of steps, as heat maps.

A recording is read twice, a block at a time: for the ranges and the distinct values, then for the counts.
Memory is bounded, however long the run is.
"""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from runner.analysis.axes import EPISODES, Axis, Positions, edges_of, positions, stretches_at
from runner.analysis.series import lines_of
from runner.environments.naming import numbered_actions, spoken
from runner.recording.metrics import is_usable
from runner.recording.reader import Recording
from runner.recording.spaces import decode
from runner.util.arrays import Array, Floats, Ints, leaves

Quantity = Literal["return", "length", "action", "reward"]
Block = tuple[Floats, Mapping[tuple[Quantity, str], Array]]
"""The positions of a block of records, and its values by quantity and line."""

_UNITS: Final[Mapping[Quantity, str]] = {
    "return": "summed reward",
    "length": "steps",
    "action": "action",
    "reward": "reward of a step",
}
STRETCHES: Final = 60
"""The most stretches of training."""
_FEWEST: Final = 10
_EPISODES_EACH: Final = 6
"""Episodes of a stretch on average, so that its shares mean something; at least `_FEWEST` stretches."""
LEVELS: Final = 30
"""Ranges of values, where these are not few distinct ones."""
_MAX_DISTINCT: Final = 20
_MAX_PARTS: Final = 6
"""Numbers of an action, or agents, that have a histogram of their own."""


@dataclass(frozen=True)
class ValueCounts:
    """The counts of a quantity over an axis."""

    quantity: Quantity
    line: str
    """An agent, or a part of an action; empty if there is one."""
    unit: str
    axis: str
    """The name of the axis."""
    edges: list[float]
    """The positions at which stretches begin and end, ascending."""
    values: list[float]
    """The distinct values, ascending, or else the edges of the ranges."""
    names: list[str]
    """The names of the distinct values; empty where there are ranges."""
    counts: list[list[int]]
    """[stretches][values or ranges]: a list for each stretch."""
    left_out: int
    """Number of values that are infinite, NaN or too large."""


@dataclass
class _QuantityCounts:
    """A quantity whose values are being counted."""

    low: float = np.inf
    high: float = -np.inf
    distinct: set[float] = field(default_factory=set)
    left_out: int = 0
    counts: Ints = field(default_factory=lambda: np.zeros((0, 0), np.int64))
    levels: Floats = field(default_factory=lambda: np.empty(0))

    @property
    def is_distinct(self) -> bool:
        return len(self.distinct) <= _MAX_DISTINCT

    def scan(self, values: Floats) -> None:
        """Extend the range and the distinct values."""
        usable = values[is_usable(values)]
        self.left_out += len(values) - len(usable)
        if len(usable):
            self.low = min(self.low, float(usable.min()))
            self.high = max(self.high, float(usable.max()))
            if self.is_distinct:
                for value in self.distinct:
                    usable = usable[usable != value]  # faster than sorting a block of the same few values
            if self.is_distinct and len(usable):
                self.distinct.update(np.unique(usable)[: _MAX_DISTINCT + 1].tolist())

    def begin(self, stretches: int) -> None:
        """Lay out the counts."""
        self.levels = (
            np.array(sorted(self.distinct))
            if self.is_distinct
            else np.linspace(self.low, self.high, LEVELS + 1)
        )
        self.counts = np.zeros((stretches, len(self.levels) - (not self.is_distinct)), np.int64)

    def count(self, stretches: NDArray[np.intp], values: Floats) -> None:
        """Count the values of a block, each in its stretch."""
        usable = is_usable(values)
        side = "left" if self.is_distinct else "right"
        level = np.searchsorted(self.levels, values[usable], side) - (not self.is_distinct)  # type: ignore[call-overload]
        width = self.counts.shape[1]
        flat = stretches[usable] * width + level.clip(0, width - 1)
        self.counts += np.bincount(flat, minlength=self.counts.size).reshape(self.counts.shape)


def histograms(recording: Recording, axis: Axis = EPISODES) -> tuple[list[ValueCounts], list[str]]:
    """Return the histograms of a recording's training over an axis, and what is left out, a sentence each.

    Returns and lengths are at the ends of episodes, actions and rewards at their steps.
    """
    moments = positions(recording, axis)
    done = recording.done()
    last = float(moments.at(done["episodes"], done["train_steps"]))
    result: list[ValueCounts] = []
    notes: list[str] = []
    for read in (_episodes, _steps):
        few = min(STRETCHES, max(_FEWEST, done["episodes"] // _EPISODES_EACH))
        edges = edges_of(axis, last, few if read is _episodes else STRETCHES)
        columns: defaultdict[tuple[Quantity, str], _QuantityCounts] = defaultdict(_QuantityCounts)
        for _, block in read(recording, moments, notes):
            for key, values in block.items():
                columns[key].scan(values.astype(np.float64))
        in_use = {key: column for key, column in columns.items() if column.distinct}
        for column in in_use.values():
            column.begin(len(edges) - 1)
        for at, block in read(recording, moments, []):
            stretches = stretches_at(edges, at)
            for key, values in block.items():
                if key in in_use:
                    in_use[key].count(stretches, values.astype(np.float64))
        for (quantity, line), column in in_use.items():
            levels = column.levels.tolist()
            names = _action_names(recording, line) if quantity == "action" else {}
            result.append(
                ValueCounts(
                    quantity=quantity,
                    line=line,
                    unit=_UNITS[quantity],
                    axis=axis.name,
                    edges=edges.tolist(),
                    values=levels,
                    names=[names.get(level, f"{level:,.6g}") for level in levels if column.is_distinct],
                    counts=column.counts.tolist(),
                    left_out=column.left_out,
                )
            )
    for histogram in result:
        if histogram.left_out:
            part = f" of {spoken(histogram.line)}" if histogram.line else ""
            notes.append(
                f"{histogram.left_out:,} values of {histogram.quantity}{part} are left out, as they are "
                "infinite, not a number or too large."
            )
    return result, list(dict.fromkeys(notes))


def _episodes(recording: Recording, moments: Positions, _notes: list[str]) -> Iterator[Block]:
    for block in recording.train.episodes.blocks():
        values: dict[tuple[Quantity, str], Array] = {("length", ""): block["length"]}
        for i, line in enumerate(lines_of(recording.agents)[:_MAX_PARTS]):
            values["return", line] = block["returns"][:, i]
        yield moments.at(block["episode"] + 1, block["last_step"] + 1), values


def _steps(recording: Recording, moments: Positions, notes: list[str]) -> Iterator[Block]:
    if not recording.train.steps:
        notes.append("Rewards have no histogram, as no whole steps of training were recorded.")
    for block in recording.train.steps.taken():
        values: dict[tuple[Quantity, str], Array] = {}
        if "rewards" in (block.dtype.names or ()):
            for i, line in enumerate(lines_of(recording.agents)[:_MAX_PARTS]):
                values["reward", line] = block["rewards"][:, i]
        for part, numbers in _parts(recording, block["action"], notes).items():
            values["action", part] = numbers
        yield moments.at(block["episode"] + 1, block["step"] + 1), values


def _parts(recording: Recording, actions: Array, notes: list[str]) -> dict[str, Array]:
    """Return the numbers of actions by part: an agent, a field or an index; empty for a single number."""
    if recording.tabular:
        numbers = recording.mdp.own_actions[actions]
        return {agent: numbers[:, i] for i, agent in enumerate(lines_of(recording.mdp.agents))}
    if actions.dtype.hasobject:  # as observations or actions vary in size
        values = [decode(recording.spaces["action"], action, str(recording.path)) for action in actions]
        are_arrays = all(isinstance(value, np.ndarray | np.generic) for value in values)
        actions = np.array(values if are_arrays else [None] * len(values))
    parts = {part: column for part, column in _numbers(actions) if column.dtype.kind in "biuf"}
    if not parts:
        notes.append("Actions have no histogram, as they are not numbers of one shape.")
    if len(parts) > _MAX_PARTS:
        notes.append(f"Of {len(parts):,} parts of an action the first {_MAX_PARTS} have a histogram.")
    return dict(itertools.islice(parts.items(), _MAX_PARTS))


def _numbers(actions: Array) -> Iterator[tuple[str, Array]]:
    for path, values in leaves("", actions):
        columns = values.reshape(len(values), math.prod(values.shape[1:])).T
        for i, column in enumerate(columns):
            yield path if len(columns) == 1 else f"{path}[{i}]", column


def _action_names(recording: Recording, part: str) -> dict[float, str]:
    """Return the names of the discrete actions of a part, by number."""
    start = 0
    if recording.tabular:
        agents = recording.mdp.agents
        names = tuple(numbered_actions(recording.mdp)[agents.index(part) if part else 0])
    else:
        agent = part if part in recording.agents else ""
        names = recording.train.action_names(agent) if agent or not part else ()
        start = 0 if recording.has_states else int(recording.spaces["action"].get("start", 0))
    return {float(start + i): spoken(name) for i, name in enumerate(names)}
