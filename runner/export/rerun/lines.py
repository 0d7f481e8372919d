"""How time series are drawn: a colour of its own for every line of a view, and no invented values."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence

import numpy as np
import rerun as rr

from runner.drawing import palette


def line_colours(count: int, tint: str | None = None) -> list[tuple[int, int, int]]:
    """Return colours for the lines of a view, no two alike.

    Args:
        count: number of lines.
        tint: the colour whose shades they are, where runs are compared; None for different hues.
    """
    if tint is not None:
        if count == 1:
            return [palette.rgb(tint)]
        hue, _, saturation = colorsys.rgb_to_hls(*(part / 255 for part in palette.rgb(tint)))
        return [_from_hls(hue, level, saturation) for level in np.linspace(0.3, 0.8, count)]
    if count <= len(palette.SERIES):
        return [palette.rgb(colour) for colour in palette.SERIES[:count]]
    return [_from_hls(k / count, (0.4, 0.6)[k % 2], 0.75) for k in range(count)]


def _from_hls(hue: float, level: float, saturation: float) -> tuple[int, int, int]:
    red, green, blue = (round(255 * part) for part in colorsys.hls_to_rgb(hue, level, saturation))
    return red, green, blue


def phase_colours(phase: str, count: int, tint: str | None = None) -> list[tuple[int, int, int]]:
    """Return the colours of the `count` lines that a phase has in a view of training and evaluation."""
    colours = line_colours(2 * count, tint)
    return colours[count:] if phase == "train" else colours[:count]


def series_lines(
    names: Sequence[str], colours: Sequence[tuple[int, int, int]] | None = None, width: float = 1.2
) -> rr.SeriesLines:
    """Return how the lines of an entity are drawn.

    Where several values fall to a pixel, their lowest and highest are drawn: Rerun's default, the average,
    is a number that never occurred.
    """
    return rr.SeriesLines(
        names=names,
        colors=line_colours(len(names)) if colours is None else colours,
        widths=[width] * len(names),
        aggregation_policy=rr.components.AggregationPolicy.MinMax,
    )
