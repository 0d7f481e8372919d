"""The grid of a scene as SVG: what never moves is drawn once, and a frame is where each thing is.

    drawing = SvgDrawing(mdp.scene)
    places = drawing.places(mdp, states)              # int16 [frames, things, 3]: x, y, size in percent
    svg = drawing.frame(places[3], "step 3")

Pages, films and notebooks all draw a grid with this module: they move the same elements to the places
computed here. Lengths are in units of a hundredth of a cell. Nothing relies on colour alone: landmarks have
letters, movers have numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Final

import numpy as np
from numpy.typing import NDArray

from runner.drawing import palette
from runner.environments.mdp import Landmark, Mdp, SceneDescription
from runner.util.arrays import Array
from runner.util.humanize import capitalised

CELL: Final = 100
MARGIN: Final = 14
TRAIL: Final = 40
"""Number of a mover's last places that its trail joins."""
TRAIL_WIDTH: Final = 7
TRAIL_OPACITY: Final = 0.55
BROAD: Final = 8.5 * CELL
"""A page gives its whole width to a grid that is wider than this."""

_FONT: Final = "font-family:'DejaVu Sans',sans-serif;font-weight:bold"
_GRID: Final = palette.GRID
STYLE: Final = (
    f".g-paper{{fill:{_GRID['line']}}}"
    f".g-cell{{fill:{_GRID['cell']};stroke:{_GRID['cell-edge']};stroke-width:2}}"
    f".g-wall{{stroke:{_GRID['line']};stroke-width:10;stroke-linecap:round}}"
    ".g-tint{opacity:.3}.g-hazard{opacity:.8}"
    f".g-letter{{{_FONT};font-size:20px;text-anchor:middle}}"
    f".g-number{{{_FONT};font-size:17px;text-anchor:middle;fill:{_GRID['number']}}}"
    f".g-outline{{stroke:{_GRID['line']};stroke-width:3;stroke-linejoin:round}}"
    f".g-glass{{fill:{_GRID['glass']};stroke:{_GRID['line']};stroke-width:2}}"
    f".g-wheel{{fill:{_GRID['line']}}}.g-hub,.g-plate{{fill:{palette.WHITE}}}"
    f".g-person{{fill:{_GRID['line']};stroke:{palette.WHITE};stroke-width:3;paint-order:stroke}}"
    f".g-ring{{fill:none;stroke:{_GRID['ring']};stroke-width:6}}"
    f".g-pole{{stroke:{_GRID['line']};stroke-width:4;stroke-linecap:round}}"
    f".g-flag{{fill:{palette.GOAL};stroke:{_GRID['line']};stroke-width:2.5;stroke-linejoin:round}}"
    f".g-trail{{fill:none;stroke-width:{TRAIL_WIDTH};stroke-linecap:round;stroke-linejoin:round;"
    f"opacity:{TRAIL_OPACITY:g}}}"
)
"""CSS of a picture that is shown alone."""
DARK_STYLE: Final = ".g-paper,.m-paper{{fill:{line}}}.g-cell{{fill:{cell};stroke:{cell-edge}}}".format(
    **palette.GRID_DARK
)
"""CSS that a dark page adds."""

_OFFSETS: Final = {"mover": (0, 16), "goal": (0, 0), "passenger": (4, -24)}
"""Where a kind of thing is drawn, from the middle of its cell."""
_CARRIED_OFFSET: Final = (-4, -22)
"""Where a carried thing is drawn, from its carrier."""
VEHICLES: Final = ("taxi", "car", "bus", "truck")
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


class SvgDrawing:
    """Draws the grid of one scene."""

    def __init__(self, scene: SceneDescription) -> None:
        self._scene = scene
        self._things = scene["things"]
        self.movers = [i for i, thing in enumerate(self._things) if thing["kind"] == "mover"]
        """Indices of the things that move by themselves."""
        self.width = scene["columns"] * CELL + 2 * MARGIN
        self.height = scene["rows"] * CELL + 2 * MARGIN

    def places(self, mdp: Mdp, states: Array) -> NDArray[np.int16]:
        """Return where each thing is drawn in each state.

        Returns:
            int16 [states, things, 3]: x and y of its middle, and its size in percent.
        """
        if mdp.scene_cells is None:
            raise ValueError("a scene without cells cannot be drawn")
        cells = mdp.scene_cells[states].astype(np.int64)
        carriers = mdp.carriers[states]
        rows, columns = np.divmod(cells, self._scene["columns"])
        middle = CELL // 2 + MARGIN
        places = np.stack((columns * CELL + middle, rows * CELL + middle, np.full(cells.shape, 100)), axis=-1)
        for number, thing in enumerate(self._things):
            places[:, number, :2] += _OFFSETS.get(thing["kind"], _OFFSETS["passenger"])
        for mover in self.movers:  # movers in the same cell are drawn side by side
            for other in self.movers:
                together = (cells[:, mover] == cells[:, other]) & (mover != other)
                places[together, mover, :2] += np.array((12, 8)) * (1 if mover > other else -1)
        for number in range(len(self._things)):
            carried = np.flatnonzero(carriers[:, number] >= 0)
            carrier = carriers[carried, number]
            places[carried, number, :2] = places[carried, carrier, :2] + _CARRIED_OFFSET
            places[carried, number, 2] = 70
        return places.astype(np.int16)

    def key(self) -> str:
        """Return a sentence that explains the picture."""
        entries = [
            f"{self._sign_in_words(number)}: {thing['label']}" for number, thing in enumerate(self._things)
        ]
        labelled = (mark for mark in self._scene["landmarks"] if "label" in mark)
        entries += dict.fromkeys(f"{mark['name']}: {mark['label']}" for mark in labelled)
        entries += ["thick lines: walls"] if self._scene["walls"] else []
        text = "; ".join([*entries, "faint line: the way so far"])
        return f"{capitalised(text)}."

    def still(self) -> str:
        """Return what never moves: the cells, the landmarks and the walls."""
        paper = f'<rect class="g-paper" width="{self.width}" height="{self.height}" rx="12"/>'
        corners = (corner(self._scene, cell) for cell in range(self._scene["rows"] * self._scene["columns"]))
        cells = [f'<rect class="g-cell" x="{x}" y="{y}" width="{CELL}" height="{CELL}"/>' for x, y in corners]
        marks = [self._landmark(mark) for mark in self._scene["landmarks"]]
        return "".join([paper, *cells, *marks, self.walls()])

    def letters(self) -> str:
        """Return the letters of the landmarks, for pictures with something drawn over what never moves."""
        return "".join(map(self._letter, self._scene["landmarks"]))

    def walls(self) -> str:
        """Return the walls between cells."""
        lines = []
        for wall in self._scene["walls"]:
            ends = (MARGIN + coordinate * CELL for point in wall_ends(wall) for coordinate in point)
            lines.append('<line class="g-wall" x1="{}" y1="{}" x2="{}" y2="{}"/>'.format(*ends))
        return "".join(lines)

    def trails(self, places: NDArray[np.int16] | None) -> str:
        """Return the trails of the movers over the frames so far, [frames, things, 3]."""
        return "".join(
            f'<polyline class="g-trail" data-trail="{thing}" stroke="{self.colour(thing)}" '
            f'points="{"" if places is None else trail_points(places[:, thing])}"/>'
            for thing in self.movers
        )

    def order(self) -> list[int]:
        """Return the things in the order in which they are drawn: goals first, passengers last."""
        rank = {"goal": 0, "mover": 1}
        return sorted(range(len(self._things)), key=lambda i: rank.get(self._things[i]["kind"], 2))

    def things(self, place: NDArray[np.int16]) -> str:
        """Return the things at their places, [things, 3]."""
        return "".join(
            f'<g class="g-thing" data-thing="{i}" transform="{transform(place[i])}">{self.shape(i)}</g>'
            for i in self.order()
        )

    def frame(
        self,
        place: NDArray[np.int16] | None,
        title: str,
        trail: NDArray[np.int16] | None = None,
        style: str = STYLE,
    ) -> str:
        """Return a whole picture, with a description for screen readers.

        `place` is where the things are, [things, 3]; None if a script moves them. `trail` has the places of
        earlier frames, [frames, things, 3]. `style` is the CSS; empty if the page has it.
        """
        if place is None:
            place = np.zeros((len(self._things), 3), np.int16)
        content = f"{self.still()}{self.trails(trail)}{self.things(place)}"
        return picture(
            self.width, self.height, title, f"<style>{style}</style>{content}" if style else content
        )

    def shape(self, number: int) -> str:
        """Return the elements of a thing, around the origin."""
        thing = self._things[number]
        if thing["kind"] == "goal":
            return _GOAL
        if thing["kind"] != "mover":
            return _PERSON
        label = thing["label"]
        sign = escape(label[-1] if label[-1].isdigit() else label[0].upper())
        pattern = _CAR if label.split()[0] in VEHICLES else _PAWN
        return pattern.format(colour=self.colour(number), sign=sign if len(self.movers) > 1 else "")

    def colour(self, mover: int) -> str:
        """Return the colour of a mover."""
        return palette.agent(self.movers.index(mover))

    def _landmark(self, mark: Landmark) -> str:
        """Return a tinted cell with a letter: hazards have a strong tint, goals a flag."""
        row, column = mark["cell"]
        x, y = corner(self._scene, row * self._scene["columns"] + column)
        colour = mark["colour"]
        kind = mark.get("kind")
        tint = "g-hazard" if kind == "hazard" else "g-tint"
        return (
            f'<rect class="{tint}" x="{x + 2}" y="{y + 2}" width="{CELL - 4}" height="{CELL - 4}" '
            f'fill="{colour}"/>{self._letter(mark)}'
            + (f'<g transform="translate({x + 50} {y + 50})">{_GOAL}</g>' if kind == "goal" else "")
        )

    def _letter(self, mark: Landmark) -> str:
        row, column = mark["cell"]
        x, y = corner(self._scene, row * self._scene["columns"] + column)
        return (
            f'<rect x="{x + 7}" y="{y + 7}" width="28" height="28" rx="5" fill="{mark["colour"]}"/>'
            f'<text class="g-letter" x="{x + 21}" y="{y + 28}" fill="{palette.ink_on(mark["colour"])}">'
            f"{escape(mark['name'][:2])}</text>"
        )

    def _sign_in_words(self, number: int) -> str:
        kind = self._things[number]["kind"]
        if kind == "mover":
            return palette.AGENTS[self.colour(number)]
        return "frame with a flag" if kind == "goal" else "black figure"


def drawing_of(mdp: Mdp) -> SvgDrawing | None:
    """Return the drawing of an environment's scene; None if it has none, or one without cells."""
    return None if mdp.scene is None or mdp.scene_cells is None else SvgDrawing(mdp.scene)


def picture(width: float, height: float, title: str, content: str) -> str:
    """Return elements as an SVG picture with a description for screen readers."""
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" role="img" '
        f'aria-label="{escape(title)}">{content}</svg>'
    )


def wall_ends(cells: Sequence[Sequence[int]]) -> list[tuple[int, int]]:
    """Return the ends (x, y) of the wall between two neighbouring cells, in cells from the upper left."""
    y, x = (max(ends) for ends in zip(*cells, strict=True))
    return [(x, y), (x, y + 1) if cells[0][0] == cells[1][0] else (x + 1, y)]


def corner(scene: SceneDescription, cell: int) -> tuple[int, int]:
    """Return the upper left corner of a cell, counted row by row."""
    row, column = divmod(cell, scene["columns"])
    return MARGIN + column * CELL, MARGIN + row * CELL


def transform(place: Sequence[int] | NDArray[np.int16]) -> str:
    """Return the SVG transform that moves a thing to its place (x, y, size in percent)."""
    x, y, percent = (int(value) for value in place)
    return f"translate({x} {y}) scale({percent / 100:g})"


def trail_points(places: NDArray[np.int16]) -> str:
    """Return the points of a trail from a mover's places so far, [frames, 3]."""
    return " ".join(f"{x},{y}" for x, y, _ in places[-TRAIL:].tolist())
