"""Numbers as pixels: one bar for each, with its name and value, for states that nothing else can draw."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from runner.drawing import palette
from runner.drawing.raster import Pixels, font, shortened
from runner.util.arrays import Floats
from runner.util.humanize import UNKNOWN

MAX_BARS: Final = 24
"""The most values that a picture shows."""
WIDTH: Final = 480
"""Width of a picture in pixels."""
_LINE: Final = 20
_TEXT: Final = 13
_MARGIN: Final = 10
_BARS: Final = 160, 390
"""The columns of pixels between which bars are drawn; names are on their left, values on their right."""


class BarRaster:
    """Draws values as horizontal bars from zero, between the lowest and the highest that each value gets.

    Those after the first `MAX_BARS` are counted in a line, and not drawn.
    """

    def __init__(self, names: Sequence[str], low: Floats, high: Floats) -> None:
        from PIL import Image, ImageDraw

        self._shown = min(len(names), MAX_BARS)
        low, high = np.minimum(low[: self._shown], 0), np.maximum(high[: self._shown], 0)
        left, right = _BARS
        self._scale = (right - left) / np.where(high > low, high - low, 1)
        """Pixels of a unit."""
        self._zero = left - low * self._scale
        rows = self._shown + (len(names) > MAX_BARS)
        self._ground = Image.new("RGB", (WIDTH, rows * _LINE + 2 * _MARGIN), palette.WHITE)
        pen = ImageDraw.Draw(self._ground)
        for k, name in enumerate(names[: self._shown]):
            text = shortened(name, left - 2 * _MARGIN, _TEXT)
            pen.text((_MARGIN, _middle(k)), text, palette.INK, font(_TEXT), anchor="lm")
            zero = round(float(self._zero[k]))
            pen.line((zero, _middle(k) - _LINE // 2, zero, _middle(k) + _LINE // 2), palette.GREY)
        if rows > self._shown:
            text = f"and {len(names) - self._shown:,} more values"
            pen.text((_MARGIN, _middle(self._shown)), text, palette.GREY, font(_TEXT), anchor="lm")

    def draw(self, values: Floats) -> Pixels:
        """Return the picture of values, float64 [values]; one that is not finite has no bar."""
        from PIL import ImageDraw

        picture = self._ground.copy()
        pen = ImageDraw.Draw(picture)
        for k, value in enumerate(values[: self._shown].tolist()):
            if np.isfinite(value):
                ends = sorted((float(self._zero[k]), float(self._zero[k] + value * self._scale[k])))
                colour = palette.BLUE if value > 0 else palette.ORANGE
                pen.rectangle((ends[0], _middle(k) - 6, ends[1], _middle(k) + 6), colour)
            text = UNKNOWN if np.isnan(value) else f"{value:.4g}"
            pen.text((_BARS[1] + _MARGIN, _middle(k)), text, palette.INK, font(_TEXT), anchor="lm")
        return np.asarray(picture)


def _middle(row: int) -> int:
    return _MARGIN + row * _LINE + _LINE // 2
