"""A state of an environment as a drawing for the terminal, from the scene alone.

    +-----------------------+
    |R 1  |            G*   |       a cell has a place for each thing, so that nothing jumps about
    +     +     +     +     +
    |     |       2p        |

Letters say everything; colours, where there are any, only repeat it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from runner.environments.naming import spoken

if TYPE_CHECKING:
    from rich.text import Text

_PALETTE: Final = ("#E69F00", "#56B4E9", "#009E73", "#CC79A7", "#F0E442", "#0072B2")
"""Of the movers, one after the other; Okabe and Ito's, told apart with any colour blindness."""
_GOAL: Final = "bold #CC79A7"

Cell = tuple[int, int]


class Drawing:
    """Draws states of one scene.

    Args:
        scene: rows, columns, walls, landmarks and things, as an environment describes them.
    """

    def __init__(self, scene: Mapping[str, Any]) -> None:
        self._rows, self._columns = int(scene["rows"]), int(scene["columns"])
        self._walls = {frozenset((tuple(one), tuple(other))) for one, other in scene["walls"]}
        self._landmarks = {tuple(mark["cell"]): mark for mark in scene["landmarks"]}
        self._things: Sequence[Mapping[str, Any]] = scene["things"]
        self._signs = signs(self._things)
        self._styles = _styles(self._things)
        self._width = 1 + len(self._things)

    @property
    def legend(self) -> str:
        """What the signs mean."""
        told = [f"{sign} {thing['label']}" for sign, thing in zip(self._signs, self._things, strict=True)]
        carried = [sign for sign in self._signs if sign.islower()]
        return "   ".join(told) + ("   (a capital: it is carried)" if carried else "")

    def draw(self, cells: Sequence[int], carriers: Sequence[int]) -> Text:
        """Return the drawing of a state: the cell (row * columns + column) and the carrier of each thing."""
        from rich.text import Text

        drawn = Text()
        for row in range(self._rows):
            self._border(drawn, row)
            self._row(drawn, row, cells, carriers)
        self._border(drawn, self._rows)
        drawn.rstrip()
        return drawn

    def _border(self, drawn: Text, row: int) -> None:
        """Draw the line above a row: full at the edges, else only where there is a wall."""
        for column in range(self._columns):
            walled = row in (0, self._rows) or self._wall((row - 1, column), (row, column))
            drawn.append("+" + ("-" if walled else " ") * self._width)
        drawn.append("+\n")

    def _row(self, drawn: Text, row: int, cells: Sequence[int], carriers: Sequence[int]) -> None:
        for column in range(self._columns):
            walled = column == 0 or self._wall((row, column - 1), (row, column))
            drawn.append("|" if walled else " ")
            self._cell(drawn, (row, column), cells, carriers)
        drawn.append("|\n")

    def _cell(self, drawn: Text, cell: Cell, cells: Sequence[int], carriers: Sequence[int]) -> None:
        mark = self._landmarks.get(cell)
        drawn.append(mark["name"][:1] if mark else " ", style=f"bold {mark['colour']}" if mark else "")
        number = cell[0] * self._columns + cell[1]
        for i, sign in enumerate(self._signs):
            if cells[i] != number:
                drawn.append(" ")
            elif carriers[i] >= 0:
                drawn.append(sign.upper(), style=self._styles[carriers[i]])
            else:
                drawn.append(sign, style=self._styles[i])

    def _wall(self, one: Cell, other: Cell) -> bool:
        return frozenset((one, other)) in self._walls


def signs(things: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a letter for each thing: `*` for a goal, a mover's number, else a lower-case initial."""
    found = []
    for thing in things:
        last, first = spoken(thing["label"]).split()[-1], thing["label"][0]
        if thing["kind"] == "goal":
            found.append("*")
        elif thing["kind"] == "mover":
            found.append(last if last.isdecimal() and len(last) == 1 else first.upper())
        else:
            found.append(first.lower())
    return found


def _styles(things: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return how each thing is coloured."""
    movers = [thing["name"] for thing in things if thing["kind"] == "mover"]
    styles = []
    for thing in things:
        if thing["kind"] == "mover":
            styles.append(f"bold black on {_PALETTE[movers.index(thing['name']) % len(_PALETTE)]}")
        else:
            styles.append(_GOAL if thing["kind"] == "goal" else "bold")
    return styles
