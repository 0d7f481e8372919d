"""The scene of an environment as tables to index with states: where everything is drawn, and how.

Coordinates of the grid are cells: x to the right, y down, the first cell from (0, 0) to (1, 1).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.drawing import palette
from runner.environments.mdp import Mdp
from runner.environments.naming import action_names, spoken

BAD_SIGN: Final = "✗"
GOOD_SIGN: Final = "✓"
TRAIL_STEPS: Final = 5
_APART: Final = 0.34
"""Between movers in one cell, so that both are seen."""
_STUB: Final = 0.34
"""Length of the arrow of a move that led nowhere."""


@dataclass(frozen=True)
class Shape:
    """A box with a thick, rounded line, which fills it; lengths are in cells."""

    offset: tuple[float, float]
    half_size: tuple[float, float]
    radius: float
    colour: str = ""
    """Empty for the colour of its mover."""
    thing: int = 0
    """Index of the drawn point that it belongs to."""


DRIVEN: Final = ("taxi", "car", "bus", "truck")
CAR: Final = (
    Shape((-0.02, -0.1), (0.07, 0.025), 0.05),
    Shape((0.0, 0.02), (0.15, 0.025), 0.055),
    Shape((-0.1, 0.1), (0.01, 0.01), 0.04, palette.MIDTONE),
    Shape((0.1, 0.1), (0.01, 0.01), 0.04, palette.MIDTONE),
)
PAWN: Final = (Shape((0.0, -0.12), (0.02, 0.02), 0.07), Shape((0.0, 0.05), (0.05, 0.05), 0.06))
PERSON: Final = (
    Shape((0.0, -0.09), (0.01, 0.01), 0.04, palette.PASSENGER),
    Shape((0.0, 0.03), (0.02, 0.03), 0.045, palette.PASSENGER),
)
"""A car, any other mover, and a passenger, by their boxes."""


@dataclass(frozen=True, eq=False)
class Scene:
    """Tables of S states; movers come first among the drawn points, then the passengers."""

    rows: int
    columns: int
    mdp: Mdp
    description: Mapping[str, Any]
    movers: tuple[int, ...]
    """Indices of the things that agents move."""
    passengers: tuple[int, ...]
    goals: tuple[int, ...]

    @cached_property
    def points(self) -> NDArray[np.float32]:
        """[S, movers + passengers, 2]: where they are drawn."""
        cells = self._cells(self.movers)
        movers = self.centres[cells] + self._offsets
        drawn = [movers[:, i] for i in range(len(self.movers))]
        carriers = self.mdp.scene_carriers
        for thing in self.passengers:
            place = self.centres[self._cells((thing,))[:, 0]] + np.array([0.2, 0.26], np.float32)
            for i, mover in enumerate(self.movers):
                if carriers is not None:
                    rides = (carriers[:, thing] == mover)[:, None]
                    place = np.where(rides, movers[:, i], place)
            drawn.append(place)
        return np.stack(drawn, axis=1).astype(np.float32)

    @cached_property
    def shapes(self) -> tuple[Shape, ...]:
        """The boxes that the drawn points are made of: those of the movers first, then the passengers'."""
        drawn: list[Shape] = []
        for i, mover in enumerate(self.movers):
            colour = palette.agent(i)
            driven = str(self.description["things"][mover]["label"]).split(" ")[0] in DRIVEN
            drawn += [
                dataclasses.replace(part, thing=i, colour=part.colour or colour)
                for part in (CAR if driven else PAWN)
            ]
        for i in range(len(self.passengers)):
            drawn += [dataclasses.replace(part, thing=len(self.movers) + i) for part in PERSON]
        return tuple(drawn)

    @cached_property
    def shape_things(self) -> NDArray[np.int64]:
        """[shapes]: the drawn point that each shape belongs to."""
        return np.array([shape.thing for shape in self.shapes], np.int64)

    @cached_property
    def shape_centres(self) -> NDArray[np.float32]:
        """[S, shapes, 2]: the centre of each shape."""
        offsets = np.array([shape.offset for shape in self.shapes], np.float32).reshape(-1, 2)
        return np.asarray(self.points[:, self.shape_things] + offsets)

    @cached_property
    def goal_points(self) -> NDArray[np.float32]:
        """[S, goals, 2]: the centre of each goal's cell."""
        return self.centres[self._cells(self.goals)]

    @cached_property
    def centres(self) -> NDArray[np.float32]:
        """[cells, 2]: the centre of each cell."""
        cell = np.arange(self.rows * self.columns)
        return np.stack((cell % self.columns + 0.5, cell // self.columns + 0.5), axis=1).astype(np.float32)

    @cached_property
    def _offsets(self) -> NDArray[np.float32]:
        """[movers, 2]: from the centre of a cell to where each mover in it is drawn."""
        spread = (np.arange(len(self.movers)) - (len(self.movers) - 1) / 2) * _APART
        return np.stack((spread, spread * 0.6 - 0.05), axis=1).astype(np.float32)

    @cached_property
    def carried(self) -> NDArray[np.int64]:
        """[S, movers]: 1 where a mover carries something."""
        carriers = self.mdp.scene_carriers
        carries = np.zeros((self.mdp.states, len(self.movers)), np.int64)
        for i, mover in enumerate(self.movers):
            if carriers is not None:
                carries[:, i] = (carriers == mover).any(axis=1)
        return carries

    @cached_property
    def rides(self) -> NDArray[np.bool_]:
        """[S, passengers]: whether something carries it."""
        carriers = self.mdp.scene_carriers
        if carriers is None:
            return np.zeros((self.mdp.states, len(self.passengers)), np.bool_)
        return np.asarray(carriers[:, list(self.passengers)] >= 0)

    @cached_property
    def moves(self) -> NDArray[np.float32]:
        """[J, movers, 2]: the short arrow of each mover's own action; none for an action without a move."""
        own = own_actions(self.mdp)
        arrows = np.zeros((self.mdp.joint_actions, len(self.movers), 2), np.float32)
        if action_names(self.mdp) is None:
            return arrows
        known = [action.get("move") or (0, 0) for action in self.description["actions"]]
        steps = np.array([(column, row) for row, column in known], np.float32)
        for i, mover in enumerate(self.movers):
            agent = self.description["things"][mover].get("agent")
            if agent in self.mdp.agents:
                arrows[:, i] = steps[own[:, self.mdp.agents.index(agent)]] * _STUB
        return arrows

    def arrows(
        self, state: NDArray[Any], action: NDArray[Any], next_state: NDArray[Any]
    ) -> NDArray[np.float32]:
        """Return the vector of each mover's move, [n, movers, 2]; a stub where a move led nowhere."""
        movers = len(self.movers)
        moved = self.points[next_state, :movers] - self.points[state, :movers]
        return np.where(moved.any(axis=2, keepdims=True), moved, self.moves[action])

    def _cells(self, things: Sequence[int]) -> NDArray[np.int64]:
        assert self.mdp.scene_cells is not None
        return self.mdp.scene_cells[:, list(things)].astype(np.int64)

    @cached_property
    def placements(self) -> Placements | None:
        """Which states there are for every placement of the movers; None unless there are one or two."""
        return _placements(self) if len(self.movers) in (1, 2) else None


@dataclass(frozen=True, eq=False)
class Placements:
    """States by what is not a mover (the context), and by where the movers are."""

    context: NDArray[np.int64]
    """[S]: number of each state's context."""
    states: NDArray[np.int32]
    """[contexts, picture]: the state at each pixel of a picture, row by row; -1 where there is none."""
    names: tuple[str, ...]
    """What each context is, in words."""
    height: int
    width: int
    pixel: NDArray[np.int64]
    """[S]: which pixel of its picture a state is."""
    block: tuple[int, int]
    """Rows and columns of the grid that each block of the picture shows."""

    def order(self, mover: int) -> NDArray[np.int64]:
        """Return the pixels of this picture in the order of one in which that mover is the inner one."""
        rows, columns = self.block
        if mover == 0 or (self.height, self.width) == self.block:
            return np.arange(self.height * self.width)
        pixels = np.arange(self.height * self.width).reshape(rows, rows, columns, columns)
        return pixels.transpose(1, 0, 3, 2).reshape(-1)


def scene_of(mdp: Mdp) -> Scene | None:
    """Return the scene of an environment; None if it has none that can be drawn."""
    described = mdp.scene
    if described is None or mdp.scene_cells is None:
        return None
    kinds = [thing["kind"] for thing in described["things"]]
    movers = tuple(i for i, kind in enumerate(kinds) if kind == "mover")
    goals = tuple(i for i, kind in enumerate(kinds) if kind == "goal")
    others = tuple(i for i in range(len(kinds)) if i not in movers + goals)
    return Scene(described["rows"], described["columns"], mdp, described, movers, others, goals)


def own_actions(mdp: Mdp) -> NDArray[np.int64]:
    """Return each agent's part of every joint action, [J, agents]."""
    joint = np.arange(mdp.joint_actions)
    return np.stack(np.unravel_index(joint, mdp.action_counts), axis=1).astype(np.int64)


@dataclass(frozen=True, eq=False)
class Marks:
    """The label of each mover in the grid, by whether it carries someone and what just happened to it."""

    labels: list[str]
    """Text of every mark."""
    colours: list[str]
    lookup: NDArray[np.uint16]
    """[movers, carries, distinct event masks]: which mark."""
    masks: NDArray[np.uint32]
    """The distinct event masks, ascending."""

    def of(self, carries: NDArray[np.int64], events: NDArray[np.uint32]) -> NDArray[np.uint16]:
        """Return the mark of each mover in each step, [n, movers]."""
        kind = np.searchsorted(self.masks, events)
        movers = np.arange(len(self.lookup))[None, :]
        return self.lookup[movers, carries, kind[:, None]]


def marks_of(scene: Scene) -> Marks:
    """Return the marks of a scene's movers."""
    mdp = scene.mdp
    masks = np.unique(np.append(mdp.events, np.uint32(0)))
    labels: list[str] = []
    colours: list[str] = []
    lookup = np.zeros((len(scene.movers), 2, len(masks)), np.uint16)
    for i, mover in enumerate(scene.movers):
        thing = scene.description["things"][mover]
        for carries in (0, 1):
            for k, mask in enumerate(masks):
                happened = _happened(mdp, int(mask), str(thing.get("agent", "")))
                label = thing["label"] + (" + passenger" if carries else "")
                lookup[i, carries, k] = len(labels)
                labels.append(": ".join([label, ", ".join(happened)]) if happened else label)
                bad = any(word.startswith(BAD_SIGN) for word in happened)
                colours.append(palette.BAD if bad else palette.agent(i))
    return Marks(labels, colours, lookup, masks)


def _happened(mdp: Mdp, mask: int, agent: str) -> list[str]:
    """Return in words the events of a mask that are one agent's, or everybody's."""
    words = []
    for bit, name in enumerate(mdp.event_names):
        owner, _, event = name.rpartition(".")
        if mask >> bit & 1 and owner in ("", agent):
            bad = owner == "" or (name not in mdp.success_events and event not in ("pickup",))
            words.append(f"{BAD_SIGN if bad else GOOD_SIGN} {spoken(event)}")
    return words


def _placements(scene: Scene) -> Placements:
    """Return the states as pictures: the first mover's cells within blocks, a block a cell of the second."""
    mdp, rows, columns = scene.mdp, scene.rows, scene.columns
    cells = scene._cells(scene.movers)
    across = columns if len(scene.movers) == 2 else 1
    down = rows if len(scene.movers) == 2 else 1
    outer = cells[:, 1] if len(scene.movers) == 2 else np.zeros(mdp.states, np.int64)
    inner = cells[:, 0]
    y = outer // columns * rows + inner // columns
    x = outer % columns * columns + inner % columns
    height, width = rows * down, columns * across
    pixel = y * width + x
    context, names = _contexts(scene)
    states = np.full((len(names), height * width), -1, np.int32)
    states[context, pixel] = np.arange(mdp.states)
    return Placements(context, states, names, height, width, pixel, (rows, columns))


def _contexts(scene: Scene) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """Return the context of each state: where everything is that is not a mover, or what carries it."""
    mdp = scene.mdp
    things = [*scene.passengers, *scene.goals]
    if not things:
        return np.zeros(mdp.states, np.int64), ("",)
    assert mdp.scene_cells is not None
    keys = mdp.scene_cells[:, things].astype(np.int64)
    if mdp.scene_carriers is not None:
        carriers = mdp.scene_carriers[:, things].astype(np.int64)
        keys = np.where(carriers >= 0, -1 - carriers, keys)
    distinct, context = np.unique(keys, axis=0, return_inverse=True)
    return context.reshape(-1), tuple(_context_name(scene, things, key) for key in distinct)


def _context_name(scene: Scene, things: Sequence[int], key: NDArray[np.int64]) -> str:
    described = scene.description
    marks = {
        mark["cell"][0] * scene.columns + mark["cell"][1]: mark["name"]
        for mark in described.get("landmarks", [])
    }
    words = []
    for thing, place in zip(things, key.tolist(), strict=True):
        name = described["things"][thing]["label"]
        if place < 0:
            words.append(f"{name} in {described['things'][-1 - place]['label']}")
        else:
            words.append(f"{name} {marks.get(place, divmod(place, scene.columns))}")
    return ", ".join(words)
