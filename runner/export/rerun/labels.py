"""The labels of a run by number: two bytes at each step instead of a string.

Rerun looks up the text and colour of a class id in an annotation context, which is logged once. Everything
written at a step is numbered here: marks of movers, the step, rewards, values.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any, Final

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from runner.drawing import palette
from runner.environments.mdp import Mdp
from runner.environments.naming import numbered_actions, spoken
from runner.export.rerun.scene import Scene
from runner.export.rerun.tracks import Floats, Points, Track, pairs, repeated
from runner.util.arrays import Ints, Records

MAX_REWARDS: Final = 2_000
MAX_T: Final = 10_000
MAX_LEVELS: Final = 4_000
BAD_SIGN: Final = "✗"
GOOD_SIGN: Final = "✓"
STATUS_Y: Final = 0.35
"""From the grid to `t` and the rewards below it."""
STATUS_LINE: Final = 0.3
MOVER_LABEL_Y: Final = -0.5
"""From a mover to the top of its label: above what is drawn."""
PASSENGER_LABEL_Y: Final = 0.12


class GridLabels:
    """Texts and colours, numbered, and the numbers and points of what is written at each step.

    `value_range` is the lowest and the highest value of the tables, and includes 0.
    """

    def __init__(
        self,
        mdp: Mdp,
        scene: Scene | None,
        learners: Sequence[str],
        value_range: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        self.mdp = mdp
        self.scene = scene
        self.learners = tuple(learners)
        self.texts: list[str] = []
        self._colours: list[str] = []
        self._masks = np.unique(np.append(mdp.events, np.uint32(0)))
        """The sets of events that a step can have."""
        if scene:
            self._add_movers(scene)
            self._waiting = self._add([scene.labels[i] for i in scene.passengers], palette.PASSENGER)
        self._riding = self._add([""], palette.PASSENGER)
        """A passenger that is carried: the label of its carrier shows it."""
        self._longest = min(mdp.step_limit or MAX_T, MAX_T)
        self._t = self._add([f"t = {k}" for k in range(self._longest)] + [f"t ≥ {self._longest}"])
        self._rewards: list[tuple[int, int, Floats]] = []
        """Learner, first label, and the rewards it can get, ascending."""
        rewards = mdp.rewards_of(len(learners))
        is_alone = len(learners) == 1
        for i, learner in enumerate(learners):
            distinct = np.unique(rewards[..., i])
            if len(distinct) <= MAX_REWARDS:
                prefix = "reward" if is_alone else f"reward of {spoken(learner)}"
                colour = palette.MIDTONE if is_alone else palette.agent(i)
                first = self._add([f"{prefix} {reward:g}" for reward in distinct], colour)
                self._rewards.append((i, first, distinct))
        self.unmarked = self._add([""])
        self.greedy = self._add(["●"])
        """The mark of the greedy action."""
        self.exploited = self._add(["greedy"], palette.GOOD)
        """The mark of the chosen action if it was not explored."""
        self.explored = self._add(["explored"], palette.BAD)
        self.stops = np.full((len(mdp.agents), max(mdp.action_counts) + 1), -1)
        """[agents, own actions + 1]: the letter of an action such as a pickup; -1 for a move or none."""
        for agent, names in enumerate(numbered_actions(mdp)):
            if scene:
                for own in scene.stops:
                    self.stops[agent, own] = self._add([names[own][0].upper()], palette.agent(agent))
        self._add_levels(*value_range)

    def track(self) -> Track:
        """Return the texts and colours of everything below an entity path."""
        classes = [
            {
                "class_id": number,
                "class_description": {
                    "info": {"id": number, "label": text, "color": int(f"{colour[1:]}ff", 16)},
                    "keypoint_annotations": [],
                    "keypoint_connections": [],
                },
            }
            for number, (text, colour) in enumerate(zip(self.texts, self._colours, strict=True))
        ]
        # As Arrow, because Rerun is slow to convert thousands of labels.
        context: Any = pa.array([classes], rr.components.AnnotationContext.arrow_type())
        return Track("", static=[rr.AnnotationContext(context)])

    @cached_property
    def points(self) -> Points:
        """[S, texts, 2]: where the texts of each state are; `t` and the rewards below the grid."""
        scene = self.scene
        assert scene is not None
        rises = [MOVER_LABEL_Y] * len(scene.movers) + [PASSENGER_LABEL_Y] * len(scene.passengers)
        y = scene.rows + STATUS_Y
        left = 0.25 * scene.columns
        right = 0.65 * scene.columns
        rewards = ((right, y + STATUS_LINE * k) for k in range(len(self._rewards)))
        status = repeated(pairs([(left, y), *rewards]), len(scene.points))
        return np.concatenate((scene.points + pairs((0, rise) for rise in rises), status), axis=1)

    @cached_property
    def _of_states(self) -> Ints:
        """[S, movers + passengers]: the labels in each state, of movers in a step without events."""
        scene = self.scene
        assert scene is not None
        is_carrying = (scene.carriers[..., None] == np.array(scene.movers, np.int64)).any(axis=1)
        movers = 2 * np.arange(len(scene.movers)) + is_carrying
        waiting = self._waiting + np.arange(len(scene.passengers))
        passengers = np.where(scene.carriers[:, scene.passengers] >= 0, self._riding, waiting)
        return np.concatenate((movers * len(self._masks), passengers), axis=1)

    def of_steps(self, records: Records, events: NDArray[np.uint32]) -> NDArray[np.uint16]:
        """Return the label of each text in each step, [n, texts].

        Movers have their name and what happened to them.
        """
        assert self.scene is not None
        things = self._of_states.take(records["state"], axis=0)
        things[:, : len(self.scene.movers)] += np.searchsorted(self._masks, events)[:, None]
        labels = [things, self._t + np.minimum(records["t"], self._longest)[:, None]]
        for i, first, distinct in self._rewards:
            number = np.searchsorted(distinct, records["rewards"][:, [i]])
            labels.append(first + number.clip(max=len(distinct) - 1))
        return np.concatenate(labels, axis=1, dtype=np.uint16, casting="unsafe")

    def of_values(self, values: Floats) -> NDArray[np.uint16]:
        """Return the label of each value."""
        levels = np.rint(np.nan_to_num(values, posinf=np.inf, neginf=-np.inf) / self._unit) - self._lowest
        return (self._levels + levels.clip(0)).clip(max=len(self.texts) - 1).astype(np.uint16)

    def _add(self, texts: Sequence[str], colour: str = palette.MIDTONE) -> int:
        """Add texts; return the number of the first."""
        first = len(self.texts)
        self.texts += texts
        self._colours += [colour] * len(texts)
        return first

    def _add_movers(self, scene: Scene) -> None:
        """Number each mover's label by whether it carries someone, and by the events of a step."""
        for i, (mover, agent) in enumerate(zip(scene.movers, scene.agents, strict=True)):
            for carried in ("", " + passenger"):
                for mask in self._masks.tolist():
                    events = ", ".join(_event_labels(scene.mdp, mask, agent))
                    text = ": ".join(filter(None, (scene.labels[mover] + carried, events)))
                    self._add([text], palette.BAD if BAD_SIGN in events else palette.agent(i))

    def _add_levels(self, low: float, high: float) -> None:
        """Number values to three digits of the greatest one, with a margin on both sides."""
        self._unit = 10.0 ** (math.floor(math.log10(max(-low, high, 1e-9))) - 2)
        while (high - low) / self._unit > MAX_LEVELS:
            self._unit *= 10
        margin = (high - low) / 2 + self._unit
        self._lowest = math.floor((low - margin) / self._unit)
        highest = math.ceil((high + margin) / self._unit)
        digits = max(0, -round(math.log10(self._unit)))
        texts = [f"{k * self._unit:.{digits}f}" for k in range(self._lowest, highest + 1)]
        texts[0], texts[-1] = f"≤ {texts[0]}", f"≥ {texts[-1]}"
        self._levels = self._add(texts)
        """The first level; the others are the last labels."""


def _event_labels(mdp: Mdp, mask: int, agent: str | None) -> list[str]:
    """Return the events of a mask that concern one agent, or all of them, each with a sign."""
    labels = []
    for bit, name in enumerate(mdp.event_names):
        owner, _, event = name.rpartition(".")
        if mask >> bit & 1 and owner in ("", agent):
            is_bad = owner == "" or (name not in mdp.success_events and event != "pickup")
            labels.append(f"{BAD_SIGN if is_bad else GOOD_SIGN} {spoken(event)}")
    return labels
