"""The scene of an environment as arrays indexed by state: where everything is drawn, and how.

Coordinates are cells: x to the right, y down, the first cell from (0, 0) to (1, 1).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from runner.drawing import palette
from runner.environments.mdp import Mdp
from runner.environments.naming import action_names
from runner.environments.scene import SceneDescription
from runner.export.rerun.tracks import Track, View

_SPACING: Final = 0.34
"""Between movers in one cell, so that both are visible."""
_BLOCKED_ARROW: Final = 0.34
"""Length of the arrow of a move that led nowhere."""


class Shape(NamedTuple):
    """A box filled by its thick, rounded line; lengths are in cells."""

    offset: tuple[float, float]
    half_size: tuple[float, float]
    radius: float
    colour: str = ""
    """Empty for the colour of its mover."""


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


@dataclass(frozen=True, eq=False)
class Scene:
    """Arrays over S states. Movers come first among the things drawn, then passengers."""

    mdp: Mdp
    description: SceneDescription
    movers: tuple[int, ...]
    """Indices of the things that agents move."""
    passengers: tuple[int, ...]
    goals: tuple[int, ...]

    @property
    def rows(self) -> int:
        """Rows of cells."""
        return self.description["rows"]

    @property
    def columns(self) -> int:
        """Columns of cells."""
        return self.description["columns"]

    @cached_property
    def points(self) -> NDArray[np.float32]:
        """[S, movers + passengers, 2]: where each is drawn."""
        spread = (np.arange(len(self.movers)) - (len(self.movers) - 1) / 2) * _SPACING
        offsets = np.stack((spread, spread * 0.6 - 0.05), axis=1).astype(np.float32)
        movers = self._centres(self.movers) + offsets
        passengers = self._centres(self.passengers) + np.array([0.2, 0.26], np.float32)
        for i, mover in enumerate(self.movers):
            rides = self._carriers(self.passengers) == mover
            passengers = np.where(rides[..., None], movers[:, i : i + 1], passengers)
        return np.concatenate((movers, passengers), axis=1)

    @cached_property
    def mover_points(self) -> NDArray[np.float32]:
        """[S, movers, 2]: where each mover is drawn."""
        return np.ascontiguousarray(self.points[:, : len(self.movers)])

    @cached_property
    def shapes(self) -> list[tuple[int, Shape]]:
        """The boxes that are drawn, each with the index of the mover or passenger it belongs to."""
        shapes: list[tuple[int, Shape]] = []
        for i, mover in enumerate(self.movers):
            is_driven = self.label(mover).split(" ")[0] in DRIVEN
            shapes += [
                (i, shape._replace(colour=shape.colour or palette.agent(i)))
                for shape in (CAR if is_driven else PAWN)
            ]
        return shapes + [
            (len(self.movers) + i, shape) for i in range(len(self.passengers)) for shape in PERSON
        ]

    @cached_property
    def shape_centres(self) -> NDArray[np.float32]:
        """[S, shapes, 2]: the centre of each shape."""
        owners = [owner for owner, _ in self.shapes]
        offsets = np.array([shape.offset for _, shape in self.shapes], np.float32).reshape(-1, 2)
        return np.asarray(self.points[:, owners] + offsets)

    @cached_property
    def goal_points(self) -> NDArray[np.float32]:
        """[S, goals, 2]: the centre of each goal's cell."""
        return self._centres(self.goals)

    @cached_property
    def is_carrying(self) -> NDArray[np.int64]:
        """[S, movers]: 1 where a mover carries something."""
        carriers = self._carriers(range(len(self.description["things"])))
        is_carrier = carriers[..., None] == np.array(self.movers, np.int64)
        return np.asarray(is_carrier.any(axis=1).astype(np.int64))

    @cached_property
    def is_carried(self) -> NDArray[np.bool_]:
        """[S, passengers]: whether something carries the passenger."""
        return np.asarray(self._carriers(self.passengers) >= 0)

    @cached_property
    def moves(self) -> NDArray[np.float32]:
        """[J, movers, 2]: a short arrow for each mover's own action; zero for an action that is no move."""
        arrows = np.zeros((self.mdp.joint_actions, len(self.movers), 2), np.float32)
        if action_names(self.mdp) is not None:
            moves = [action.get("move") or (0, 0) for action in self.description["actions"]]
            steps = np.array([(column, row) for row, column in moves], np.float32)
            for i, agent in enumerate(self.mover_agents):
                if agent in self.mdp.agents:
                    arrows[:, i] = (
                        steps[self.mdp.own_actions[:, self.mdp.agents.index(agent)]] * _BLOCKED_ARROW
                    )
        return arrows

    @property
    def mover_agents(self) -> list[str]:
        """The name of the agent that moves each mover; empty for none."""
        return [str(self.description["things"][mover].get("agent", "")) for mover in self.movers]

    def label(self, thing: int) -> str:
        """Return the label of a thing."""
        return str(self.description["things"][thing]["label"])

    def arrows(
        self, state: NDArray[np.integer], action: NDArray[np.integer], next_state: NDArray[np.integer]
    ) -> NDArray[np.float32]:
        """Return the vector of each mover's move, [n, movers, 2]: short where it led nowhere."""
        points = self.mover_points
        moved = points.take(next_state, axis=0) - points.take(state, axis=0)
        return np.where(moved.any(axis=2, keepdims=True), moved, self.moves.take(action, axis=0))

    @cached_property
    def placements(self) -> Placements | None:
        """The states by placement of the movers; None unless there are one or two movers."""
        return _placements(self) if len(self.movers) in (1, 2) else None

    def cells(self, things: Sequence[int]) -> NDArray[np.int64]:
        """Return the cell of each of these things in each state, [S, things]."""
        assert self.mdp.scene_cells is not None
        return self.mdp.scene_cells[:, list(things)].astype(np.int64)

    def _centres(self, things: Sequence[int]) -> NDArray[np.float32]:
        cells = self.cells(things)
        return np.stack((cells % self.columns + 0.5, cells // self.columns + 0.5), axis=-1).astype(np.float32)

    def _carriers(self, things: Sequence[int]) -> NDArray[np.int64]:
        """Return what carries each of these things in each state, [S, things]; -1 for nothing."""
        if self.mdp.scene_carriers is None:
            return np.full((self.mdp.states, len(things)), -1)
        return self.mdp.scene_carriers[:, list(things)].astype(np.int64)


@dataclass(frozen=True, eq=False)
class Placements:
    """States by context, which is everything but the movers, and by where the movers are.

    The placements of a context form a picture. Its pixels are the cells of the first mover, within blocks; a
    block is a cell of the second mover.
    """

    context: NDArray[np.int64]
    """[S]: the number of each state's context."""
    states: NDArray[np.int32]
    """[contexts, pixels]: the state at each pixel, row by row; -1 for none."""
    names: tuple[str, ...]
    """A description of each context."""
    height: int
    width: int
    pixel: NDArray[np.int64]
    """[S]: the pixel of each state."""
    block: tuple[int, int]
    """Rows and columns of a block."""

    def order(self, mover: int) -> NDArray[np.int64]:
        """Return the pixels in the order of the picture whose blocks hold the cells of that mover."""
        rows, columns = self.block
        pixels = np.arange(self.height * self.width)
        if mover == 0 or (self.height, self.width) == self.block:
            return pixels
        return pixels.reshape(rows, rows, columns, columns).transpose(1, 0, 3, 2).reshape(-1)


def background(root: str, scene: Scene, view: View) -> Iterator[Track]:
    """Yield cells, walls and landmarks."""
    rows, columns = scene.rows, scene.columns
    grey, path = palette.rgb(palette.MIDTONE), f"{root}/scene"
    lines = crossing_lines(range(rows + 1), range(columns + 1))
    cells = rr.LineStrips2D(lines, colors=[(*grey, 90)], radii=0.008, draw_order=10)
    border: Any = [(0, 0), (columns, 0), (columns, rows), (0, rows), (0, 0)]
    strips = [border, *(_wall(first, second) for first, second in scene.description["walls"])]
    walls = rr.LineStrips2D(strips, colors=[grey], radii=0.05, draw_order=25)
    parts: dict[str, rr.AsComponents] = {"cells": cells, "walls": walls}
    if marks := scene.description["landmarks"]:
        # A line 0.46 wide around this square and along its diagonal fills a cell.
        square = [(0.25, 0.25), (0.75, 0.25), (0.75, 0.75), (0.25, 0.75), (0.25, 0.25), (0.75, 0.75)]
        corners = np.array([mark["cell"][::-1] for mark in marks], np.float64)
        colours = [palette.rgb(mark["colour"]) for mark in marks]
        parts["landmarks"] = rr.LineStrips2D(
            list(corners[:, None] + square),
            colors=[(*colour, 110) for colour in colours],
            radii=0.23,
            draw_order=5,
        )
        parts["names"] = rr.Points2D(
            corners + np.array((0.14, 0.72)),
            labels=[mark["name"] for mark in marks],
            colors=colours,
            radii=0.0,
            show_labels=True,
            draw_order=26,
        )
    for part, static in parts.items():
        yield Track(f"{path}/{part}", static=[static], view=view)


def crossing_lines(rows: range, columns: range) -> list[Any]:
    """Return horizontal lines at these rows and vertical ones at these columns, over all of them."""
    across: list[object] = [[(columns[0], y), (columns[-1], y)] for y in rows]
    return across + [[(x, rows[0]), (x, rows[-1])] for x in columns]


def _wall(first: Sequence[int], second: Sequence[int]) -> list[tuple[float, float]]:
    """Return the line between two neighbouring cells."""
    (row, column), (other_row, other_column) = first, second
    if row == other_row:
        x = max(column, other_column)
        return [(x, row), (x, row + 1)]
    y = max(row, other_row)
    return [(column, y), (column + 1, y)]


def scene_of(mdp: Mdp) -> Scene | None:
    """Return the scene of an environment; None if it has none that can be drawn."""
    if mdp.scene is None or mdp.scene_cells is None:
        return None
    kinds = [thing["kind"] for thing in mdp.scene["things"]]
    movers = tuple(i for i, kind in enumerate(kinds) if kind == "mover")
    goals = tuple(i for i, kind in enumerate(kinds) if kind == "goal")
    passengers = tuple(i for i in range(len(kinds)) if i not in movers + goals)
    return Scene(mdp, mdp.scene, movers, passengers, goals)


def _placements(scene: Scene) -> Placements:
    rows, columns = scene.rows, scene.columns
    cells = scene.cells(scene.movers)
    inner, outer = (cells[:, 0], cells[:, 1]) if len(scene.movers) == 2 else (cells[:, 0], 0 * cells[:, 0])
    height, width = (rows * rows, columns * columns) if len(scene.movers) == 2 else (rows, columns)
    pixel = (outer // columns * rows + inner // columns) * width + outer % columns * columns + inner % columns
    context, names = _contexts(scene)
    states = np.full((len(names), height * width), -1, np.int32)
    states[context, pixel] = np.arange(scene.mdp.states)
    return Placements(context, states, names, height, width, pixel, (rows, columns))


def _contexts(scene: Scene) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """Return the context of each state, and a description of each context: `passenger R, destination B`."""
    things = [*scene.passengers, *scene.goals]
    if not things:
        return np.zeros(scene.mdp.states, np.int64), ("",)
    carriers = scene._carriers(things)
    keys, context = np.unique(
        np.where(carriers >= 0, -1 - carriers, scene.cells(things)), axis=0, return_inverse=True
    )
    marks = {
        mark["cell"][0] * scene.columns + mark["cell"][1]: mark["name"]
        for mark in scene.description["landmarks"]
    }

    def place(key: int) -> str:
        return f"in {scene.label(-1 - key)}" if key < 0 else str(marks.get(key, divmod(key, scene.columns)))

    names = (
        ", ".join(f"{scene.label(i)} {place(k)}" for i, k in zip(things, key, strict=True))
        for key in keys.tolist()
    )
    return context.reshape(-1), tuple(names)
