"""The map: cells, landmarks, walls, and where each move leads."""

from __future__ import annotations

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


@dataclass(frozen=True)
class Grid:
    """A rectangular map; landmarks are numbered in reading order (left to right, top to bottom).

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
