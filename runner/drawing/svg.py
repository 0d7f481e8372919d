"""The grid of a scene as SVG: what never changes once, and a frame as where each thing stands.

    drawing = Drawing(mdp.scene)
    places = drawing.places(mdp, states)              # int16 [frames, things, 3]: x, y, size in percent
    svg = drawing.frame(places[3], "step 3")

This is the only place where a grid is drawn: the notebook shows these frames, and page and film move the
very same elements to the places computed here. Lengths are in units of a hundredth of a cell. Colours
are of Okabe and Ito, and nothing is told by colour alone: landmarks have letters, movers numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.environments.mdp import Mdp

CELL: Final = 100
MARGIN: Final = 14
TRAIL: Final = 40
"""So many of a mover's last places are joined by its trail."""
TRAIL_WIDTH: Final = 7
TRAIL_OPACITY: Final = 0.55

MOVER_COLOURS: Final = ("#E69F00", "#56B4E9", "#009E73", "#CC79A7", "#F0E442", "#D55E00")
_COLOUR_NAMES: Final = dict(
    zip(MOVER_COLOURS, ("orange", "blue", "green", "pink", "yellow", "red"), strict=True)
)
_FONT: Final = "font-family:'DejaVu Sans',sans-serif;font-weight:bold"

STYLE: Final = (
    ".g-paper{fill:#22262b}.g-cell{fill:#ffffff;stroke:#d9d6cf;stroke-width:2}"
    ".g-wall{stroke:#22262b;stroke-width:10;stroke-linecap:round}"
    ".g-tint{opacity:.3}.g-hazard{opacity:.8}"
    f".g-letter{{{_FONT};font-size:20px;text-anchor:middle}}"
    f".g-number{{{_FONT};font-size:17px;text-anchor:middle;fill:#111111}}"
    ".g-outline{stroke:#22262b;stroke-width:3;stroke-linejoin:round}"
    ".g-glass{fill:#eaf3f8;stroke:#22262b;stroke-width:2}"
    ".g-wheel{fill:#22262b}.g-hub{fill:#ffffff}.g-plate{fill:#ffffff}"
    ".g-person{fill:#22262b;stroke:#ffffff;stroke-width:3;paint-order:stroke}"
    ".g-ring{fill:none;stroke:#B0357F;stroke-width:6}.g-pole{stroke:#22262b;stroke-width:4;stroke-linecap:round}"
    ".g-flag{fill:#CC79A7;stroke:#22262b;stroke-width:2.5;stroke-linejoin:round}"
    f".g-trail{{fill:none;stroke-width:{TRAIL_WIDTH};stroke-linecap:round;stroke-linejoin:round;"
    f"opacity:{TRAIL_OPACITY:g}}}"
)
"""The rules of a picture that stands alone; a page may override them for the dark."""


class Drawing:
    """How the grid of one scene is drawn."""

    def __init__(self, scene: Mapping[str, Any]) -> None:
        self._scene = scene
        self._things: Sequence[Mapping[str, Any]] = scene["things"]
        self.movers = [i for i, thing in enumerate(self._things) if thing["kind"] == "mover"]
        """Which things move by themselves."""
        self.width = scene["columns"] * CELL + 2 * MARGIN
        self.height = scene["rows"] * CELL + 2 * MARGIN

    def places(self, mdp: Mdp, states: NDArray[Any]) -> NDArray[np.int16]:
        """Return where each thing is drawn in each state.

        Returns:
            int16 [states, things, 3]: x and y of its middle, and its size in percent.
        """
        if mdp.scene_cells is None:
            raise ValueError("a scene without cells cannot be drawn")
        cells = mdp.scene_cells[states].astype(np.int64)
        carriers = np.full(cells.shape, -1) if mdp.scene_carriers is None else mdp.scene_carriers[states]
        rows, columns = np.divmod(cells, self._scene["columns"])
        middle = CELL // 2 + MARGIN
        places = np.stack((columns * CELL + middle, rows * CELL + middle, np.full(cells.shape, 100)), axis=-1)
        for number, thing in enumerate(self._things):
            places[:, number, :2] += _OFFSETS.get(thing["kind"], _OFFSETS["passenger"])
        self._part_movers(places, cells)
        for number in range(len(self._things)):
            carried = np.flatnonzero(carriers[:, number] >= 0)
            by = carriers[carried, number]
            places[carried, number, :2] = places[carried, by, :2] + _RIDES
            places[carried, number, 2] = 70
        return places.astype(np.int16)

    def key(self) -> str:
        """Return in words what the picture shows, for someone who sees it for the first time."""
        said = [self._thing_in_words(thing) for thing in self._things]
        named = dict.fromkeys(
            f"{mark['name']}: {mark['label']}" for mark in self._scene["landmarks"] if "label" in mark
        )
        said += [*named]
        said += ["thick lines: walls"] if self._scene["walls"] else []
        text = "; ".join([*said, "faint line: the way so far"])
        return f"{text[0].upper()}{text[1:]}."

    def still(self) -> str:
        """Return what never changes: the cells, the landmarks and the walls."""
        paper = f'<rect class="g-paper" width="{self.width}" height="{self.height}" rx="12"/>'
        cells = [
            f'<rect class="g-cell" x="{x}" y="{y}" width="{CELL}" height="{CELL}"/>'
            for x, y in map(self._corner, range(self._scene["rows"] * self._scene["columns"]))
        ]
        marks = [self._landmark(mark) for mark in self._scene["landmarks"]]
        return "".join([paper, *cells, *marks, self.walls()])

    def walls(self) -> str:
        """Return the walls between cells."""
        lines = []
        for (row, column), (other_row, other_column) in self._scene["walls"]:
            x, y = MARGIN + max(column, other_column) * CELL, MARGIN + max(row, other_row) * CELL
            across = (x, y, x, y + CELL) if row == other_row else (x, y, x + CELL, y)
            lines.append('<line class="g-wall" x1="{}" y1="{}" x2="{}" y2="{}"/>'.format(*across))
        return "".join(lines)

    def trails(self, places: NDArray[np.int16] | None = None) -> str:
        """Return the trails of the movers over the frames so far, [frames, things, 3]."""
        return "".join(
            f'<polyline class="g-trail" data-trail="{thing}" stroke="{self.colour(thing)}" '
            f'points="{"" if places is None else trail_points(places[:, thing])}"/>'
            for thing in self.movers
        )

    def order(self) -> list[int]:
        """Return the things in the order in which they are drawn: goals first, riders last."""
        rank = {"goal": 0, "mover": 1}
        return sorted(range(len(self._things)), key=lambda i: rank.get(self._things[i]["kind"], 2))

    def things(self, place: NDArray[np.int16]) -> str:
        """Return the things at their places [things, 3]; those that stand still are at the bottom."""
        return "".join(
            f'<g class="g-thing" data-thing="{i}" transform="{transform(place[i])}">{self.shape(i)}</g>'
            for i in self.order()
        )

    def frame(
        self, place: NDArray[np.int16], title: str, trail: NDArray[np.int16] | None = None, style: str = STYLE
    ) -> str:
        """Return a whole picture: things at `place` [things, 3], and their trail over earlier places."""
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {self.width} {self.height}" role="img" '
            f'aria-label="{escape(title)}"><style>{style}</style>'
            f"{self.still()}{self.trails(trail)}{self.things(place)}</svg>"
        )

    # --- parts ------------------------------------------------------------------------------------------

    def _part_movers(self, places: NDArray[Any], cells: NDArray[Any]) -> None:
        """Move apart those movers that are in one cell."""
        for rank, mover in enumerate(self.movers):
            for other_rank, other in enumerate(self.movers):
                if other != mover:
                    together = cells[:, mover] == cells[:, other]
                    places[together, mover, :2] += np.array((12, 8)) * (1 if rank > other_rank else -1)

    def _corner(self, cell: int) -> tuple[int, int]:
        row, column = divmod(cell, self._scene["columns"])
        return MARGIN + column * CELL, MARGIN + row * CELL

    def _landmark(self, mark: Mapping[str, Any]) -> str:
        """Return a tinted cell with a letter; danger is tinted strongly, a goal has a flag."""
        row, column = mark["cell"]
        x, y = MARGIN + column * CELL, MARGIN + row * CELL
        colour, kind = mark["colour"], mark.get("kind")
        tint = "g-hazard" if kind == "hazard" else "g-tint"
        return (
            f'<rect class="{tint}" x="{x + 2}" y="{y + 2}" width="{CELL - 4}" height="{CELL - 4}" '
            f'fill="{colour}"/><rect x="{x + 7}" y="{y + 7}" width="28" height="28" rx="5" fill="{colour}"/>'
            f'<text class="g-letter" x="{x + 21}" y="{y + 28}" fill="{ink_on(colour)}">'
            f"{escape(mark['name'][:2])}</text>"
            + (f'<g transform="translate({x + 50} {y + 50})">{_GOAL}</g>' if kind == "goal" else "")
        )

    def _thing_in_words(self, thing: Mapping[str, Any]) -> str:
        if thing["kind"] == "mover":
            return f"{_COLOUR_NAMES[self.colour(self._things.index(thing))]}: {thing['label']}"
        return f"{'frame with a flag' if thing['kind'] == 'goal' else 'black figure'}: {thing['label']}"

    def shape(self, number: int) -> str:
        """Return the elements of a thing, around the origin."""
        thing = self._things[number]
        if thing["kind"] == "goal":
            return _GOAL
        if thing["kind"] != "mover":
            return _PERSON
        colour, label = self.colour(number), thing["label"]
        sign = escape(label[-1] if label[-1].isdigit() else label[0].upper())
        pattern = _CAR if label.split()[0] in _DRIVEN else _PAWN
        return pattern.format(colour=colour, sign=sign if len(self.movers) > 1 else "")

    def colour(self, number: int) -> str:
        """Return the colour of a mover."""
        return MOVER_COLOURS[self.movers.index(number) % len(MOVER_COLOURS)]


def transform(place: Sequence[int] | NDArray[np.int16]) -> str:
    """Return the transform that brings a thing to its place (x, y, size in percent)."""
    x, y, percent = (int(value) for value in place)
    return f"translate({x} {y}) scale({percent / 100:g})"


def trail_points(places: NDArray[np.int16]) -> str:
    """Return the points of a trail from a mover's places so far, [frames, 3]."""
    return " ".join(f"{x},{y}" for x, y, _ in places[-TRAIL:].tolist())


def ink_on(colour: str) -> str:
    """Return black or white, whichever reads better on `colour`."""
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return "#000000" if 0.299 * red + 0.587 * green + 0.114 * blue > 140 else "#ffffff"


_OFFSETS: Final = {"mover": (0, 16), "goal": (0, 0), "passenger": (4, -24)}
"""Where in its cell a kind of thing is drawn, from the middle."""
_RIDES: Final = (-4, -22)
"""Where on a mover the one is drawn that it carries."""
_DRIVEN: Final = ("taxi", "car", "bus", "truck")

_CAR: Final = (
    '<path class="g-outline" fill="{colour}" d="M-25 -5L-18 -25H13L25 -5H35a5 5 0 0 1 5 5V13H-40V0'
    'a5 5 0 0 1 5 -5Z"/><path class="g-glass" d="M-19 -5L-14 -20H-3V-5ZM2 -5V-20H10L18 -5Z"/>'
    '<circle class="g-wheel" cx="-23" cy="14" r="9"/><circle class="g-hub" cx="-23" cy="14" r="3.5"/>'
    '<circle class="g-wheel" cx="23" cy="14" r="9"/><circle class="g-hub" cx="23" cy="14" r="3.5"/>'
    '<rect class="g-plate" x="-10" y="-3" width="20" height="18" rx="4"/>'
    '<text class="g-number" x="0" y="12">{sign}</text>'
)
_PAWN: Final = (
    '<path class="g-outline" fill="{colour}" d="M-20 20V6a20 20 0 0 1 40 0V20Z"/>'
    '<circle class="g-outline" fill="{colour}" cx="0" cy="-22" r="13"/>'
    '<text class="g-number" x="0" y="14">{sign}</text>'
)
_PERSON: Final = (
    '<path class="g-person" d="M-11 18V5a11 11 0 0 1 22 0V18Z"/><circle class="g-person" cy="-12" r="8"/>'
)
_GOAL: Final = (
    '<rect class="g-ring" x="-45" y="-45" width="90" height="90" rx="7"/>'
    '<path class="g-flag" d="M22 -40L42 -31L22 -22Z"/>'
    '<line class="g-pole" x1="22" y1="-40" x2="22" y2="-10"/>'
)
