"""A state of an environment as a drawing for the terminal, from the scene alone.

    +-----------------------+
    |R 1  |            G*   |       a cell has a place for each thing, so that nothing changes its column
    +     +     +     +     +
    |     |       2p        |

Letters are enough to read it; colours, where there are any, only repeat them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from runner.drawing import palette
from runner.environments.mdp import SceneDescription, Thing
from runner.environments.naming import spoken

if TYPE_CHECKING:
    from rich.text import Text

Cell = tuple[int, int]


class TextDrawing:
    """Draws states of one scene."""

    def __init__(self, scene: SceneDescription) -> None:
        self._rows = scene["rows"]
        self._columns = scene["columns"]
        self._walls = {frozenset((tuple(cell), tuple(other))) for cell, other in scene["walls"]}
        self._landmarks = {tuple(mark["cell"]): mark for mark in scene["landmarks"]}
        self._things = scene["things"]
        self._signs = signs(self._things)
        self._styles = _styles(self._things)

    @property
    def legend(self) -> str:
        """What the signs stand for."""
        entries = [f"{sign} {thing['label']}" for sign, thing in zip(self._signs, self._things, strict=True)]
        has_passengers = any(sign.islower() for sign in self._signs)
        return "   ".join(entries) + ("   (a capital: it is carried)" if has_passengers else "")

    def draw(self, cells: Sequence[int], carriers: Sequence[int]) -> Text:
        """Return the drawing of a state: the cell (row * columns + column) and the carrier of each thing."""
        from rich.text import Text

        text = Text()
        for row in range(self._rows):
            self._border(text, row)
            for column in range(self._columns):
                text.append("|" if column == 0 or self._wall((row, column - 1), (row, column)) else " ")
                self._cell(text, (row, column), cells, carriers)
            text.append("|\n")
        self._border(text, self._rows)
        text.rstrip()
        return text

    def _border(self, text: Text, row: int) -> None:
        """Draw the line above a row: solid at the edges, elsewhere only along walls."""
        for column in range(self._columns):
            solid = row in (0, self._rows) or self._wall((row - 1, column), (row, column))
            text.append("+" + ("-" if solid else " ") * (1 + len(self._things)))
        text.append("+\n")

    def _cell(self, text: Text, cell: Cell, cells: Sequence[int], carriers: Sequence[int]) -> None:
        mark = self._landmarks.get(cell)
        text.append(mark["name"][:1] if mark else " ", style=f"bold {mark['colour']}" if mark else "")
        number = cell[0] * self._columns + cell[1]
        for i, sign in enumerate(self._signs):
            if cells[i] != number:
                text.append(" ")
            elif carriers[i] >= 0:
                text.append(sign.upper(), style=self._styles[carriers[i]])
            else:
                text.append(sign, style=self._styles[i])

    def _wall(self, cell: Cell, other: Cell) -> bool:
        return frozenset((cell, other)) in self._walls


def signs(things: Sequence[Thing]) -> list[str]:
    """Return a letter for each thing: `*` for a goal, a mover's number, else a lower-case initial."""
    result = []
    for thing in things:
        last, first = spoken(thing["label"]).split()[-1], thing["label"][0]
        if thing["kind"] == "goal":
            result.append("*")
        elif thing["kind"] == "mover":
            result.append(last if last.isdecimal() and len(last) == 1 else first.upper())
        else:
            result.append(first.lower())
    return result


def _styles(things: Sequence[Thing]) -> list[str]:
    """Return the style of each thing, as Rich writes it."""
    movers = [thing["name"] for thing in things if thing["kind"] == "mover"]
    others = {"goal": f"bold {palette.GOAL}"}
    return [
        f"bold black on {palette.agent(movers.index(thing['name']))}"
        if thing["kind"] == "mover"
        else others.get(thing["kind"], "bold")
        for thing in things
    ]
