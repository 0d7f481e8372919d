"""The trials of a sweep as small charts for pages: along each parameter, and in parallel coordinates."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runner.drawing import palette
from runner.export.plots.svg import SMALL, Chart, Scale, colour_of_line, labelled
from runner.sweep.plots import Axis, Picture

Values = NDArray[np.float64]

_BEST = colour_of_line(1)
_TRIAL = colour_of_line(0)


def parameter_svgs(picture: Picture) -> list[str]:
    """Return a plot of the objective against each parameter, the best trial in another colour.

    Trials that were given up are hollow.
    """
    return [_parameter_svg(picture, axis) for axis in picture.axes]


def _parameter_svg(picture: Picture, axis: Axis) -> str:
    values, x = np.array(picture.values), np.array(axis.values)
    ranges = np.array(picture.ranges)
    labels = [textwrap.shorten(choice, 24) for choice in axis.choices]
    slanted = sum(map(len, labels)) > 28
    bottom, height = (144.0, 210.0) if slanted else (146.0, 187.0)
    across = (
        Scale(-0.5, len(labels) - 0.5, 62.0, 280.0) if labels else _around(x, 62.0, 280.0, 0.05, axis.log)
    )
    up = _around(ranges, bottom, 24.0, 0.06, picture.log)
    chart = Chart(across, up, 288.0, height, f"{picture.objective} against {axis.path}")
    chart.x_ticks(list(enumerate(labels)) if labels else labelled(across.ticks), slanted)
    chart.y_ticks(labelled(up.ticks, float(np.abs(ranges).max()) >= 10_000))
    better = "lower" if picture.lower_is_better else "higher"
    chart.frame(axis.path, 14.0, "", [*textwrap.wrap(picture.objective, 30)[:2], f"({better} is better)"])
    bars = "".join(
        f"M{place:.1f},{low:.1f}V{high:.1f}"
        for place, (low, high) in zip(chart.x(x), chart.y(ranges), strict=True)
    )
    chart.path(bars, stroke=_TRIAL, stroke_width=0.8, opacity=0.25)
    is_finished = np.array([trial.state == "finished" for trial in picture.trials[1:]], dtype=np.bool_)
    for chosen, fill in ((is_finished, _TRIAL), (~is_finished, "none")):
        style: dict[str, Any] = {"fill": fill, "stroke": "none" if fill == _TRIAL else _TRIAL, "opacity": 0.6}
        chart.markers(x[1:][chosen], values[1:][chosen], _TRIAL, 0, 1.9, **style)
    chart.markers(x[:1], values[:1], _BEST, 3, 4.0)
    return chart.element()


def parallel_svg(picture: Picture) -> str:
    """Return parallel coordinates: each trial a line over all parameters to its objective."""
    columns = [_unit(np.array(axis.values), axis.log, axis.choices) for axis in picture.axes]
    columns.append(_unit(np.array(picture.values), picture.log, ()))
    lines, places = np.array(columns).T, np.arange(len(columns), dtype=np.float64)
    x = Scale(-0.1, len(columns) - 0.75, 10.0, 580.0)
    chart = Chart(x, Scale(-0.05, 1.05, 186.0, 24.0), 590.0, 216.0, "The trials in parallel coordinates")
    colours = palette.ramp_colours(len(lines))
    for number in range(len(lines) - 1, -1, -1):
        chart.line(places, lines[number], colours[number], stroke_width=0.9, opacity=0.7)
    chart.line(places, lines[0], _BEST, stroke_width=2.2)
    title = "Each trial a line, the best one thick; dark lines are better than light ones"
    chart.text(10.0, 14.0, title, font_size=9.5, font_weight="bold")
    names = [*(axis.path for axis in picture.axes), picture.objective]
    for place, name in zip(chart.x(places), names, strict=True):
        chart.path(f"M{place:.1f},24V186", stroke="currentColor", stroke_width=0.7)
        for row, part in enumerate(textwrap.wrap(name.replace(".", ". "), 24)[:2]):
            text = part.replace(". ", ".")
            chart.text(max(place, 10.0), 198.0 + 10 * row, text, "start" if place < 60 else "middle")
    for place, axis in zip(places, picture.axes, strict=False):
        _label_column(chart, float(place), axis.values, axis.log, axis.choices)
    _label_column(chart, float(places[-1]), picture.values, picture.log, ())
    return chart.element()


def _label_column(
    chart: Chart, column: float, values: Sequence[float], log: bool, choices: tuple[str, ...]
) -> None:
    """Write the choices, or the lowest and the highest value, next to an axis of parallel coordinates."""
    if choices:
        heights = _unit(np.arange(len(choices), dtype=np.float64), False, choices)
        labels = list(zip(heights, (textwrap.shorten(choice, 18) for choice in choices), strict=True))
    else:
        ends = np.array([min(values), max(values)])
        labels = list(zip(_unit(ends, log, ()), (f"{end:,.4g}" for end in ends), strict=True))
    for height, text in dict(labels).items():
        halo: dict[str, Any] = {"paint_order": "stroke", "stroke": "var(--paper, #ffffff)", "stroke_width": 3}
        chart.text(chart.x.at(column) + 5, chart.y.at(float(height)) + 2.8, text, font_size=SMALL, **halo)


def _around(values: Values, start: float, end: float, margin: float, log: bool) -> Scale:
    """Return a scale on which values have a margin on both sides."""
    low, high = float(values.min()), float(values.max())
    if log:
        room = (high / low) ** margin if high > low else 2.0
        return Scale(low / room, high * room, start, end, log=True)
    room = margin * (high - low) or abs(high) * 0.05 or 0.05
    return Scale(low - room, high + room, start, end)


def _unit(values: Values, log: bool, choices: tuple[str, ...]) -> Values:
    """Return where values are between the lowest, 0, and the highest, 1."""
    if choices:
        return values / max(len(choices) - 1, 1)
    scaled = np.log(values) if log else values
    width = scaled.max() - scaled.min()
    return np.asarray((scaled - scaled.min()) / width) if width else np.full(len(values), 0.5)
