"""The map: its cells, landmarks and walls, where each move leads, and the numbers of states and actions."""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

DEFAULT_MAP = (
    "+-------+",
    "|R: | :G|",
    "| : | : |",
    "| | : : |",
    "|Y: |B: |",
    "+-------+",
)
"""The published map. `:` between two cells is open, `|` is a wall; a letter is a landmark."""

AGENTS = ("taxi_1", "taxi_2")
"""The two taxis; the first is the most significant in a joint action."""

ACTIONS = ("south", "north", "east", "west", "pickup", "drop_off")
"""The actions of one taxi, in the order of their numbers."""

MOVES = ((1, 0), (-1, 0), (0, 1), (0, -1))
"""(rows, columns) that each of the first four actions moves a taxi by; row 0 is the top row."""

PICKUP, DROP_OFF = ACTIONS.index("pickup"), ACTIONS.index("drop_off")

SIDEWAYS = ((2, 3), (2, 3), (0, 1), (0, 1))
"""For each move, the two moves perpendicular to it."""


class Landmark(NamedTuple):
    """A lettered cell where the passenger may wait or want to go."""

    name: str
    row: int
    column: int

    @property
    def cell(self) -> tuple[int, int]:
        """Its (row, column)."""
        return self.row, self.column


class State(NamedTuple):
    """A state taken apart.

    Attributes:
        taxi_1: (row, column) of taxi 1.
        taxi_2: (row, column) of taxi 2.
        passenger: Number of the landmark where the passenger waits; the number of landmarks means "in
            taxi 1", one more "in taxi 2".
        destination: Number of the landmark where the passenger wants to go.
    """

    taxi_1: tuple[int, int]
    taxi_2: tuple[int, int]
    passenger: int
    destination: int


@dataclass(frozen=True)
class Grid:
    """A rectangular map; landmarks are numbered in reading order (left to right, top to bottom).

    States are numbered in mixed radix, the first field of `State` the most significant.

    Attributes:
        rows: Number of rows.
        columns: Number of columns.
        landmarks: The lettered cells in reading order.
        walls: (row, column) of every cell with a wall on its east side, in reading order.
    """

    rows: int
    columns: int
    landmarks: tuple[Landmark, ...]
    walls: tuple[tuple[int, int], ...]

    @classmethod
    def from_text(cls, text: Sequence[str]) -> Grid:
        """Return the grid that `text` draws in the style of `DEFAULT_MAP`.

        Raises:
            ValueError: `text` is no such drawing, has fewer than two landmarks, or is cut in two by a wall.
        """
        rows, columns = _size(text)
        landmarks, walls = [], []
        for row, line in enumerate(text[1:-1]):
            _check_row(row, line)
            landmarks += [Landmark(name, row, i) for i, name in enumerate(line[1::2]) if name != " "]
            walls += [(row, i) for i, gap in enumerate(line[2:-1:2]) if gap == "|"]
        grid = cls(rows, columns, tuple(landmarks), tuple(walls))
        _check_landmarks(grid)
        _check_connected(grid)
        return grid

    @property
    def cells(self) -> int:
        """Number of cells; a cell's index is row * columns + column."""
        return self.rows * self.columns

    @cached_property
    def landmark_cells(self) -> NDArray[np.intp]:
        """Cell index of each landmark, intp [landmarks]."""
        return np.array([mark.row * self.columns + mark.column for mark in self.landmarks], dtype=np.intp)

    @cached_property
    def landmark_at(self) -> NDArray[np.intp]:
        """Number of the landmark at each cell, or -1 where there is none, intp [cells]."""
        numbers = np.full(self.cells, -1, dtype=np.intp)
        numbers[self.landmark_cells] = np.arange(len(self.landmarks))
        return numbers

    @cached_property
    def cell_after(self) -> NDArray[np.intp]:
        """Cell index in which an action leaves a taxi, intp [cells, actions].

        A move against a wall or over the edge leaves the taxi where it is, as pickup and drop-off do.
        """
        after = np.repeat(np.arange(self.cells)[:, np.newaxis], len(ACTIONS), axis=1)
        row = np.arange(self.cells) // self.columns
        wall_east = np.zeros((self.rows, self.columns), dtype=bool)
        wall_east[:, -1] = True
        for wall in self.walls:
            wall_east[wall] = True
        wall_west = np.roll(wall_east, 1, axis=1)  # the last column's wall serves as the first column's
        blocked = (row == self.rows - 1, row == 0, wall_east.ravel(), wall_west.ravel())
        for action, (rows, columns) in enumerate(MOVES):
            after[:, action] += np.where(blocked[action], 0, rows * self.columns + columns)
        return after

    @property
    def state_shape(self) -> tuple[int, int, int, int]:
        """(cells of taxi 1, cells of taxi 2, passenger places, destinations): C order numbers the states."""
        landmarks = len(self.landmarks)
        return self.cells, self.cells, landmarks + 2, landmarks

    @property
    def states(self) -> int:
        """Number of states."""
        return math.prod(self.state_shape)

    def encode(
        self, taxi_1: tuple[int, int], taxi_2: tuple[int, int], passenger: int, destination: int
    ) -> int:
        """Return the number of a state, given as the fields of `State`.

        Raises:
            ValueError: A field is outside its range.
        """
        cells, _, places, destinations = self.state_shape
        number = self._cell("taxi_1", taxi_1) * cells + self._cell("taxi_2", taxi_2)
        number = number * places + _checked("passenger", passenger, places)
        return number * destinations + _checked("destination", destination, destinations)

    def decode(self, state: int) -> State:
        """Return the fields of state number `state`.

        Raises:
            ValueError: There is no such state.
        """
        cells, _, places, destinations = self.state_shape
        rest, destination = divmod(_checked("state", state, self.states), destinations)
        rest, passenger = divmod(rest, places)
        cell_1, cell_2 = divmod(rest, cells)
        return State(divmod(cell_1, self.columns), divmod(cell_2, self.columns), passenger, destination)

    def _cell(self, taxi: str, place: tuple[int, int]) -> int:
        row, column = place
        row = _checked(f"row of {taxi}", row, self.rows)
        return row * self.columns + _checked(f"column of {taxi}", column, self.columns)


def encode_action(action_1: int, action_2: int) -> int:
    """Return the joint action, action_1 * 6 + action_2, of the two taxis' actions.

    Raises:
        ValueError: An action is outside 0 to 5.
    """
    count = len(ACTIONS)
    first = _checked("action of taxi_1", action_1, count)
    return first * count + _checked("action of taxi_2", action_2, count)


def decode_action(action: int) -> tuple[int, int]:
    """Return the actions of taxi 1 and taxi 2 in a joint action.

    Raises:
        ValueError: The joint action is outside 0 to 35.
    """
    return divmod(_checked("joint action", action, len(ACTIONS) ** 2), len(ACTIONS))


def _checked(name: str, value: int, count: int) -> int:
    """Return `value` as an int; refuse one that is not in range(count)."""
    try:
        number = operator.index(value)
    except TypeError:
        number = -1
    if not 0 <= number < count:
        raise ValueError(f"{name} is {value!r}, expected a whole number from 0 to {count - 1}")
    return number


def _size(text: Sequence[str]) -> tuple[int, int]:
    """Return the rows and columns of a map whose frame is drawn as it should be."""
    if (
        isinstance(text, str)
        or not isinstance(text, Sequence)
        or not all(isinstance(line, str) for line in text)
    ):
        raise ValueError(
            f"map is {text!r}, expected a list of strings, one a line; see dualtaxi.DEFAULT_MAP for the style"
        )
    width = len(text[0]) if text else 0
    if len(text) < 3 or width < 3 or width % 2 == 0:
        raise ValueError(
            f"map has {len(text)} lines of {width} characters, expected at least 3 lines of an odd number of "
            "characters: a frame around cells with ':' or '|' between them; see dualtaxi.DEFAULT_MAP"
        )
    frame = "+" + "-" * (width - 2) + "+"
    for number, line in ((0, text[0]), (len(text) - 1, text[-1])):
        if line != frame:
            raise ValueError(f"map line {number} is {line!r}, expected the frame {frame!r}")
    for number, line in enumerate(text):
        if len(line) != width:
            raise ValueError(
                f"map line {number} ({line!r}) has {len(line)} characters, expected {width} as in line 0"
            )
    return len(text) - 2, width // 2


def _check_row(row: int, line: str) -> None:
    """Refuse a line with anything but cells, open borders and walls in it."""
    place = f"map line {row + 1} ({line!r})"
    if line[0] != "|" or line[-1] != "|":
        raise ValueError(f"{place} begins or ends without '|', expected the frame on both sides")
    for column, name in enumerate(line[1::2]):
        if not (name == " " or (name.isascii() and name.isupper())):
            raise ValueError(
                f"{place} has {name!r} in column {column}, expected a space, or a landmark's letter A to Z"
            )
    for column, gap in enumerate(line[2:-1:2]):
        if gap not in ":|":
            raise ValueError(
                f"{place} has {gap!r} between columns {column} and {column + 1}, "
                "expected ':' (open) or '|' (wall)"
            )


def _check_landmarks(grid: Grid) -> None:
    """Refuse fewer than two landmarks, or two of one name."""
    names = [mark.name for mark in grid.landmarks]
    if len(names) < 2:
        raise ValueError(
            f"map has {len(names)} landmarks, expected at least 2 (a passenger rides from one to another); "
            "write a letter A to Z into more cells"
        )
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"map has landmark {twice[0]!r} more than once, expected each letter once")


def _check_connected(grid: Grid) -> None:
    """Refuse a wall from top to bottom: some passengers could never be delivered."""
    for column in range(grid.columns - 1):
        if all((row, column) in grid.walls for row in range(grid.rows)):
            raise ValueError(
                f"map has a wall between columns {column} and {column + 1} in every row; "
                "open one with ':', or some passengers can never be delivered"
            )
