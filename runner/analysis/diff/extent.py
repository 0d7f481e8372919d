"""How much two runs differ: in training after they diverged, visits to states, Q-tables and metrics.

Q-tables are compared at the steps of which both runs have a snapshot; curves of metrics at the end, in
area, and where each first reaches a level.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final, Generic, TypeVar

import numpy as np

from runner.analysis.axes import first_crossing, mean_height
from runner.analysis.diff.divergence import FIELDS, differing_steps, unbroken
from runner.analysis.series import (
    full_name,
    lines_in,
    points_of,
    read_series,
)
from runner.environments.mdp import Mdp
from runner.environments.naming import action_names, actions_in_words, states_in_words
from runner.errors import RecordingError, RunnerError, nearest
from runner.recording.messages import QTable
from runner.recording.metrics import METRICS, is_higher_better
from runner.recording.reader import Recording
from runner.replay.steps import step_of_episode
from runner.util.arrays import Floats, Ints, Records

T = TypeVar("T")
_MAX_STATES: Final = 5
"""States that are named."""
_MAX_CELLS: Final = 5
"""Cells with the largest differences that are listed."""
_ALIGNED: Final = FIELDS[2:]
"""The fields compared of steps of the same time in the same episode."""
_COMPARED: Final = (
    *(metric.name for metric in METRICS),
    "training.mean_length",
    "training.percent_filled",
    "training.mean_return",
)


# --- training -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Overlap:
    """How far two runs' training is the same, aligned by episode and time in it."""

    steps_a: int
    steps_b: int
    episodes: int
    """Episodes that both runs have."""
    equal_episodes: int
    """Episodes that are the same step by step."""
    equal_steps: int
    """Steps that agree with the other run's step of the same episode and time."""
    compared_steps: int
    """Steps of the longer of each two episodes."""
    mean_length_a: float
    mean_length_b: float


@dataclass(frozen=True)
class StateVisits:
    """How often two runs acted in a state, given by its name."""

    state: str
    a: int
    b: int


@dataclass(frozen=True)
class VisitsDiff:
    """How the training steps of two runs spread over the states."""

    states_a: int
    """States that A acted in at all."""
    states_b: int
    alike: float
    """Overlap of the two distributions over states, 0 to 1: the sum of the lower share of each state."""
    most_apart: list[StateVisits]
    """The states whose shares of all steps differ most."""


def training_overlap(a: Recording, b: Recording) -> tuple[Overlap, tuple[Ints, Ints]]:
    """Return how far the training of two runs is the same, and the visits to each state, [S], of either."""
    episodes = min(_whole_episodes(recording) for recording in (a, b))
    visits = np.zeros(a.mdp.states, np.int64), np.zeros(b.mdp.states, np.int64)
    streams = [
        _counted_steps(recording, episodes, counts) for recording, counts in zip((a, b), visits, strict=True)
    ]
    equal_steps = compared = 0
    are_equal = np.ones(episodes, np.bool_)
    for left, right, shared_a, shared_b in _side_by_side(*streams):
        compared += len(left) + len(right) - len(shared_a)
        alike = left["state"][shared_a] == right["state"][shared_b]  # most steps that differ do so there
        ours, theirs = shared_a[alike], shared_b[alike]
        pairs = [
            _without_fields(steps)[at].view(steps.dtype) for steps, at in ((left, ours), (right, theirs))
        ]
        agree = np.flatnonzero(~differing_steps(pairs[0], pairs[1], _ALIGNED))
        equal_steps += len(agree)
        for steps, at in ((left, ours[agree]), (right, theirs[agree])):
            are_equal[np.delete(steps["episode"], at)] = False
    overlap = Overlap(
        steps_a=a.train.steps.count(),
        steps_b=b.train.steps.count(),
        episodes=episodes,
        equal_episodes=int(are_equal.sum()),
        equal_steps=equal_steps,
        compared_steps=compared,
        mean_length_a=step_of_episode(a, episodes) / max(episodes, 1),
        mean_length_b=step_of_episode(b, episodes) / max(episodes, 1),
    )
    return overlap, visits


def visits_diff(mdp: Mdp, a: Ints, b: Ints) -> VisitsDiff:
    """Return how two runs' visits to states, [S] each, differ."""
    shares = [visits / max(visits.sum(), 1) for visits in (a, b)]
    apart = np.abs(shares[0] - shares[1])
    words = states_in_words(mdp)
    most = [int(state) for state in np.argsort(-apart, kind="stable")[:_MAX_STATES] if apart[state] > 0]
    return VisitsDiff(
        states_a=int(np.count_nonzero(a)),
        states_b=int(np.count_nonzero(b)),
        alike=float(np.minimum(*shares).sum()),
        most_apart=[StateVisits(str(words[state]), int(a[state]), int(b[state])) for state in most],
    )


def _whole_episodes(recording: Recording) -> int:
    """Return how many episodes of training precede the first that lost a step or its end."""
    steps, episodes = unbroken(recording)
    return min(episodes, recording.train.episodes.first_from("last_step", steps))


def _counted_steps(recording: Recording, episodes: int, visits: Ints) -> Iterator[Records]:
    """Yield the steps of the first episodes in blocks; add the visits of all steps to those of each state."""
    states, last = len(visits), -1
    for block in recording.train.steps.blocks():
        times = _times(block)
        if (np.diff(times, prepend=last) <= 0).any():  # else the two runs could not be aligned
            raise RecordingError(
                f"{recording.path}: found training steps out of order, from step {block['step'][0]} on; "
                "`dualtaxi verify` names the step."
            )
        last = times[-1]
        if (highest := int(block["state"].max(initial=0))) >= states:
            raise RecordingError(
                f"{recording.path}: found state {highest} in training step {block['step'][0]} or soon after, "
                f"expected less than {states}; `dualtaxi verify` names the step."
            )
        visits += np.bincount(block["state"], minlength=states)
        if count := np.searchsorted(block["episode"], episodes):
            yield block[:count]


def _side_by_side(
    a: Iterator[Records], b: Iterator[Records]
) -> Iterator[tuple[Records, Records, Ints, Ints]]:
    """Yield the steps of two runs in parts that end at the same time of the same episode.

    Also the numbers, in either part, of the steps that both runs have.
    """
    left, right = next(a, None), next(b, None)
    while left is not None and right is not None:
        ours, theirs = _times(left), _times(right)
        last = min(ours[-1], theirs[-1])
        n, m = (np.searchsorted(times, last, side="right") for times in (ours, theirs))
        at = np.searchsorted(theirs, ours).clip(max=len(theirs) - 1)
        both = np.flatnonzero(theirs[at] == ours)
        yield left[:n], right[:m], both, at[both]
        left = left[n:] if n < len(left) else next(a, None)
        right = right[m:] if m < len(right) else next(b, None)
    for rest, others in ((left, a), (right, b)):
        for steps in itertools.chain([] if rest is None else [rest], others):
            yield steps, steps[:0], np.empty(0, np.int64), np.empty(0, np.int64)


def _times(steps: Records) -> Ints:
    """Return a number for each step that grows with its episode, and its time in it."""
    times: Ints = (steps["episode"].astype(np.int64) << 32) + steps["t"]
    return times


def _without_fields(steps: Records) -> Records:
    """Return steps as plain bytes: NumPy copies fields one by one, and this ten times as fast."""
    return steps.view(f"V{steps.itemsize}")


# --- Q-tables -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ActionDiff(Generic[T]):
    """An action in a state, by their names, and what differs there between two runs."""

    state: str
    action: str
    a: T
    b: T


@dataclass(frozen=True)
class TableDiff:
    """Two runs' tables of one agent after the same number of training episodes."""

    episode: int
    agent: str
    largest: float
    mean: float
    """Mean of the absolute difference over all cells."""
    greedy_share: float
    """Share of the states in which the greedy action differs."""
    greedy_share_visited: float
    """The same, each state weighted by its visits in both runs' training; nan without steps."""
    cells: list[ActionDiff[float]]
    """Where the difference is largest."""


def table_diffs(a: Recording, b: Recording, visits: Ints | None) -> Iterator[TableDiff]:
    """Yield the differences of the tables, of the same shapes, that both runs have snapshots of.

    `visits` is how often each state was acted in, [S], both runs together.
    """
    weights = visits if visits is not None and visits.sum() else None
    for left, right in common_snapshots(a, b):
        apart = np.abs(left.values - right.values)
        other = left.values.argmax(axis=1) != right.values.argmax(axis=1)
        yield TableDiff(
            episode=left.episode,
            agent=left.agent,
            largest=float(apart.max()),
            mean=float(apart.mean()),
            greedy_share=float(other.mean()),
            greedy_share_visited=math.nan if weights is None else float(other @ weights / weights.sum()),
            cells=_largest_cells(a.mdp, left, right, apart),
        )


def common_snapshots(a: Recording, b: Recording) -> Iterator[tuple[QTable, QTable]]:
    """Yield the tables, of one shape, that both runs have after as many episodes."""
    theirs = b.snapshots()
    right = next(theirs, None)
    for left in a.snapshots():
        while right is not None and _moment(right) < _moment(left):
            right = next(theirs, None)
        if right is not None and _moment(right) == _moment(left) and right.values.shape == left.values.shape:
            states, actions = left.values.shape
            widths = {a.mdp.joint_actions, *a.mdp.action_counts}
            if states != a.mdp.states or actions not in widths:
                raise RecordingError(
                    f"{a.path}: found a Q-table of shape {left.values.shape}, expected {a.mdp.states} states "
                    f"and one of {sorted(widths)} actions."
                )
            yield left, right


def _moment(table: QTable) -> tuple[int, int]:
    return table.episode, table.table


def _largest_cells(mdp: Mdp, a: QTable, b: QTable, apart: Floats) -> list[ActionDiff[float]]:
    flat = apart.reshape(-1)
    # Faster than sorting all cells, for each snapshot.
    least = np.partition(flat, -_MAX_CELLS)[-_MAX_CELLS] if flat.size > _MAX_CELLS else 0.0
    candidates = np.flatnonzero(flat >= least)
    order = candidates[np.argsort(-flat[candidates], kind="stable")][:_MAX_CELLS]
    states = states_in_words(mdp)
    actions = own_actions_in_words(mdp, a.table, apart.shape[1])
    cells = []
    for cell in order.tolist():
        s, j = divmod(cell, apart.shape[1])
        if apart[s, j] > 0:
            cells.append(ActionDiff(str(states[s]), actions[j], float(a.values[s, j]), float(b.values[s, j])))
    return cells


def own_actions_in_words(mdp: Mdp, table: int, width: int) -> list[str]:
    """Return the words of the columns of table number `table`: joint actions, or one agent's own."""
    if width == mdp.joint_actions:
        return [str(words) for words in actions_in_words(mdp)]
    names = action_names(mdp)
    return names[table] if names else [f"action {j}" for j in range(width)]


# --- metrics ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MetricDiff:
    """One metric of two runs, over training episodes."""

    name: str
    episodes: list[int]
    """Episodes at which both have a value."""
    a: list[float]
    b: list[float]
    end_a: float
    """The last value of all, also where the other has none; of a loop's training the mean at its end."""
    end_b: float
    area: float
    """Mean difference b - a: the area between the curves over the episodes both have, by their span."""
    crossings: dict[str, tuple[int | None, int | None]]
    """Target level, as text, to the episodes at which a and b first reach it."""

    @property
    def same(self) -> bool:
        """Whether both curves are the same."""
        return self.a == self.b and self.end_a == self.end_b


def metric_diffs(a: Recording, b: Recording, targets: Mapping[str, float]) -> list[MetricDiff]:
    """Return how each metric of evaluations and of a loop's training differs.

    With the first crossing of each target's level.

    Raises:
        RunnerError: they have no metric of that name.
    """
    (curves_a, ends_a), (curves_b, ends_b) = _curves(a), _curves(b)
    names = [name for name in curves_a if name in curves_b]
    for name in targets:
        if name not in names:
            known = f"expected one of {', '.join(names)}" if names else "but both runs have no metric"
            raise RunnerError(f"target: found {name!r}, {known}.{nearest(name, names)}")
    diffs = []
    for name in names:
        left, right = curves_a[name], curves_b[name]
        episodes = sorted(left.keys() & right.keys())
        crossings = {}
        if (level := targets.get(name)) is not None:
            rising = is_higher_better(name, has_goal="success_percent" in names)
            crossings[f"{level:g}"] = (
                first_crossing(left, level, rising),
                first_crossing(right, level, rising),
            )
        diffs.append(
            MetricDiff(
                name=name,
                episodes=episodes,
                a=[left[episode] for episode in episodes],
                b=[right[episode] for episode in episodes],
                end_a=ends_a[name],
                end_b=ends_b[name],
                area=mean_height(episodes, [right[episode] - left[episode] for episode in episodes]),
                crossings=crossings,
            )
        )
    return diffs


def _curves(recording: Recording) -> tuple[dict[str, dict[int, float]], dict[str, float]]:
    """Return metric to episode to value, without values that are unknown, and the value at the end of each.

    Training is compared at the evaluations of a job, and over the episodes of a loop that ended; a loop's
    training ends with the mean over its last episodes, as in `ls` and `show`.
    """
    curves: dict[str, dict[int, float]] = {}
    ends: dict[str, float] = {}
    series = read_series(recording, metrics=_COMPARED)
    compared = set(_COMPARED)
    if series.is_unended or (series.can_train_again and not series.evaluation):
        compared = {name for name in compared if not name.startswith("training.")}
    for metric, line in lines_in([series]):
        if metric in compared and (points := points_of(series, metric, line, aligned=True)):
            name = full_name(metric, line)
            curves[name] = {int(episode): value for episode, value in points.items()}
            ends[name] = series.recent.get(metric, {}).get(line, points[max(points)])
    return curves, ends
