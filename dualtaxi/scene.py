"""The game as a scene: what a viewer needs to draw any state without knowing the rules."""

from __future__ import annotations

from itertools import cycle
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dualtaxi.encoding import AGENTS, Encoding
from dualtaxi.grid import ACTIONS, MOVES, Grid

THINGS = (*AGENTS, "passenger", "destination")
"""What has a place in every state, in the order of `scene_cells` and `scene_carriers`."""

# Okabe and Ito (2008), "Color Universal Design": distinguishable with any common colour blindness.
BLACK, ORANGE, SKY_BLUE, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
YELLOW, BLUE, VERMILLION, PURPLE = "#F0E442", "#0072B2", "#D55E00", "#CC79A7"

_NAMED_COLOURS = {"R": VERMILLION, "G": GREEN, "Y": YELLOW, "B": BLUE}


def landmark_colours(grid: Grid) -> tuple[str, ...]:
    """Return the colour of each landmark as "#rrggbb": R, G, Y and B are what they stand for."""
    names = [mark.name for mark in grid.landmarks]
    unused = [colour for name, colour in _NAMED_COLOURS.items() if name not in names]
    others = cycle(unused or _NAMED_COLOURS.values())
    return tuple(_NAMED_COLOURS.get(name) or next(others) for name in names)


def describe_scene(grid: Grid) -> dict[str, Any]:
    """Return the parts of the scene that never change, as a plain dict that JSON can hold.

    Its keys: `rows`, `columns`; `walls` (pairs of neighbouring [row, column] cells with a wall between);
    `landmarks` (`name`, `cell`, `colour`); `things` (`name`, `label`, `kind`, and `agent` if one moves it);
    `actions` of one agent (`name`, and `move` in [rows, columns] or None).
    """
    movers = [
        {"name": agent, "label": agent.replace("_", " "), "kind": "mover", "agent": agent} for agent in AGENTS
    ]
    others = [
        {"name": "passenger", "label": "passenger", "kind": "passenger"},
        {"name": "destination", "label": "destination", "kind": "goal"},
    ]
    moves = [list(move) for move in MOVES]
    return {
        "rows": grid.rows,
        "columns": grid.columns,
        "walls": [[[row, column], [row, column + 1]] for row, column in grid.walls],
        "landmarks": [
            {"name": mark.name, "cell": [mark.row, mark.column], "colour": colour}
            for mark, colour in zip(grid.landmarks, landmark_colours(grid), strict=True)
        ],
        "things": movers + others,
        "actions": [
            {"name": name, "move": moves[number] if number < len(moves) else None}
            for number, name in enumerate(ACTIONS)
        ],
    }


def place_things(grid: Grid, encoding: Encoding) -> tuple[NDArray[np.int16], NDArray[np.int8]]:
    """Return where each thing is in each state, and what carries it.

    Returns:
        Cell index (row * columns + column) of each of `THINGS`, int16 [S, 4], and the index in `THINGS` of
        the thing that carries it, or -1, int8 [S, 4]; both read-only.
    """
    axes = np.indices(encoding.shape).reshape(len(encoding.shape), -1)
    cell_1, cell_2, passenger, destination = axes
    waits_at = np.append(grid.landmark_cells, (0, 0))[passenger]  # the two zeros are never chosen below
    rides_in = passenger - encoding.landmarks
    passenger_cell = np.choose(rides_in.clip(-1) + 1, (waits_at, cell_1, cell_2))
    cells = np.stack((cell_1, cell_2, passenger_cell, grid.landmark_cells[destination]), axis=1).astype(
        np.int16
    )
    carriers = np.full(cells.shape, -1, dtype=np.int8)
    carriers[:, THINGS.index("passenger")] = rides_in.clip(-1)
    cells.flags.writeable = carriers.flags.writeable = False
    return cells, carriers
