"""The trials of a sweep as charts: along each parameter, in parallel coordinates, and all on one sheet."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from runner.analysis.groups import Group
from runner.drawing import palette
from runner.export.plots.chart import SMALL, Canvas, Chart, Scale, labelled, series_colour
from runner.export.plots.curves import HEIGHT, WIDTH, Plot, panel_chart
from runner.export.plots.metrics import Panel
from runner.sweep.plots import Axis, Picture

Values = NDArray[np.float64]

_TRIAL: Final = series_colour(0)
_BEST: Final = series_colour(1)
_LETTERS: Final = 175
"""Letters of a note that fit on a line of a sheet."""


def sweep_sheet(title: str, picture: Picture, groups: Sequence[Group], panel: Panel) -> Canvas:
    """Return one sheet: the objective along each parameter, parallel coordinates, and learning curves.

    Args:
        title: the heading.
        picture: the trials.
        groups: the runs whose curves are drawn.
        panel: their metric.
    """
    parameters = [parameter_chart(picture, axis) for axis in picture.axes]
    columns = 2 if len(parameters) in (2, 4) else min(3, len(parameters))
    row_height = max(chart.height for chart in parameters)
    parallel, curves = parallel_chart(picture), panel_chart(panel, len(groups))
    notes = [(line, palette.INK) for line in textwrap.wrap(picture.footnote, _LETTERS)]
    for number, group in enumerate(groups):
        lines = textwrap.wrap(group.label, _LETTERS, subsequent_indent="    ")
        notes += [(line, series_colour(number)) for line in lines]
    rows = math.ceil(len(parameters) / columns)
    below = 32.0 + row_height * rows + parallel.height
    width = max(WIDTH * columns, parallel.width + WIDTH if columns == 3 else parallel.width)
    beside = width >= parallel.width + WIDTH
    curves_at = (parallel.width, below - HEIGHT - 20) if beside else (0.0, below)
    end = below if beside else below + HEIGHT
    sheet = Canvas(width, end + 16 + 11 * len(notes), title)
    sheet.text(10, 20, title, size=13, bold=True)
    for number, chart in enumerate(parameters):
        row, column = divmod(number, columns)
        sheet.place(chart, WIDTH * column, 32 + row_height * row)
    sheet.place(parallel, 0, below - parallel.height)
    sheet.place(curves, *curves_at)
    for number, (line, colour) in enumerate(notes):
        sheet.text(10, end + 12 + 11 * number, line, size=SMALL, colour=colour)
    return sheet


def picture_plots(picture: Picture) -> list[Plot]:
    """Return the trials for a page: along each parameter, and in parallel coordinates."""
    along = [Plot(axis.path, parameter_chart(picture, axis).svg(), False) for axis in picture.axes]
    return [*along, Plot("All parameters", parallel_chart(picture).svg(), True)]


def parameter_chart(picture: Picture, axis: Axis) -> Chart:
    """Return the objective of the trials against a parameter, the best trial in another colour.

    Pruned trials are hollow.
    """
    values, x = np.array(picture.values), np.array(axis.values)
    ranges = np.array(picture.ranges)
    labels = [textwrap.shorten(choice, 24) for choice in axis.choices]
    slanted = sum(map(len, labels)) > 28
    bottom, height = (144.0, 210.0) if slanted else (146.0, 187.0)
    across = Scale.around(x, 62.0, 280.0, log=axis.log)
    if labels:
        across = Scale(-0.5, len(labels) - 0.5, 62.0, 280.0)
    up = Scale.around(ranges, bottom, 24.0, log=picture.log)
    chart = Chart(across, up, WIDTH, height, f"{picture.objective} against {axis.path}")
    chart.x_ticks(list(enumerate(labels)) if labels else labelled(across.ticks), slanted)
    chart.y_ticks(labelled(up.ticks, float(np.abs(ranges).max()) >= 10_000))
    better = "lower" if picture.lower_is_better else "higher"
    chart.frame(axis.path, 14.0, "", [*textwrap.wrap(picture.objective, 30)[:2], f"({better} is better)"])
    for place, ends in zip(chart.x(x).tolist(), chart.y(ranges).tolist(), strict=True):
        chart.shape([(place, end) for end in ends], stroke=_TRIAL, width=0.8, opacity=0.25)
    is_finished = np.array([trial.state == "finished" for trial in picture.trials[1:]], dtype=np.bool_)
    for chosen, hollow in ((is_finished, False), (~is_finished, True)):
        chart.markers(x[1:][chosen], values[1:][chosen], _TRIAL, 0, 1.7, opacity=0.6, hollow=hollow)
    chart.markers(x[:1], values[:1], _BEST, 3, 4.0)
    return chart


def parallel_chart(picture: Picture) -> Chart:
    """Return parallel coordinates: each trial a line over all parameters to its objective."""
    columns = [_unit(np.array(axis.values), axis.log, axis.choices) for axis in picture.axes]
    columns.append(_unit(np.array(picture.values), picture.log, ()))
    lines, places = np.array(columns).T, np.arange(len(columns), dtype=np.float64)
    x = Scale(-0.1, len(columns) - 0.75, 10.0, 580.0)
    chart = Chart(x, Scale(-0.05, 1.05, 186.0, 24.0), 590.0, 216.0, "The trials in parallel coordinates")
    colours = palette.ramp_colours(len(lines))
    for number in range(len(lines) - 1, -1, -1):
        chart.line(places, lines[number], colours[number], width=0.9, opacity=0.7)
    chart.line(places, lines[0], _BEST, width=2.2)
    title = "Each trial is a line, the best one thick; dark lines are better than light ones"
    chart.text(10.0, 14.0, title, size=9.5, bold=True)
    names = [*(axis.path for axis in picture.axes), picture.objective]
    for place, name in zip(chart.x(places).tolist(), names, strict=True):
        chart.shape([(place, 24), (place, 186)], stroke=palette.INK, width=0.7)
        for row, part in enumerate(textwrap.wrap(name.replace(".", ". "), 24)[:2]):
            text = part.replace(". ", ".")
            chart.text(max(place, 10.0), 198.0 + 10 * row, text, "start" if place < 60 else "middle")
    for number, axis in enumerate(picture.axes):
        _label_column(chart, number, axis.values, axis.log, axis.choices)
    _label_column(chart, len(picture.axes), picture.values, picture.log, ())
    return chart


def _label_column(
    chart: Chart, column: int, values: Sequence[float], log: bool, choices: tuple[str, ...]
) -> None:
    """Write the choices, or the lowest and the highest value, next to an axis of parallel coordinates."""
    if choices:
        heights = _unit(np.arange(len(choices), dtype=np.float64), False, choices)
        labels = list(zip(heights, (textwrap.shorten(choice, 18) for choice in choices), strict=True))
    else:
        ends = np.array([min(values), max(values)])
        labels = list(zip(_unit(ends, log, ()), (f"{end:,.4g}" for end in ends), strict=True))
    for height, text in dict(labels).items():
        chart.text(chart.x.at(column) + 5, chart.y.at(float(height)) + 2.8, text, size=SMALL, halo=True)


def _unit(values: Values, log: bool, choices: tuple[str, ...]) -> Values:
    """Return the places of values between the lowest, 0, and the highest, 1."""
    if choices:
        return values / max(len(choices) - 1, 1)
    scaled = np.log(values) if log else values
    width = scaled.max() - scaled.min()
    return np.asarray((scaled - scaled.min()) / width) if width else np.full(len(values), 0.5)
