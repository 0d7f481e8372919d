"""Values, greedy actions and moves on the grid of a scene, as SVG.

One mover: a cell has the colour of the highest value there, and an arrow shows the greedy action. Two movers:
each cell (the place of the first) contains the whole grid once more (the place of the second). Moves are
arrows whose width is their weight.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from runner.drawing import palette
from runner.drawing.palette import LEVELS, NO_VALUE, ink_on, ramp_colour
from runner.drawing.svg import CELL, SvgDrawing, corner, picture
from runner.environments.mdp import SceneAction, SceneDescription
from runner.util.arrays import Floats, Ints

_FONT: Final = "font-family:'DejaVu Sans',sans-serif"
STYLE: Final = (
    f".m-paper{{fill:{palette.GRID['line']}}}"
    f".m-wall{{stroke:{palette.WHITE};stroke-width:7;stroke-linecap:round}}"
    f".m-wall-edge{{stroke:{palette.GRID['line']};stroke-width:12;stroke-linecap:round}}"
    f".m-text{{{_FONT};font-size:19px;text-anchor:middle}}"
    f".m-letter{{{_FONT};font-size:18px;font-weight:bold}}"
    ".m-arrow{fill:none;stroke-width:6;stroke-linecap:round;stroke-linejoin:round}"
)
_ANGLES: Final = {(-1, 0): 0, (0, 1): 90, (1, 0): 180, (0, -1): 270}
"""Degrees by which an arrow is turned, by (rows, columns) of a move."""

WIDEST: Final = 20.0
"""Width of the heaviest arrow, in hundredths of a cell."""
_FAINTEST: Final = 0.5
"""Narrower arrows are not drawn."""
_HEAD: Final = 7.0
"""How far the head of an arrow is wider than its shaft, on each side."""


def levels_of(values: Floats, low: float, high: float) -> Ints:
    """Return the level of each value between `low` and `high`; -1 where it is nan."""
    span = high - low
    share = (values - low) / span if span > 0 else np.zeros_like(values)
    return np.where(np.isnan(values), -1, np.rint(np.nan_to_num(share).clip(0, 1) * (LEVELS - 1))).astype(int)


def policy_map(
    scene: SceneDescription,
    values: Floats,
    greedy: Floats | None,
    bounds: tuple[float, float],
    title: str,
) -> str:
    """Return the map of one mover: the highest value and the greedy action in each cell.

    `values` and `greedy` are [cells], nan where no action is better than another; without `greedy` there are
    no arrows. The bounds are the values of the darkest and of the lightest colour.
    """
    letters = {
        row * scene["columns"] + column: mark["name"][:2]
        for mark in scene["landmarks"]
        for row, column in [mark["cell"]]
    }
    parts, labels = [], []
    for cell, level in enumerate(levels_of(values, *bounds).tolist()):
        x, y = corner(scene, cell)
        colour = _colour(level)
        ink = ink_on(colour)
        parts.append(
            f'<rect x="{x + 1}" y="{y + 1}" width="{CELL - 2}" height="{CELL - 2}" fill="{colour}"/>'
        )
        if level >= 0:
            parts.append(_text(x + CELL // 2, y + CELL - 9, short(float(values[cell])), ink))
        if level >= 0 and greedy is not None:
            parts.append(_action(scene["actions"][int(greedy[cell])], x + CELL // 2, y, ink))
        if cell in letters:
            label = escape(letters[cell])
            labels.append(f'<text class="m-letter" x="{x + 8}" y="{y + 23}" fill="{ink}">{label}</text>')
    return _map(scene, "".join(parts), title, "".join(labels))


def pair_map(scene: SceneDescription, values: Floats, bounds: tuple[float, float], title: str) -> str:
    """Return the map of two movers, `values` [cells of the first, cells of the second]; see the module."""
    columns, rows = scene["columns"], scene["rows"]
    wide, high = (CELL - 10) / columns, (CELL - 10) / rows
    paths: dict[int, list[str]] = {}
    for first, levels in enumerate(levels_of(values, *bounds).tolist()):
        left, top = corner(scene, first)
        for second, level in enumerate(levels):
            row, column = divmod(second, columns)
            x, y = left + 5 + column * wide, top + 5 + row * high
            paths.setdefault(level, []).append(f"M{x:g} {y:g}h{wide:g}v{high:g}h-{wide:g}z")
    squares = [f'<path fill="{_colour(level)}" d="{"".join(paths[level])}"/>' for level in sorted(paths)]
    return _map(scene, "".join(squares), title)


def _map(scene: SceneDescription, body: str, title: str, letters: str = "") -> str:
    drawing = SvgDrawing(scene)
    walls = drawing.walls()
    paper = f'<rect class="m-paper" width="{drawing.width}" height="{drawing.height}" rx="12"/>'
    both = walls.replace("g-wall", "m-wall-edge") + walls.replace("g-wall", "m-wall")
    return picture(drawing.width, drawing.height, title, paper + body + both + letters)


def _colour(level: int) -> str:
    return NO_VALUE if level < 0 else ramp_colour(level)


def _text(x: int, y: int, text: str, ink: str) -> str:
    return f'<text class="m-text" x="{x}" y="{y}" fill="{ink}">{escape(text)}</text>'


def _action(action: SceneAction, x: int, y: int, ink: str) -> str:
    """Return an arrow for a move, the name of any other action."""
    move = action.get("move")
    if move is None:
        return _text(x, y + 52, action["name"].replace("_", "-"), ink)
    angle = _ANGLES.get((move[0], move[1]), 0)
    return (
        f'<path class="m-arrow" stroke="{ink}" d="M0 20V-18M-12 -6L0 -18L12 -6" '
        f'transform="translate({x} {y + 45}) rotate({angle})"/>'
    )


def short(value: float) -> str:
    """Return a value in at most about five characters."""
    if value == 0:
        return "0"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.1f}" if abs(value) >= 1 else f"{value:.2g}"


class Move(NamedTuple):
    """The weight with which a thing went from one cell to another, or stayed."""

    thing: int
    start: int
    stop: int
    weight: float


def moves_map(
    scene: SceneDescription, moves: Sequence[Move], place: NDArray[np.int16] | None, title: str
) -> str:
    """Return the grid with an arrow for each move; for one that stayed in its cell, a ring.

    The width of an arrow is proportional to the move's weight; `place` is where the things are drawn,
    [things, 3].
    """
    drawing = SvgDrawing(scene)
    heaviest = max((move.weight for move in moves), default=0.0)
    widths = [(move, WIDEST * move.weight / heaviest) for move in moves if heaviest > 0]
    shapes = [
        _shape(scene, drawing, move, width)
        for move, width in sorted(widths, key=lambda drawn: -drawn[1])
        if width >= _FAINTEST
    ]
    things = "" if place is None else drawing.things(place)
    content = f'{drawing.still()}<g fill-opacity=".85">{"".join(shapes)}</g>{drawing.letters()}{things}'
    return picture(drawing.width, drawing.height, title, content)


def _shape(scene: SceneDescription, drawing: SvgDrawing, move: Move, width: float) -> str:
    """Return an arrow to the right of the line between two cells, so that its opposite is next to it."""
    colour = drawing.colour(move.thing)
    side = 8 + 26 * drawing.movers.index(move.thing) / max(1, len(drawing.movers) - 1)
    x, y = (value + CELL / 2 for value in corner(scene, move.start))
    if move.start == move.stop:
        return (
            f'<circle cx="{x:g}" cy="{y:g}" r="{28 + side / 2:.1f}" fill="none" stroke="{colour}" '
            f'stroke-opacity=".85" stroke-width="{width:.1f}"/>'
        )
    end_x, end_y = (value + CELL / 2 for value in corner(scene, move.stop))
    length = math.hypot(end_x - x, end_y - y)
    half = width / 2
    head = min(width / 2 + 10, length / 3)
    outline = (
        f"M18 {-half:.1f}H{length - 18 - head:.1f}v{-_HEAD}L{length - 18:.1f} 0"
        f"L{length - 18 - head:.1f} {half + _HEAD:.1f}V{half:.1f}H18Z"
    )
    angle = math.degrees(math.atan2(end_y - y, end_x - x))
    return (
        f'<path d="{outline}" fill="{colour}" '
        f'transform="translate({x:g} {y:g}) rotate({angle:.1f}) translate(0 {side:.1f})"/>'
    )
