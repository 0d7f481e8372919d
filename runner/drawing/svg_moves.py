"""Moves on the grid of a scene as arrows whose width is their weight, as SVG."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from runner.drawing.svg import CELL, SvgDrawing, corner, picture
from runner.environments.mdp import SceneDescription

WIDEST: Final = 20.0
"""Width of the heaviest arrow, in hundredths of a cell."""
_FAINTEST: Final = 0.5
"""Narrower arrows are not drawn."""
_HEAD: Final = 7.0
"""How far the head of an arrow is wider than its shaft, on each side."""


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
        for move, width in sorted(widths, key=lambda each: -each[1])
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
