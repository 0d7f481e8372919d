"""The scene of an environment for the viewer: where everything is in each state, and its labels.

Coordinates are cells: x to the right, y down, the first cell from (0, 0) to (1, 1). Rerun looks up the text
and colour of a class id in an annotation context, which is logged once, after the steps. So everything
written at a step is numbered here (marks of movers, the step, rewards, values): two bytes at each step
instead of a string.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, partial
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from runner.drawing import palette
from runner.drawing.svg import VEHICLES, wall_ends
from runner.environments.mdp import Mdp, SceneDescription
from runner.environments.naming import action_names, numbered_actions, spoken, states_in_words
from runner.export.rerun.tracks import (
    GREY,
    Points,
    Track,
    TrackView,
    centred,
    labels_alone,
    pairs,
    repeated,
)
from runner.util.arrays import Array, Floats, Ints, Records

_SPACING: Final = 0.34
"""Between movers in one cell, so that both are visible."""
_BLOCKED_ARROW: Final = 0.34
"""Length of the arrow of a move that led nowhere."""

MAX_LABELS: Final = 60_000
"""Different texts in a run; further ones are left out."""
BAD_SIGN: Final = "✗"
GOOD_SIGN: Final = "✓"
STATUS_Y: Final = 0.35
"""From the grid to `t` and the rewards below it."""
STATUS_LINE: Final = 0.3
MOVER_LABEL_Y: Final = -0.5
"""From a mover to the top of its label: above what is drawn."""
PASSENGER_LABEL_Y: Final = 0.12


class SceneShape(NamedTuple):
    """A box filled by its thick, rounded line; lengths are in cells."""

    offset: tuple[float, float]
    half_size: tuple[float, float]
    radius: float
    colour: str = ""
    """Empty for the colour of its mover."""


CAR: Final = (
    SceneShape((-0.02, -0.1), (0.07, 0.025), 0.05),
    SceneShape((0.0, 0.02), (0.15, 0.025), 0.055),
    SceneShape((-0.1, 0.1), (0.01, 0.01), 0.04, palette.MIDTONE),
    SceneShape((0.1, 0.1), (0.01, 0.01), 0.04, palette.MIDTONE),
)
PAWN: Final = (SceneShape((0.0, -0.12), (0.02, 0.02), 0.07), SceneShape((0.0, 0.05), (0.05, 0.05), 0.06))
PERSON: Final = (
    SceneShape((0.0, -0.09), (0.01, 0.01), 0.04, palette.PASSENGER),
    SceneShape((0.0, 0.03), (0.02, 0.03), 0.045, palette.PASSENGER),
)


class Scene:
    """Arrays over S states. Movers come first among the things drawn, then passengers."""

    def __init__(self, mdp: Mdp, description: SceneDescription, cells: Ints) -> None:
        self.mdp, self.description, self.cells = mdp, description, cells
        """`cells`: where each thing is in each state."""
        carriers = self.carriers = mdp.carriers.astype(np.int64)
        things, self.rows, self.columns = description["things"], description["rows"], description["columns"]
        self.labels = [thing["label"] for thing in things]
        self.movers, self.goals = (
            [i for i, thing in enumerate(things) if thing["kind"] == kind] for kind in ("mover", "goal")
        )
        """Indices of the things that agents move, and of goals."""
        self.passengers = [i for i in range(len(things)) if i not in self.movers + self.goals]
        self.agents = [things[mover].get("agent") for mover in self.movers]
        """The name of the agent that moves each mover; None for none."""
        corners = np.stack((cells % self.columns, cells // self.columns), 2)
        self.centres = (corners + 0.5).astype(np.float32)
        """[S, things, 2]: the centre of each thing's cell."""
        places = self.centres.copy()
        places[:, self.movers] += pairs((x, x * 0.6 - 0.05) for x in centred(len(self.movers), _SPACING))
        places[:, self.passengers] += np.array([0.2, 0.26], np.float32)
        rides = np.isin(carriers, self.movers)[..., None]
        riding = np.where(rides, np.take_along_axis(places, carriers.clip(0)[..., None], 1), places)
        self.mover_points = places[:, self.movers]
        """[S, movers, 2]: where each mover is drawn."""
        self.points = np.concatenate((self.mover_points, riding[:, self.passengers]), axis=1)
        """[S, movers + passengers, 2]: where each is drawn."""
        labels = [self.labels[mover].split(" ")[0] for mover in self.movers]
        bodies = [CAR if label in VEHICLES else PAWN for label in labels] + [PERSON] * len(self.passengers)
        self.shapes = [shape for body in bodies for shape in body]
        """The boxes that are drawn."""
        self.owners = [owner for owner, body in enumerate(bodies) for _ in body]
        """The number of the mover or passenger that each box belongs to."""
        self.shape_centres = self.points[:, self.owners] + pairs(shape.offset for shape in self.shapes)
        """[S, shapes, 2]: the centre of each shape."""
        actions = description["actions"] if action_names(mdp) else ()
        moves = [action.get("move") or (0, 0) for action in actions]
        self.stops = [number for number, move in enumerate(moves) if not any(move)]
        """Actions of an agent that are no moves, such as a pickup, as far as actions have names."""
        moves = moves or [(0, 0)] * max(mdp.action_counts)
        self.own_moves = pairs([*(move[::-1] for move in moves), (0, 0)]) * np.float32(_BLOCKED_ARROW)
        """[own actions + 1, 2]: a short arrow for an agent's action; zero if it is no move, or none."""
        self.moves = np.zeros((mdp.joint_actions, len(self.movers), 2), np.float32)
        """[J, movers, 2]: the arrow of each mover's own action."""
        for i, agent in enumerate(self.agents):
            if agent in mdp.agents:
                self.moves[:, i] = self.own_moves[mdp.own_actions[:, mdp.agents.index(agent)]]

    @cached_property
    def placements(self) -> Placements | None:
        """The states by placement of the movers; None unless there are one or two movers."""
        return Placements(self) if len(self.movers) in (1, 2) else None


class Placements:
    """States by context, which is everything but the movers, and by where the movers are.

    The placements of a context form a picture. Its pixels are the cells of the first mover, within blocks; a
    block is a cell of the second mover.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        rows, columns = (scene.rows, scene.columns) if len(scene.movers) == 2 else (1, 1)
        self._shape = rows, scene.rows, columns, scene.columns
        """Rows of blocks, of cells in a block; columns of them."""
        self.height = rows * scene.rows
        self.width = columns * scene.columns
        cells = scene.cells[:, scene.movers]
        row, column = np.divmod(cells[:, 0], scene.columns)
        block_row, block_column = np.divmod(cells[:, 1:].sum(axis=1), scene.columns)
        self.pixel = np.ravel_multi_index((block_row, row, block_column, column), self._shape)
        """[S]: the pixel of each state."""
        things = scene.passengers + scene.goals
        carriers = scene.carriers[:, things]
        where = np.where(carriers >= 0, -1 - carriers, scene.cells[:, things])
        _, first, context = np.unique(where, axis=0, return_index=True, return_inverse=True)
        self.context = context.reshape(-1)
        """[S]: the number of each state's context."""
        words = [text.split(", ") for text in states_in_words(scene.mdp)[first]]
        names = [", ".join(word for i, word in enumerate(parts) if i not in scene.movers) for parts in words]
        self.names = np.array(names, object)
        """A description of each context: `passenger at R, destination B`."""
        self.states = np.full((len(first), self.height * self.width), -1, np.int32)
        """[contexts, pixels]: the state at each pixel, row by row; -1 for none."""
        self.states[self.context, self.pixel] = np.arange(scene.mdp.states)

    def order(self, mover: int) -> Ints:
        """Return the pixels in the order of the picture whose blocks hold the cells of that mover."""
        pixels = np.arange(self.height * self.width)
        return pixels.reshape(self._shape).transpose(1, 0, 3, 2).reshape(-1) if mover else pixels


def background(scene: Scene, view: TrackView) -> Iterator[Track]:
    """Yield cells, walls and landmarks."""
    rows, columns = scene.rows, scene.columns
    lines = crossing_lines(range(rows + 1), range(columns + 1))
    border = [(0, 0), (columns, 0), (columns, rows), (0, rows), (0, 0)]
    walls: list[Any] = [border, *map(wall_ends, scene.description["walls"])]
    parts: dict[str, Any] = {
        "cells": rr.LineStrips2D(lines, colors=[(*GREY, 90)], radii=0.008, draw_order=10),
        "walls": rr.LineStrips2D(walls, colors=[GREY], radii=0.05, draw_order=25),
    }
    if marks := scene.description["landmarks"]:
        # A line 0.46 wide around this square and along its diagonal fills a cell.
        square = [(0.25, 0.25), (0.75, 0.25), (0.75, 0.75), (0.25, 0.75), (0.25, 0.25), (0.75, 0.75)]
        corners = np.array([mark["cell"][::-1] for mark in marks], np.float64)
        colours = [palette.rgb(mark["colour"]) for mark in marks]
        tints = [(*colour, 110) for colour in colours]
        names = [mark["name"] for mark in marks]
        cells = list(corners[:, None] + square)
        parts["landmarks"] = rr.LineStrips2D(cells, colors=tints, radii=0.23, draw_order=5)
        parts["names"] = labels_alone(
            positions=corners + np.array((0.14, 0.72)), labels=names, colors=colours, draw_order=26
        )
    for part, static in parts.items():
        yield Track(f"scene/{part}", static=[static], view=view)


def crossing_lines(rows: range, columns: range) -> list[Any]:
    """Return horizontal lines at these rows and vertical ones at these columns, over all of them."""
    across: list[object] = [[(columns[0], y), (columns[-1], y)] for y in rows]
    return across + [[(x, rows[0]), (x, rows[-1])] for x in columns]


def scene_of(mdp: Mdp) -> Scene | None:
    """Return the scene of an environment; None if it has none that can be drawn."""
    if mdp.scene is None or mdp.scene_cells is None:
        return None
    return Scene(mdp, mdp.scene, mdp.scene_cells.astype(np.int64))


class GridLabels:
    """Texts and colours, numbered as they occur, and the numbers and points of what is written at each step.

    `largest` is the largest absolute value of the tables; values are rounded to three digits of it.
    """

    def __init__(self, mdp: Mdp, scene: Scene | None, learners: Sequence[str], largest: float = 0.0) -> None:
        self.mdp = mdp
        self.scene = scene
        self.learners = tuple(learners)
        self.numbers = {("", palette.MIDTONE): 0}
        """By text and colour."""
        self._unit = 10.0 ** (math.floor(math.log10(max(largest, 1e-9))) - 2)
        self.stops = np.full((len(mdp.agents), max(mdp.action_counts) + 1), -1)
        """[agents, own actions + 1]: the letter of an action such as a pickup; -1 for a move or none."""
        for agent, names in enumerate(numbered_actions(mdp)):
            for action in scene.stops if scene else ():
                self.stops[agent, action] = self.number(names[action][0].upper(), palette.agent(agent))

    def number(self, text: str, colour: str = palette.MIDTONE) -> int:
        """Return the number of a text in a colour; 0, which is no text, if there are too many."""
        following = len(self.numbers)
        if following == MAX_LABELS:
            return self.numbers.get((text, colour), 0)
        return self.numbers.setdefault((text, colour), following)

    def of(self, values: Array, label: Callable[[Any], tuple[str, str]]) -> NDArray[np.uint16]:
        """Return the number of each value's label, which is a text and its colour."""
        distinct, places = np.unique(values, return_inverse=True)
        numbers = [self.number(*label(value)) for value in distinct.tolist()]
        return np.array(numbers, np.uint16)[places].reshape(values.shape)

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
            for (text, colour), number in self.numbers.items()
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
        rewards = ((right, y + STATUS_LINE * k) for k in range(len(self.learners)))
        status = repeated(pairs([(left, y), *rewards]), len(scene.points))
        return np.concatenate((scene.points + pairs((0, rise) for rise in rises), status), axis=1)

    def of_steps(self, records: Records, events: NDArray[np.uint32]) -> NDArray[np.uint16]:
        """Return the label of each text in each step, [n, texts].

        Movers have their name, whether they carry a passenger, and what happened to them.
        """
        scene = self.scene
        assert scene is not None
        carriers = scene.carriers.take(records["state"], axis=0)
        labels = []
        for i, mover in enumerate(scene.movers):
            is_carrying = (carriers == mover).any(axis=1)
            labels.append(self.of(events.astype(np.int64) << 1 | is_carrying, partial(self._of_mover, i)))
        for passenger in scene.passengers:  # the label of its carrier shows one that is carried
            waiting = self.number(scene.labels[passenger], palette.PASSENGER)
            labels.append(np.where(carriers[:, passenger] < 0, waiting, 0).astype(np.uint16))
        labels.append(self.of(records["t"], lambda t: (f"t = {t}", palette.MIDTONE)))
        rewards = enumerate(records["rewards"].T)
        labels += [self.of(paid, partial(self._of_reward, learner)) for learner, paid in rewards]
        return np.stack(labels, axis=1)

    def of_values(self, values: Floats) -> NDArray[np.uint16]:
        """Return the label of each value."""
        digits = max(0, -round(math.log10(self._unit)))
        levels = np.rint(values / self._unit) + 0.0  # no -0
        return self.of(levels, lambda level: (f"{level * self._unit:.{digits}f}", palette.MIDTONE))

    def _of_mover(self, number: int, happened: int) -> tuple[str, str]:
        """Return the label of a mover; `happened` is a mask of events, and bit 0 whether it carries one."""
        scene = self.scene
        assert scene is not None
        events = ", ".join(_event_labels(self.mdp, happened >> 1, scene.agents[number]))
        name = scene.labels[scene.movers[number]] + " + passenger" * (happened & 1)
        text = ": ".join(filter(None, (name, events)))
        return text, palette.BAD if BAD_SIGN in events else palette.agent(number)

    def _of_reward(self, learner: int, reward: float) -> tuple[str, str]:
        if len(self.learners) == 1:
            return f"reward {reward:g}", palette.MIDTONE
        return f"reward of {spoken(self.learners[learner])} {reward:g}", palette.agent(learner)


def _event_labels(mdp: Mdp, mask: int, agent: str | None) -> list[str]:
    """Return the events of a mask that concern one agent, or all of them, each with a sign."""
    labels = []
    for bit, name in enumerate(mdp.event_names):
        owner, _, event = name.rpartition(".")
        if mask >> bit & 1 and owner in ("", agent):
            is_bad = owner == "" or (name not in mdp.success_events and event != "pickup")
            labels.append(f"{BAD_SIGN if is_bad else GOOD_SIGN} {spoken(event)}")
    return labels
