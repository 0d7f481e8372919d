"""A small canvas: smooth shapes and lettering on a NumPy array, from signed distances.

A shape is given by how far each pixel's centre lies outside its edge, in pixels; the half pixel around
the edge is blended, which is what makes the edges smooth. Coordinates are (x to the right, y down).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.floating[Any]]  # one value a pixel: a coordinate, a distance, or a coverage of 0 to 1
Point = tuple[float, float]

GLYPH_WIDTH, GLYPH_HEIGHT = 4, 6

# Each letter is strokes parted by spaces; each stroke is a run of xy digits on a 4 by 6 grid.
_STROKES = {
    "A": "062046 1434",
    "B": "06003041423303 3344453606",
    "C": "4130100105163645",
    "D": "06002042442606",
    "E": "40000646 0333",
    "F": "400006 0333",
    "G": "41301001051636454323",
    "H": "0006 4046 0343",
    "I": "1030 2026 1636",
    "J": "4045361605",
    "K": "0006 4003 0346",
    "L": "000646",
    "M": "0600234046",
    "N": "06004640",
    "O": "103041453616050110",
    "P": "06003041423303",
    "Q": "103041453616050110 2446",
    "R": "06003041423303 2346",
    "S": "413010010213334445361605",
    "T": "0040 2026",
    "U": "000516364540",
    "V": "002640",
    "W": "0016233640",
    "X": "0046 4006",
    "Y": "002340 2326",
    "Z": "00400646",
    "1": "112026 1636",
    "2": "01103041420646",
    "-": "1333",
}


class Canvas:
    """An RGB picture to draw on.

    Attributes:
        pixels: float32 [height, width, 3], 0 to 255.
    """

    def __init__(self, pixels: NDArray[np.float32]) -> None:
        self.pixels = pixels

    @classmethod
    def blank(cls, width: int, height: int, colour: str) -> Canvas:
        """Return a canvas of one colour."""
        return cls(np.full((height, width, 3), _rgb(colour), dtype=np.float32))

    def disc(self, centre: Point, radius: float, colour: str) -> None:
        """Draw a filled circle."""
        self.box(
            (centre[0] - radius, centre[1] - radius), (centre[0] + radius, centre[1] + radius), colour, radius
        )

    def box(self, corner: Point, opposite: Point, colour: str, radius: float = 0.0) -> None:
        """Draw a filled rectangle with rounded corners of `radius`."""
        (left, top), (right, bottom) = corner, opposite
        x, y = self._window(left, top, right, bottom)
        across = np.abs(x - (left + right) / 2) - (right - left) / 2 + radius
        down = np.abs(y - (top + bottom) / 2) - (bottom - top) / 2 + radius
        outside = np.hypot(np.maximum(across, 0), np.maximum(down, 0)) + np.minimum(
            np.maximum(across, down), 0
        )
        self._blend(x, y, _edge(outside - radius), colour)

    def polygon(self, points: Sequence[Point], colour: str) -> None:
        """Draw a filled convex polygon, its corners given clockwise as seen."""
        corners = np.asarray(points)
        x, y = self._window(*corners.min(axis=0), *corners.max(axis=0))
        outside = np.full(np.broadcast_shapes(x.shape, y.shape), -np.inf)
        for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            beyond = ((y1 - y0) * (x - x0) - (x1 - x0) * (y - y0)) / np.hypot(x1 - x0, y1 - y0)
            outside = np.maximum(outside, beyond)
        self._blend(x, y, _edge(outside), colour)

    def line(self, points: Sequence[Point], width: float, colour: str) -> None:
        """Draw a line through `points` with round ends and joints."""
        corners = np.asarray(points)
        reach = width / 2
        x, y = self._window(*(corners.min(axis=0) - reach), *(corners.max(axis=0) + reach))
        self._blend(x, y, _edge(_distance(x, y, corners) - reach), colour)

    def text(self, place: Point, letters: str, height: float, colour: str) -> None:
        """Write `letters` (A to Z, 1, 2, - and space) with the upper left corner at `place`."""
        unit = height / GLYPH_HEIGHT
        left, top = place
        for letter in letters:
            for stroke in _STROKES.get(letter, "").split():
                digits = [int(digit) for digit in stroke]
                points = [
                    (left + x * unit, top + y * unit) for x, y in zip(digits[::2], digits[1::2], strict=True)
                ]
                self.line(points, height / 7, colour)
            left += unit * (GLYPH_WIDTH + 2)

    def _window(
        self, left: float, top: float, right: float, bottom: float
    ) -> tuple[NDArray[np.float32], ...]:
        """Return the x [1, w] and y [h, 1] of the pixel centres around a rectangle, inside the canvas."""
        height, width, _ = self.pixels.shape
        x: Pixels = np.arange(max(int(left) - 1, 0), min(int(right) + 2, width), dtype=np.float32) + 0.5
        y: Pixels = np.arange(max(int(top) - 1, 0), min(int(bottom) + 2, height), dtype=np.float32) + 0.5
        return x[np.newaxis, :], y[:, np.newaxis]

    def _blend(self, x: Pixels, y: Pixels, coverage: Pixels, colour: str) -> None:
        rows = slice(int(y[0, 0]), int(y[-1, 0]) + 1)
        columns = slice(int(x[0, 0]), int(x[0, -1]) + 1)
        part = self.pixels[rows, columns]
        part += coverage[..., np.newaxis] * (np.asarray(_rgb(colour), dtype=np.float32) - part)


def text_width(words: str, height: float) -> float:
    """Return the width of `words` in pixels when written `height` pixels high."""
    return (len(words) * (GLYPH_WIDTH + 2) - 2) * height / GLYPH_HEIGHT


def mix(colour: str, other: str, share: float) -> str:
    """Return `colour` with a share (0 to 1) of `other` in it."""
    pairs = zip(_rgb(colour), _rgb(other), strict=True)
    return "#" + "".join(f"{round(a + share * (b - a)):02x}" for a, b in pairs)


def ink_on(colour: str) -> str:
    """Return black or white, whichever reads better on `colour`."""
    red, green, blue = _rgb(colour)
    return "#000000" if 0.299 * red + 0.587 * green + 0.114 * blue > 140 else "#ffffff"


def _rgb(colour: str) -> tuple[int, int, int]:
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def _edge(outside: Pixels) -> Pixels:
    """Return how much of each pixel is covered, from its centre's distance outside the edge."""
    covered: Pixels = np.clip(0.5 - outside, 0.0, 1.0)
    return covered


def _distance(x: Pixels, y: Pixels, corners: NDArray[np.float64]) -> Pixels:
    """Return the distance of each pixel's centre from the line through `corners`."""
    nearest: Pixels = np.full(np.broadcast_shapes(x.shape, y.shape), np.inf, dtype=np.float32)
    for (x0, y0), (x1, y1) in pairwise(corners.tolist()):
        along_x, along_y = x1 - x0, y1 - y0
        share = np.clip(((x - x0) * along_x + (y - y0) * along_y) / (along_x**2 + along_y**2), 0, 1)
        nearest = np.minimum(nearest, np.hypot(x - x0 - share * along_x, y - y0 - share * along_y))
    return nearest
