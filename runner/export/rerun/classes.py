"""Text by number: labels that differ from step to step cost two bytes each, not a string.

Rerun looks up the label and colour of a class id in an annotation context, which is logged once. What is
said at every step (who carries whom, what went wrong, the step, the reward, values) is numbered here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.drawing import palette
from runner.environments.mdp import Mdp
from runner.environments.naming import action_names, numbered_actions, spoken
from runner.export.rerun.scene import Marks, Scene

MOST_REWARDS: Final = 2_000
MOST_T: Final = 10_000
_LEVELS: Final = 4_000


@dataclass
class Classes:
    """The labels of a run and their numbers."""

    labels: list[str] = field(default_factory=list)
    colours: list[str] = field(default_factory=list)

    def add(self, labels: Sequence[str], colours: str | Sequence[str] = palette.MIDTONE) -> int:
        """Take in labels; return the number of the first."""
        first = len(self.labels)
        self.labels += labels
        self.colours += [colours] * len(labels) if isinstance(colours, str) else colours
        return first

    def context(self) -> list[tuple[int, str, tuple[int, int, int]]]:
        """Return (number, label, colour) of all."""
        return [
            (number, label, palette.rgb(colour))
            for number, (label, colour) in enumerate(zip(self.labels, self.colours, strict=True))
        ]


@dataclass(frozen=True, eq=False)
class Vocabulary:
    """Where each kind of label begins among a run's classes."""

    classes: Classes
    mark: int
    """The marks of `Marks`, in order."""
    passenger: int
    riding: int
    """A passenger that is being carried: who carries it says so."""
    t: int
    rewards: tuple[tuple[int, NDArray[np.float64]], ...]
    """A learner: its first label, and the rewards it can get, ascending."""
    values: Levels
    unmarked: int
    """No mark."""
    greedy: int
    """The mark of a greedy action."""
    chosen: int
    """What is said of the chosen action if it was not explored."""
    explored: int
    stops: tuple[NDArray[np.int64], ...]
    """[own actions] an agent: the letter of an action that is no move, such as a pickup; -1 for a move."""

    def of_t(self, t: NDArray[Any]) -> NDArray[np.uint16]:
        """Return the class of each `t`."""
        return np.asarray(self.t + np.minimum(t, MOST_T), np.uint16)

    def of_rewards(self, rewards: NDArray[np.float64]) -> NDArray[np.uint16]:
        """Return the class of each learner's reward, [n, learners that have any]."""
        numbered = [
            first + np.searchsorted(known, rewards[:, i]).clip(max=len(known) - 1)
            for i, (first, known) in enumerate(self.rewards)
        ]
        return np.stack(numbered, axis=1).astype(np.uint16)


@dataclass(frozen=True)
class Levels:
    """Values as text, rounded to a multiple of `unit`."""

    first: int
    lowest: int
    """The lowest multiple that has a label."""
    count: int
    unit: float

    def of(self, values: NDArray[np.float64]) -> NDArray[np.uint16]:
        """Return the class of each value; beyond the labelled range the class of its end."""
        level = np.rint(np.nan_to_num(values) / self.unit) - self.lowest
        return np.asarray(self.first + level.clip(0, self.count - 1), np.uint16)


def vocabulary_of(
    mdp: Mdp,
    scene: Scene | None,
    marks: Marks | None,
    learners: Sequence[str],
    value_range: tuple[float, float],
) -> Vocabulary:
    """Return every label of a run; `value_range` is that of its tables."""
    classes = Classes()
    mark = classes.add(marks.labels, marks.colours) if marks else 0
    things = scene.description["things"] if scene else []
    waiting = [things[thing]["label"] for thing in scene.passengers] if scene else []
    passenger = classes.add(waiting, palette.PASSENGER)
    riding = classes.add([""], palette.PASSENGER)
    longest = min(mdp.step_limit or MOST_T, MOST_T)
    t = classes.add([f"t = {k}" for k in range(longest)] + [f"t ≥ {longest}"])
    rewards = mdp.rewards_of(len(learners))
    told = []
    for i, learner in enumerate(learners):
        distinct = np.unique(rewards[..., i])
        whose = f" of {spoken(learner)}" if len(learners) > 1 else ""
        if len(distinct) <= MOST_REWARDS:
            colour = palette.agent(i) if whose else palette.MIDTONE
            told.append((classes.add([f"reward{whose} {_signed(r)}" for r in distinct], colour), distinct))
    unmarked = classes.add(
        ["", "●", "greedy", "explored"], [palette.MIDTONE, palette.MIDTONE, palette.GOOD, palette.BAD]
    )
    stops = tuple(_stops(classes, scene, agent) for agent in range(len(mdp.agents))) if scene else ()
    levels = _levels(classes, value_range)
    return Vocabulary(
        classes,
        mark,
        passenger,
        riding,
        t,
        tuple(told),
        levels,
        unmarked=unmarked,
        greedy=unmarked + 1,
        chosen=unmarked + 2,
        explored=unmarked + 3,
        stops=stops,
    )


def _stops(classes: Classes, scene: Scene, agent: int) -> NDArray[np.int64]:
    names = numbered_actions(scene.mdp)[agent]
    numbers = np.full(len(names), -1)
    if action_names(scene.mdp) is None:
        return numbers
    colour = palette.agent(agent)
    for own, action in enumerate(scene.description["actions"]):
        if not any(action.get("move") or ()):
            numbers[own] = classes.add([names[own][0].upper()], colour)
    return numbers


def _levels(classes: Classes, value_range: tuple[float, float]) -> Levels:
    """Return levels that tell three digits of the greatest value, with room on both sides."""
    low, high = min(value_range[0], 0.0), max(value_range[1], 0.0)
    greatest = max(-low, high, 1e-9)
    unit = 10.0 ** (math.floor(math.log10(greatest)) - 2)
    while (high - low) / unit > _LEVELS:
        unit *= 10
    room = (high - low) / 2 + unit
    lowest, highest = math.floor((low - room) / unit), math.ceil((high + room) / unit)
    digits = max(0, -round(math.log10(unit)))
    labels = [_signed(round(k * unit, digits), digits) for k in range(lowest, highest + 1)]
    labels[0], labels[-1] = f"≤ {labels[0]}", f"≥ {labels[-1]}"
    return Levels(classes.add(labels), lowest, len(labels), unit)


def _signed(value: float, digits: int | None = None) -> str:
    text = f"{value:g}" if digits is None else f"{value:.{digits}f}"
    return text.replace("-", "−")
