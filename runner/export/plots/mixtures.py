"""Charts of an explanation: bars of estimates with intervals, and the values of mixtures of settings."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Final, NamedTuple

import numpy as np

from runner.analysis.statistics import Estimate
from runner.drawing import palette
from runner.export.plots.chart import Chart, Markers, Scale, series_colour

_NAMES: Final = 205.0
"""Where charts begin, right of the names of settings."""
_WIDTH: Final = 590.0
_ROW: Final = 20.0
_MAX_NAME: Final = 38


class BarColumn(NamedTuple):
    """A mixture: the settings that are changed in it, and its values, one a seed."""

    changed: Collection[str]
    values: Sequence[float]
    is_marked: bool
    """Whether it has the second colour."""


def bars_chart(title: str, rows: list[tuple[str, Estimate]]) -> Chart:
    """Return a bar from 0 for each named estimate, with its interval; pale if that includes 0."""
    ends = [end for _, each in rows for end in (each.value, each.low, each.high) if math.isfinite(end)]
    bottom = 24.0 + _ROW * len(rows)
    x = Scale.around(np.array([0.0, *ends]), _NAMES, _WIDTH - 10)
    chart = Chart(x, Scale(len(rows) - 0.5, -0.5, bottom, 24.0), _WIDTH, bottom + 18, title)
    chart.text(5, 14, title, size=9.5, bold=True)
    chart.x_ticks()
    for row, (name, each) in enumerate(rows):
        middle = chart.y.at(row)
        zero = x.at(0)
        end = x.at(each.value)
        corners = [(zero, middle - 6), (end, middle - 6), (end, middle + 6), (zero, middle + 6)]
        chart.shape(corners, fill=series_colour(0), opacity=0.75 if each.excludes_zero else 0.3)
        if math.isfinite(each.low):
            chart.shape([(x.at(each.low), middle), (x.at(each.high), middle)], stroke=palette.INK, width=1.2)
            for place in (x.at(each.low), x.at(each.high)):
                chart.shape([(place, middle - 3), (place, middle + 3)], stroke=palette.INK, width=1.2)
        chart.text(_NAMES - 8, middle + 3, _short(name), "end")
    chart.shape([(x.at(0), 24), (x.at(0), bottom)], stroke=palette.INK)
    return chart


def mixtures_chart(title: str, names: Sequence[str], columns: Sequence[BarColumn]) -> Chart:
    """Return each mixture as a column: its values and their mean, and below a dot for what is changed."""
    values = np.array([value for column in columns for value in column.values])
    bottom = 170.0
    last = 184.0 + 16 * len(names)
    x = Scale(-0.6, len(columns) - 0.4, _NAMES, _WIDTH - 10)
    chart = Chart(x, Scale.around(values, bottom, 24.0), _WIDTH, last + 4, title)
    chart.y_ticks()
    chart.text(5, 14, title, size=9.5, bold=True)
    chart.shape([(x.start, 24), (x.start, bottom), (x.end, bottom)], stroke=palette.INK)
    for column, one in enumerate(columns):
        own = np.array(one.values)
        colour = series_colour(1 if one.is_marked else 0)
        spread = np.linspace(-0.18, 0.18, len(own)) if len(own) > 1 else np.zeros(1)
        chart.markers(column + spread, own, colour, 0, 1.3, opacity=0.5)
        chart.line(np.array([column - 0.32, column + 0.32]), np.full(2, own.mean()), colour, width=2.2)
        for row, name in enumerate(names):
            place = np.array([[x.at(column), bottom + 16 + 16 * row]])
            chart.marks.append(Markers(place, 0, 3.5, colour if name in one.changed else "", colour, 1.0))
    for row, name in enumerate(names):
        chart.text(_NAMES - 8, bottom + 19 + 16 * row, _short(name), "end")
    return chart


def _short(name: str) -> str:
    """Return a name that fits left of a chart; of a pair of settings the longer one is shortened."""
    parts = name.split(" x ")
    if (excess := len(name) - _MAX_NAME) > 0:
        at = max(range(len(parts)), key=lambda i: len(parts[i]))
        parts[at] = f"{parts[at][: max(len(parts[at]) - excess - 1, 3)]}…"
    return " x ".join(parts)
