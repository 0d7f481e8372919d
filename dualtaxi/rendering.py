"""A state as text for a terminal, as a picture, and as a scene that others draw without knowing the rules."""

from __future__ import annotations

import os
from itertools import cycle
from typing import Any

import numpy as np
from gymnasium.utils import colorize
from numpy.typing import NDArray

from dualtaxi.drawing import Canvas, ink_on, mix, text_width
from dualtaxi.grid import ACTIONS, AGENTS, MOVES, Grid, State

THINGS = (*AGENTS, "passenger", "destination")
"""What has a place in every state, in the order of `scene_cells` and `scene_carriers`."""

# Okabe and Ito (2008), "Color Universal Design": distinguishable with any common colour blindness.
BLACK, ORANGE, SKY_BLUE, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
YELLOW, BLUE, VERMILLION, PURPLE = "#F0E442", "#0072B2", "#D55E00", "#CC79A7"

_NAMED_COLOURS = {"R": VERMILLION, "G": GREEN, "Y": YELLOW, "B": BLUE}

LEGEND = "1 2 taxis, p passenger waiting, P passenger in the taxi, * destination"

_ACTION_WORDS = tuple(name.replace("_", "-") for name in ACTIONS)
_WEST = ACTIONS.index("west")

_CELL, _GAP, _FRAME, _MARGIN = 120, 6, 8, 24  # pixels
_PANEL_WIDTH, _PANEL_HEIGHT, _LETTER = 400, 116, 15
_WHITE, _PAPER, _ROAD, _INK, _GLASS = "#ffffff", "#f6f4ef", "#d9d6cf", "#22262b", "#eaf3f8"
_TAXI_COLOURS = (ORANGE, SKY_BLUE)


def draw_text(grid: Grid, state: State, actions: tuple[int, int] | None) -> str:
    """Return the map and the last actions as text: in colour, or in letters if `NO_COLOR` is set.

    `NO_COLOR` follows https://no-color.org: it counts when it is not empty.
    """
    taken = ""
    if actions is not None:
        taken = f"taxi 1: {_ACTION_WORDS[actions[0]]}, taxi 2: {_ACTION_WORDS[actions[1]]}"
    if os.environ.get("NO_COLOR"):
        goal = grid.landmarks[state.destination].name
        passenger = f"passenger: {_passenger_words(grid, state)}, destination: {goal}"
        lines = [*_lettered_map(grid, state), passenger, taken, LEGEND]
    else:
        lines = [*_coloured_map(grid, state), taken]
    return "\n".join(lines) + "\n"


def _coloured_map(grid: Grid, state: State) -> list[str]:
    """Return the lines of the map, one character a cell."""
    cells = {mark.cell: mark.name for mark in grid.landmarks}
    waits_at, rider = _passenger_place(grid, state)
    if waits_at is not None:
        cells[waits_at] = colorize(cells[waits_at], "blue", bold=True)
    goal = grid.landmarks[state.destination].cell
    cells[goal] = colorize(cells[goal], "magenta")
    for taxi, place, colour in ((1, state.taxi_2, "red"), (0, state.taxi_1, "yellow")):
        shown = cells.get(place, str(taxi + 1))
        cells[place] = colorize(shown, "green" if rider == taxi else colour, highlight=True)
    return _framed(grid, cells, 1)


def _lettered_map(grid: Grid, state: State) -> list[str]:
    """Return the lines of the map; a cell shows landmark, destination, taxi 1, taxi 2, passenger."""
    signs: dict[tuple[int, int], list[str]] = {}

    def put(place: tuple[int, int], position: int, sign: str) -> None:
        signs.setdefault(place, [" "] * 5)[position] = sign

    for mark in grid.landmarks:
        put(mark.cell, 0, mark.name)
    put(grid.landmarks[state.destination].cell, 1, "*")
    put(state.taxi_1, 2, "1")
    put(state.taxi_2, 3, "2")
    waits_at, rider = _passenger_place(grid, state)
    if waits_at is not None:
        put(waits_at, 4, "p")
    elif rider is not None:
        put((state.taxi_1, state.taxi_2)[rider], 4, "P")
    return _framed(grid, {place: "".join(row) for place, row in signs.items()}, 5)


def _framed(grid: Grid, cells: dict[tuple[int, int], str], width: int) -> list[str]:
    """Return the lines of a map with the given contents of cells, each `width` characters wide as seen."""
    frame = "+" + "-" * (grid.columns * (width + 1) - 1) + "+"
    lines = [frame]
    for row in range(grid.rows):
        line = "|"
        for column in range(grid.columns):
            wall = (row, column) in grid.walls or column == grid.columns - 1
            line += cells.get((row, column), " " * width) + ("|" if wall else ":")
        lines.append(line)
    return [*lines, frame]


def _passenger_place(grid: Grid, state: State) -> tuple[tuple[int, int] | None, int | None]:
    """Return the cell where the passenger waits and the taxi (0 or 1) the passenger is in; one is None."""
    count = len(grid.landmarks)
    if state.passenger < count:
        return grid.landmarks[state.passenger].cell, None
    return None, state.passenger - count


def _passenger_words(grid: Grid, state: State) -> str:
    """Return where the passenger is."""
    _, rider = _passenger_place(grid, state)
    if rider is not None:
        return f"in taxi {rider + 1}"
    if state.passenger == state.destination:
        return "arrived"
    return f"waits at {grid.landmarks[state.passenger].name}"


class Picture:
    """Draws states of one map; the map itself is drawn once.

    Colours are from the palette of Okabe and Ito, and no information is in colour alone: landmarks have
    letters, taxis numbers, the destination a flag.
    """

    def __init__(self, grid: Grid) -> None:
        self._grid = grid
        across, down = (n * (_CELL + _GAP) + _GAP for n in (grid.columns, grid.rows))
        self._width = max(across, _PANEL_WIDTH) + 2 * _MARGIN
        self._left, self._top = (self._width - across) // 2, _MARGIN
        self._bottom = self._top + down
        self._map = Canvas.blank(self._width, self._bottom + _PANEL_HEIGHT, _PAPER)
        self._draw_map(self._map, across, down)

    def draw(self, state: State, actions: tuple[int, int] | None) -> NDArray[np.uint8]:
        """Return the picture of a state and of the actions that led to it, uint8 [height, width, 3]."""
        canvas = Canvas(self._map.pixels.copy())
        waits_at, rider = _passenger_place(self._grid, state)
        goal_x, goal_y = self._corner(self._grid.landmarks[state.destination].cell)
        _ring(canvas, goal_x, goal_y)
        _flag(canvas, goal_x + 85, goal_y + 10)
        if waits_at is not None:
            x, y = self._corner(waits_at)
            _person(canvas, x + 54, y + 9)
        for taxi, place in enumerate((state.taxi_1, state.taxi_2)):
            x, y = self._corner(place)
            shift = 10 * (2 * taxi - 1) if state.taxi_1 == state.taxi_2 else 0
            west = actions is not None and actions[taxi] == _WEST
            _taxi(canvas, (x + _CELL // 2 + shift, y + 87 + shift // 2), taxi, west, rider == taxi)
        self._draw_panel(canvas, state, actions)
        return np.rint(canvas.pixels).astype(np.uint8)

    def _corner(self, place: tuple[int, int]) -> tuple[int, int]:
        """Return the x and y of a cell's upper left corner."""
        row, column = place
        return self._left + _GAP + column * (_CELL + _GAP), self._top + _GAP + row * (_CELL + _GAP)

    def _draw_map(self, canvas: Canvas, across: int, down: int) -> None:
        edge = (self._left - _FRAME, self._top - _FRAME)
        canvas.box(edge, (self._left + across + _FRAME, self._bottom + _FRAME), _INK, 14)
        canvas.box((self._left, self._top), (self._left + across, self._top + down), _ROAD, 7)
        marks = list(zip(self._grid.landmarks, landmark_colours(self._grid), strict=True))
        tints = {mark.cell: mix(_WHITE, colour, 0.28) for mark, colour in marks}
        for row in range(self._grid.rows):
            for column in range(self._grid.columns):
                x, y = self._corner((row, column))
                canvas.box((x, y), (x + _CELL, y + _CELL), tints.get((row, column), _WHITE), 6)
        for mark, colour in marks:
            x, y = self._corner(mark.cell)
            canvas.box((x + 10, y + 9), (x + 46, y + 45), colour, 7)
            canvas.text((x + 28 - text_width("R", 20) / 2, y + 17), mark.name, 20, ink_on(colour))
        for row, column in self._grid.walls:
            x, y = self._corner((row, column))
            wall = x + _CELL + _GAP / 2
            canvas.box((wall - 6, y - _GAP), (wall + 6, y + _CELL + _GAP), _INK, 3)

    def _draw_panel(self, canvas: Canvas, state: State, actions: tuple[int, int] | None) -> None:
        """Write under the map where the passenger is and wants to go, and what the taxis did last."""
        span = max(self._width - 2 * _MARGIN, _PANEL_WIDTH)
        first, second, y = _MARGIN, _MARGIN + span // 2, self._bottom + 30
        _person(canvas, first + 4, y - 7, 0.8)
        _write(canvas, first, y, _passenger_words(self._grid, state))
        _flag(canvas, second + 4, y - 7, 0.8)
        _write(canvas, second, y, f"to {self._grid.landmarks[state.destination].name}")
        for taxi, left in enumerate((first, second)):
            canvas.box((left, y + 36), (left + 28, y + 64), _TAXI_COLOURS[taxi], 6)
            canvas.text((left + 14 - text_width("1", _LETTER) / 2, y + 42.5), str(taxi + 1), _LETTER, BLACK)
            if actions is not None:
                _write(canvas, left, y + 42.5, _ACTION_WORDS[actions[taxi]])


def _write(canvas: Canvas, x: float, y: float, words: str) -> None:
    """Write the text of the panel, next to the sign at x."""
    canvas.text((x + 40, y), words.upper(), _LETTER, _INK)


def _ring(canvas: Canvas, x: float, y: float) -> None:
    """Draw a frame inside the cell at x, y."""
    near, far = 4.5, _CELL - 4.5
    corners = [(near, near), (far, near), (far, far), (near, far), (near, near)]
    canvas.line([(x + dx, y + dy) for dx, dy in corners], 5, PURPLE)


def _flag(canvas: Canvas, x: float, y: float, scale: float = 1.0) -> None:
    """Draw a flag 26 wide and 38 high, times `scale`."""

    def at(dx: float, dy: float) -> tuple[float, float]:
        return x + dx * scale, y + dy * scale

    canvas.polygon([at(2, 0), at(26, 9), at(2, 19)], _INK)
    canvas.polygon([at(2, 3), at(20, 9.3), at(2, 16)], PURPLE)
    canvas.line([at(2, 2), at(2, 36)], 4 * scale, _INK)


def _person(canvas: Canvas, x: float, y: float, scale: float = 1.0) -> None:
    """Draw a person 24 wide and 36 high, times `scale`."""

    def at(dx: float, dy: float) -> tuple[float, float]:
        return x + dx * scale, y + dy * scale

    canvas.disc(at(12, 8), 10 * scale, _WHITE)
    canvas.box(at(-1, 15), at(25, 38), _WHITE, 12 * scale)
    canvas.disc(at(12, 8), 7.5 * scale, _INK)
    canvas.box(at(2, 18), at(22, 36), _INK, 9 * scale)
    canvas.box(at(2, 27), at(22, 36), _INK, 2 * scale)


def _taxi(canvas: Canvas, centre: tuple[float, float], taxi: int, west: bool, carries: bool) -> None:
    """Draw a taxi from the side, 96 wide and 56 high, its number on the door and who is in it."""
    colour, way = _TAXI_COLOURS[taxi], -1 if west else 1

    def at(dx: float, dy: float) -> tuple[float, float]:
        return centre[0] + way * dx, centre[1] + dy

    def shape(points: list[tuple[float, float]], fill: str) -> None:
        canvas.polygon([at(*point) for point in points][::way], fill)

    def slab(corner: tuple[float, float], opposite: tuple[float, float], fill: str, radius: float) -> None:
        (left, top), (right, bottom) = at(*corner), at(*opposite)
        canvas.box((min(left, right), top), (max(left, right), bottom), fill, radius)

    slab((-12, -39), (6, -26), _INK, 4)
    slab((-9, -36), (3, -26), _WHITE, 2)
    shape([(-33, 2), (-25, -32), (18, -32), (33, 2)], _INK)
    slab((-47, -6), (47, 21), _INK, 10)
    shape([(-29, 0), (-23, -29), (16, -29), (29, 0)], colour)
    slab((-44, -3), (44, 18), colour, 8)
    shape([(-24, -5), (-19, -26), (14, -26), (23, -5)], YELLOW if carries else _GLASS)
    if carries:  # a light window, so that the passenger is seen at a glance
        canvas.disc(at(-3, -18), 6.5, _INK)
        slab((-14, -10), (8, -5), _INK, 5)
        slab((-14, -8), (8, -5), _INK, 0)
    for wheel in (-26, 26):
        canvas.disc(at(wheel, 18), 10, _INK)
        canvas.disc(at(wheel, 18), 4, _WHITE)
    slab((-11, -2), (11, 18), _WHITE, 4)
    left, top = at(0, 1.5)
    canvas.text((left - text_width("1", 13) / 2, top), str(taxi + 1), 13, BLACK)


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


def place_things(grid: Grid) -> tuple[NDArray[np.int16], NDArray[np.int8]]:
    """Return where each thing is in each state, and what carries it.

    Returns:
        Cell index (row * columns + column) of each of `THINGS`, int16 [S, 4], and the index in `THINGS` of
        the thing that carries it, or -1, int8 [S, 4]; both read-only.
    """
    axes = np.indices(grid.state_shape).reshape(len(grid.state_shape), -1)
    cell_1, cell_2, passenger, destination = axes
    waits_at = np.append(grid.landmark_cells, (0, 0))[passenger]  # the two zeros are never chosen below
    rides_in = passenger - len(grid.landmarks)
    passenger_cell = np.choose(rides_in.clip(-1) + 1, (waits_at, cell_1, cell_2))
    cells = np.stack((cell_1, cell_2, passenger_cell, grid.landmark_cells[destination]), axis=1).astype(
        np.int16
    )
    carriers = np.full(cells.shape, -1, dtype=np.int8)
    carriers[:, THINGS.index("passenger")] = rides_in.clip(-1)
    cells.flags.writeable = carriers.flags.writeable = False
    return cells, carriers
