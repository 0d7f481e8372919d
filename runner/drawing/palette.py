"""Every colour of pages, pictures, plots and exports, and the CSS variables that carry them.

The hues are those of Okabe and Ito (2008), which stay distinct with any common colour blindness; no drawing
relies on colour alone.
"""

from __future__ import annotations

import operator
from typing import Final

ORANGE: Final = "#E69F00"
SKY_BLUE: Final = "#56B4E9"
GREEN: Final = "#009E73"
PINK: Final = "#CC79A7"
YELLOW: Final = "#F0E442"
VERMILION: Final = "#D55E00"
BLUE: Final = "#0072B2"
GREY: Final = "#777777"
WHITE: Final = "#ffffff"

INK: Final = "#1b1f24"
"""Text and axes on white."""
MIDTONE: Final = "#808080"
"""Text and lines that must be readable on black and on white."""

AGENTS: Final = {
    ORANGE: "orange",
    SKY_BLUE: "blue",
    GREEN: "green",
    PINK: "pink",
    YELLOW: "yellow",
    VERMILION: "red",
}
"""Colours of the movers in their order, with the names that a legend gives them."""
PASSENGER: Final = PINK
GOAL: Final = PINK
GOOD: Final = GREEN
BAD: Final = VERMILION

SERIES: Final = (BLUE, VERMILION, GREEN, PINK, ORANGE, SKY_BLUE, GREY)
"""Colours of the lines of plots in the light."""
_SERIES_DARK: Final = ("#5aaee6", "#ff8f4d", "#2fc79c", "#e6a3c7", "#f0b429", "#86cdf5", "#a8a8a8")
COMPARED: Final = (BLUE, ORANGE)
"""Base colours of two runs that are compared."""

GRID: Final = {
    "line": "#22262b",
    "cell": WHITE,
    "cell-edge": "#d9d6cf",
    "glass": "#eaf3f8",
    "ring": "#B0357F",
    "number": "#111111",
}
"""Colours of the drawing of a grid."""
GRID_DARK: Final = {"line": "#4a525c", "cell": "#e9ebee", "cell-edge": "#c2c7cd"}
"""What a dark page draws otherwise: the paper of a grid, its cells and their edges."""

# Cividis (Nunez, Anderton and Renslow 2018): even steps of lightness, also with colour blindness.
RAMP: Final = (
    "#00224e", "#123570", "#3b496c", "#575d6d", "#707173",
    "#8a8678", "#a59c74", "#c3b369", "#e1cc55", "#fee838",
)  # fmt: skip
"""Colours from the lowest value to the highest."""
LEVELS: Final = 32
"""Number of distinct colours of values; a value between two of them gets the nearer one."""
NO_VALUE: Final = "#d0d0d0"

_LIGHT: Final = {
    "ink": INK,
    "soft": "#57606a",
    "paper": WHITE,
    "panel": "#f4f5f7",
    "line": "#d5d9de",
    "accent": "#0b5cad",
    "warn": "#fff3cd",
    "warn-ink": "#5c4300",
    "bar": "#9bb8d6",
    "bar-taken": "#d55e00",
    "good": "#00664a",
    "bad": "#b3261e",
}
_DARK: Final = {
    "ink": "#e7eaee",
    "soft": "#a5afba",
    "paper": "#14171b",
    "panel": "#1f242a",
    "line": "#363d45",
    "accent": "#74b6ff",
    "warn": "#4a3a00",
    "warn-ink": "#ffe9a8",
    "bar": "#4f7399",
    "bar-taken": "#ff8f4d",
    "good": "#5fd3ac",
    "bad": "#ff8a80",
}


def css_variables() -> str:
    """Return the colours of a page as CSS variables, for light and dark."""
    light = _declared(_LIGHT, SERIES) + f"--ramp:linear-gradient(90deg,{','.join(RAMP)})"
    dark = _declared(_DARK, _SERIES_DARK)
    swatches = "".join(f".line-{i}{{background:var(--line-{i})}}" for i in range(len(SERIES)))
    return f":root{{{light}}}@media (prefers-color-scheme:dark){{:root{{{dark}}}}}{swatches}"


def _declared(colours: dict[str, str], series: tuple[str, ...]) -> str:
    numbered = {f"line-{i}": colour for i, colour in enumerate(series)}
    return "".join(f"--{name}:{colour};" for name, colour in (colours | numbered).items())


def agent(number: int) -> str:
    """Return the colour of an agent, counted from 0."""
    return tuple(AGENTS)[number % len(AGENTS)]


def rgb(colour: str) -> tuple[int, int, int]:
    """Return red, green and blue of a colour such as `#E69F00`, from 0 to 255."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def ink_on(colour: str) -> str:
    """Return black or white, whichever has more contrast with `colour`, as WCAG defines it."""
    shares = (part / 255 for part in rgb(colour))
    linear = (share / 12.92 if share <= 0.04045 else ((share + 0.055) / 1.055) ** 2.4 for share in shares)
    luminance = sum(map(operator.mul, linear, (0.2126, 0.7152, 0.0722)))
    return "#000000" if (luminance + 0.05) ** 2 > 0.05 * 1.05 else WHITE


def ramp_colour(level: int) -> str:
    """Return the colour of a level from 0 to LEVELS - 1, as "#rrggbb"."""
    at = level / (LEVELS - 1) * (len(RAMP) - 1)
    low = min(int(at), len(RAMP) - 2)
    pair = (rgb(RAMP[low]), rgb(RAMP[low + 1]))
    return "#" + "".join(f"{round(a + (b - a) * (at - low)):02x}" for a, b in zip(*pair, strict=True))


def ramp_colours(count: int) -> list[str]:
    """Return colours over the whole ramp, from the lowest value to the highest."""
    return [ramp_colour(round(i / max(count - 1, 1) * (LEVELS - 1))) for i in range(count)]
