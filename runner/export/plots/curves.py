"""Learning curves of groups of runs: a chart for each metric, and all of them on one sheet for print.

Groups differ in colour and marker, the lines of a group in their dashes, so that nothing relies on colour
alone. Percent goes from 0 to 100, and what cannot be negative starts at zero.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from runner.analysis.axes import EPISODES
from runner.analysis.groups import Curve, Group, NoMetrics, Panel, panels_of, smoothed
from runner.analysis.sections import Figure, LegendEntry, Section
from runner.analysis.series import values_left_out
from runner.drawing import palette
from runner.environments.naming import spoken
from runner.errors import RunnerError
from runner.export.plots.chart import (
    SMALL,
    Canvas,
    Chart,
    Markers,
    Scale,
    labelled,
    series_colour,
    series_marker,
)
from runner.recording.metrics import SHARES
from runner.util.arrays import Flags, Floats
from runner.util.humanize import listed

WIDTH: Final = 288.0
HEIGHT: Final = 180.0
_TOP: Final = 32.0
_BOTTOM: Final = 146.0
_LETTER: Final = 0.56
"""Width of an average letter, as a share of the text's size."""
_LETTERS: Final = 215
"""Letters of a note that fit on a line of a sheet of three columns."""


@dataclass(frozen=True)
class CurveStyle:
    """How curves are drawn."""

    lines: bool = False
    """Whether each run of a curve is drawn as a thin line too."""
    smooth: float = 0.0
    """Memory of the exponential mean that is drawn, in percent of the axis; 0 for the values themselves."""
    log_x: bool = False
    """Whether the horizontal axis is logarithmic; points at 0 are left out."""
    log_y: bool = False
    """Whether the vertical axes are logarithmic; points at 0 or below are left out."""

    def __post_init__(self) -> None:
        """Raise RunnerError if `smooth` is no percentage."""
        if not 0 <= self.smooth <= 100:
            raise RunnerError(
                f"smooth: found {self.smooth}, expected a percentage of the axis from 0 to 100."
            )


PLAIN: Final = CurveStyle()


def style_of(panel: Panel, style: CurveStyle) -> CurveStyle:
    """Return the style in which a panel can be drawn.

    An axis without positive values stays linear, and so do shares, which are drawn on top of each other.
    """
    log_x = style.log_x and panel.last > 0
    positive = any(
        ((curve.middle > 0) & (curve.places > 0 if log_x else True)).any() for curve in panel.curves
    )
    return replace(style, log_x=log_x, log_y=style.log_y and positive and panel.metric != SHARES)


def visible(places: Floats, values: Floats, style: CurveStyle) -> Flags:
    """Return which points have a place on the axes of a style, bool [n]."""
    is_visible = ~np.isnan(values)
    if style.log_x:
        is_visible &= places > 0
    if style.log_y:
        is_visible &= values > 0
    return is_visible


def not_drawn(panels: Sequence[Panel], style: CurveStyle) -> str:
    """Return a sentence on what logarithmic axes leave out, and which axes stay linear; empty if nothing."""
    left_out, linear = [], []
    for panel in panels:
        panel_style = style_of(panel, style)
        count = sum(int((~visible(curve.places, curve.middle, panel_style)).sum()) for curve in panel.curves)
        if count:
            left_out.append(f"“{panel.title}” ({count:,})")
        if style.log_y and not panel_style.log_y and panel.metric != SHARES:
            linear.append(f"“{panel.title}”")
    parts = []
    if left_out:
        parts.append(f"points at 0 or below are left out of {listed(left_out)}")
    if linear:
        parts.append(f"no value is positive in {listed(linear)}, so the axis is linear")
    return f" On logarithmic axes {'; '.join(parts)}." if parts else ""


def curves_section(
    groups: Sequence[Group], style: CurveStyle = PLAIN, legend: Sequence[LegendEntry] = ()
) -> Section:
    """Return the learning curves of groups of runs for a page, and a note on them."""
    try:
        panels = panels_of(groups)
    except NoMetrics:
        return Section("Learning curves", ["No metrics were recorded."])
    figures = [
        Figure(panel_chart(panel, len(groups), style).svg(), is_wide=panel.metric == SHARES)
        for panel in panels
    ]
    return Section("Learning curves", [footnote(groups, panels, style)], figures=figures, legend=legend)


def curves_sheet(groups: Sequence[Group], panels: Sequence[Panel], style: CurveStyle = PLAIN) -> Canvas:
    """Return all panels on one sheet, with a legend of the groups above and notes below."""
    columns = min(3, len(panels))
    ordered = sorted(panels, key=lambda panel: panel.metric == SHARES)
    has_wide = ordered[-1].metric == SHARES  # which takes the last row
    width = WIDTH * max(columns, 2)
    notes = textwrap.wrap(footnote(groups, panels, style), round(_LETTERS * width / (3 * WIDTH)))
    head = 32.0 + 14 * len(groups)
    rows = math.ceil((len(panels) - has_wide) / columns) + has_wide
    sheet = Canvas(width, head + HEIGHT * rows + 8 + 10 * len(notes), f"Metrics over {groups[0].axis.title}")
    sheet.text(10, 20, sheet.title, size=13, bold=True)
    for number, group in enumerate(groups):
        colour = series_colour(number)
        y = 36.0 + 14 * number
        sheet.shape([(12, y - 3), (36, y - 3)], stroke=colour, width=1.5, is_curve=True)
        key = np.array([[24, y - 3]])
        sheet.marks.append(Markers(key, series_marker(number), 2, colour, colour, 1.0))
        sheet.text(42, y, group.described)
    for number, panel in enumerate(ordered):
        row, column = (rows - 1, 0) if panel.metric == SHARES else divmod(number, columns)
        sheet.place(panel_chart(panel, len(groups), style), WIDTH * column, head + HEIGHT * row)
    sheet.notes(notes)
    return sheet


def footnote(groups: Sequence[Group], panels: Sequence[Panel], style: CurveStyle = PLAIN) -> str:
    """Return what lines and bands mean, and which values are not drawn."""
    runs = [run for group in groups for run in group.runs]
    sentences = [*dict.fromkeys(run.averaged for run in runs), *values_left_out(runs)]
    left_out = "".join(f" {sentence}" for sentence in sentences if sentence) + not_drawn(panels, style)
    if style.smooth:
        left_out = (
            f" Lines are exponential means with a memory of {style.smooth:g} % of the axis; "
            f"their values are drawn faintly behind.{left_out}"
        )
    loops = any(not run.can_train_again for run in runs)
    interpolated = loops or runs[0].axis is not EPISODES
    greedy = "" if loops else " Evaluation trials follow the greedy policy: no exploring."
    if max(len(group.runs) for group in groups) == 1:
        return f"Each line is one run, as reported.{greedy}{left_out}"
    between = " Between its points a run is interpolated." if interpolated else ""
    return (
        "A line is the interquartile mean of a configuration's runs at that point, with its 95 % bootstrap "
        "interval as a band. With fewer than four runs it is their mean, with a band from lowest to highest."
        f"{between}{greedy}{left_out}"
    )


def panel_chart(panel: Panel, groups: int, style: CurveStyle = PLAIN) -> Chart:
    """Return the chart of a metric: curves of groups of runs over their axis."""
    is_shares = panel.metric == SHARES
    style = style_of(panel, style)
    x = _x_scale(panel, style, 461.0 if is_shares else 280.0)
    y = _y_scale(panel, style)
    width = 2 * WIDTH if is_shares else WIDTH
    chart = Chart(x, y, width, HEIGHT, f"{panel.title} over {panel.axis.title}")
    has_legend = len(panel.lines) > 1 and not is_shares
    largest = max(abs(y.low), abs(y.high))
    if is_shares:
        _draw_shares(chart, panel, style)
    ticks = x.ticks if not panel.axis.whole else [tick for tick in x.ticks if tick == int(tick)]
    chart.x_ticks(labelled(ticks, short=panel.axis is not EPISODES))
    chart.y_ticks(labelled(range(0, 101, 20) if panel.percent and not y.log else y.ticks, largest >= 10_000))
    chart.frame(panel.title, 14.0 if has_legend else 25.0, panel.axis.label, [panel.unit])
    if is_shares:
        return chart
    if not panel.percent and not panel.at_least_zero and not y.log:
        chart.shape([(x.start, y.at(0)), (x.end, y.at(0))], stroke=palette.INK, width=0.6)
    for curve in panel.curves:
        _draw_curve(chart, panel, curve, groups, style)
    if has_legend:
        colours = [series_colour(i) if groups == 1 else palette.INK for i in range(len(panel.lines))]
        draw_legend(chart, x.start, y.end - 8, [spoken(line) or "all" for line in panel.lines], colours)
    return chart


def draw_legend(canvas: Canvas, at: float, y: float, names: Sequence[str], colours: Sequence[str]) -> None:
    """Name lines from left to right, each with its colour and its dashes."""
    for number, (name, colour) in enumerate(zip(names, colours, strict=True)):
        canvas.shape([(at, y), (at + 18, y)], stroke=colour, width=1.5, dash=number)
        canvas.text(at + 22, y + 2.8, name, size=SMALL)
        at += 32 + len(name) * SMALL * _LETTER


def _x_scale(panel: Panel, style: CurveStyle, end: float) -> Scale:
    last = panel.last or 1.0
    if not style.log_x:
        return Scale(0.0, last * 1.02, 50.0, end)
    first = min(float(curve.places[curve.places > 0].min(initial=last)) for curve in panel.curves)
    if first == last:
        return Scale(first / 2, last * 2, 50.0, end, log=True)
    return Scale(first, last * (last / first) ** 0.02, 50.0, end, log=True)


def _y_scale(panel: Panel, style: CurveStyle) -> Scale:
    drawn = []
    for curve in panel.curves:
        lines = np.vstack(
            [curve.low, curve.high, *(curve.runs if style.lines else ()), _shown(panel, curve, style)]
        )
        drawn.append(lines[:, curve.places > 0] if style.log_x else lines)
    values = np.concatenate([lines[np.isfinite(lines)] for lines in drawn])
    if style.log_y:
        return Scale.around(values[values > 0], _BOTTOM, _TOP, log=True)
    low, high = float(values.min()), float(values.max())
    if panel.percent:
        low, high = 0.0, 100.0 if panel.metric == SHARES else 103.0
    elif panel.at_least_zero:
        low, high = 0.0, high * 1.06 or 1.0
    else:
        low, high = min(low, 0.0), max(high, 0.0)
        low, high = low - 0.05 * (high - low), high + 0.05 * (high - low)
    return Scale(low, high, _BOTTOM, _TOP)


def _shown(panel: Panel, curve: Curve, style: CurveStyle) -> Floats:
    """Return the values of a curve's line: its own, or their exponential mean; NaN where it is not drawn."""
    values = curve.middle
    if style.smooth and panel.last > 0:
        values = smoothed(curve.places, values, panel.last * style.smooth / 100)
    return np.where(
        visible(curve.places, curve.middle, style) & visible(curve.places, values, style), values, np.nan
    )


def _draw_curve(chart: Chart, panel: Panel, curve: Curve, groups: int, style: CurveStyle) -> None:
    line = panel.lines.index(curve.line)
    number = line if groups == 1 and len(panel.lines) > 1 else curve.group
    colour = series_colour(number)
    inside = visible(curve.places, curve.middle, style)
    if (curve.high > curve.low)[inside].any():
        low = np.maximum(curve.low[inside], chart.y.low) if style.log_y else curve.low[inside]
        chart.band(curve.places[inside], low, curve.high[inside], colour, opacity=0.2)
    if style.lines and len(curve.runs) > 1:
        for run in curve.runs:
            is_visible = visible(curve.places, run, style)
            chart.line(curve.places[is_visible], run[is_visible], colour, line, width=0.6, opacity=0.5)
    if style.smooth:
        chart.line(curve.places[inside], curve.middle[inside], colour, line, width=0.8, opacity=0.35)
    values = _shown(panel, curve, style)
    places, values = curve.places[~np.isnan(values)], values[~np.isnan(values)]
    if not len(places):
        return
    chart.marked_line(places, values, number, line)


def _draw_shares(chart: Chart, panel: Panel, style: CurveStyle) -> None:
    """Draw shares of a whole on top of each other, the lowest reward darkest and at the bottom."""
    places = panel.curves[0].places
    if style.log_x:
        places = places[places > 0]
    bottom = np.zeros_like(places)
    colours = palette.ramp_colours(len(panel.curves))
    for curve, colour in zip(panel.curves, colours, strict=True):
        top = bottom + np.interp(places, curve.places, _shown(panel, curve, replace(style, log_x=False)))
        chart.band(places, bottom, top, colour, stroke=palette.WHITE, width=0.3)
        bottom = top
    left = chart.x.end + 10
    chart.text(left, chart.y.end + 4, "reward of a step", size=8)
    rows = math.ceil(len(colours) / (2 if len(colours) > 8 else 1))
    entries = reversed(list(zip(panel.curves, colours, strict=True)))
    for number, (curve, colour) in enumerate(entries):
        column, row = divmod(number, rows)
        x, y = left + 50 * column, chart.y.end + 10 + 104 / max(rows, 8) * row
        chart.shape([(x, y), (x + 14, y), (x + 14, y + 7), (x, y + 7)], fill=colour)
        chart.text(x + 18, y + 6.5, curve.line, size=SMALL)
