"""Values and greedy actions of a Q-table on the grid of a scene, as SVG.

One mover: a cell is coloured by the highest value there, and an arrow shows the greedy action. Two movers:
each cell of the grid (where the first is) holds the whole grid once more (where the second is).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.drawing.svg import CELL, MARGIN, Drawing, ink_on

# Cividis (Nunez, Anderton and Renslow 2018): even steps of lightness, also with colour blindness.
RAMP: Final = (
    "#00224e", "#123570", "#3b496c", "#575d6d", "#707173",
    "#8a8678", "#a59c74", "#c3b369", "#e1cc55", "#fee838",
)  # fmt: skip
"""From the lowest value to the highest."""
LEVELS: Final = 32
"""Colours that are told apart; values between two of them get the nearer one."""

STYLE: Final = (
    ".m-paper{fill:#22262b}.m-none{fill:#d0d0d0}.m-wall{stroke:#ffffff;stroke-width:7;stroke-linecap:round}"
    ".m-wall-edge{stroke:#22262b;stroke-width:12;stroke-linecap:round}"
    ".m-text{font-family:'DejaVu Sans',sans-serif;font-size:19px;text-anchor:middle}"
    ".m-letter{font-family:'DejaVu Sans',sans-serif;font-size:18px;font-weight:bold}"
    ".m-arrow{fill:none;stroke-width:6;stroke-linecap:round;stroke-linejoin:round}"
)


def colour_of(level: int) -> str:
    """Return the colour of a level from 0 to LEVELS - 1, as "#rrggbb"."""
    at = level / (LEVELS - 1) * (len(RAMP) - 1)
    low = min(int(at), len(RAMP) - 2)
    pair = [[int(colour[i : i + 2], 16) for i in (1, 3, 5)] for colour in RAMP[low : low + 2]]
    return "#" + "".join(f"{round(a + (b - a) * (at - low)):02x}" for a, b in zip(*pair, strict=True))


def levels_of(values: NDArray[np.float64], low: float, high: float) -> NDArray[np.int64]:
    """Return the level of each value between `low` and `high`; -1 where it is nan."""
    span = high - low
    share = (values - low) / span if span > 0 else np.zeros_like(values)
    return np.where(np.isnan(values), -1, np.rint(np.nan_to_num(share).clip(0, 1) * (LEVELS - 1))).astype(int)


def policy_map(
    scene: Mapping[str, Any],
    values: NDArray[np.float64],
    greedy: Sequence[int | None],
    bounds: tuple[float, float],
    title: str,
) -> str:
    """Return the map of one mover.

    Args:
        scene: its grid and its actions.
        values: [cells], the highest value there; nan where no action is better than another.
        greedy: the mover's greedy action in each cell; None where there is none.
        bounds: the values of the darkest and of the lightest colour.
        title: what readers of the page hear.
    """
    parts = []
    for cell, (level, action) in enumerate(zip(levels_of(values, *bounds).tolist(), greedy, strict=True)):
        row, column = divmod(cell, scene["columns"])
        x, y = MARGIN + column * CELL, MARGIN + row * CELL
        colour = "#d0d0d0" if level < 0 else colour_of(level)
        parts.append(
            f'<rect x="{x + 1}" y="{y + 1}" width="{CELL - 2}" height="{CELL - 2}" fill="{colour}"/>'
        )
        if level >= 0:
            parts.append(_cell_signs(scene, x, y, float(values[cell]), action, ink_on(colour)))
    return _picture(scene, "".join(parts), title, ink=levels_of(values, *bounds))


def pair_map(
    scene: Mapping[str, Any], values: NDArray[np.float64], bounds: tuple[float, float], title: str
) -> str:
    """Return the map of two movers, `values` [cells of the first, cells of the second]; see the module."""
    columns, rows = scene["columns"], scene["rows"]
    room = CELL - 10
    wide, high = room / columns, room / rows
    paths: dict[int, list[str]] = {}
    for first, row_levels in enumerate(levels_of(values, *bounds).tolist()):
        row, column = divmod(first, columns)
        for second, level in enumerate(row_levels):
            inner_row, inner_column = divmod(second, columns)
            x = MARGIN + column * CELL + 5 + inner_column * wide
            y = MARGIN + row * CELL + 5 + inner_row * high
            paths.setdefault(level, []).append(f"M{x:g} {y:g}h{wide:g}v{high:g}h-{wide:g}z")
    parts = [
        f'<path fill="{"#d0d0d0" if level < 0 else colour_of(level)}" d="{"".join(squares)}"/>'
        for level, squares in sorted(paths.items())
    ]
    return _picture(scene, "".join(parts), title)


def _picture(scene: Mapping[str, Any], body: str, title: str, ink: NDArray[np.int64] | None = None) -> str:
    drawing = Drawing(scene)
    walls = drawing.walls()
    letters = "" if ink is None else "".join(_letter(scene, mark, ink) for mark in scene["landmarks"])
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {drawing.width} {drawing.height}" role="img" '
        f'aria-label="{escape(title)}"><rect class="m-paper" width="{drawing.width}" '
        f'height="{drawing.height}" rx="12"/>{body}'
        f"{walls.replace('g-wall', 'm-wall-edge')}{walls.replace('g-wall', 'm-wall')}{letters}</svg>"
    )


def _letter(scene: Mapping[str, Any], mark: Mapping[str, Any], levels: NDArray[np.int64]) -> str:
    row, column = mark["cell"]
    level = int(levels[row * scene["columns"] + column])
    ink = ink_on(colour_of(max(level, 0))) if level >= 0 else "#000000"
    x, y = MARGIN + column * CELL + 8, MARGIN + row * CELL + 23
    return f'<text class="m-letter" x="{x}" y="{y}" fill="{ink}">{escape(mark["name"][:2])}</text>'


def _cell_signs(scene: Mapping[str, Any], x: int, y: int, value: float, action: int | None, ink: str) -> str:
    """Return a cell's value and the arrow, or the word, of its greedy action."""
    middle = x + CELL // 2
    number = f'<text class="m-text" x="{middle}" y="{y + CELL - 9}" fill="{ink}">{short(value)}</text>'
    if action is None:
        return number
    move = scene["actions"][action]["move"]
    if move is None:
        word = scene["actions"][action]["name"].replace("_", "-")
        return number + f'<text class="m-text" x="{middle}" y="{y + 52}" fill="{ink}">{escape(word)}</text>'
    angle = {(-1, 0): 0, (0, 1): 90, (1, 0): 180, (0, -1): 270}.get(tuple(move), 0)
    return number + (
        f'<path class="m-arrow" stroke="{ink}" d="M0 20V-18M-12 -6L0 -18L12 -6" '
        f'transform="translate({middle} {y + 45}) rotate({angle})"/>'
    )


def short(value: float) -> str:
    """Return a value in at most about five signs."""
    if value == 0:
        return "0"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.1f}" if abs(value) >= 1 else f"{value:.2g}"
