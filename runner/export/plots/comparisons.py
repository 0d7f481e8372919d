"""Charts of a comparison and of a difference: intervals and profiles of groups, and distances of Q-tables.

Groups have the colours and markers that they have in the learning curves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from runner.analysis.compare import GroupResult, MetricResult
from runner.analysis.compare.tasks import AlgorithmResult
from runner.analysis.diff.extent import TableDiff
from runner.analysis.statistics import Estimate
from runner.drawing import palette
from runner.environments.naming import spoken
from runner.export.plots.chart import Canvas, Chart, Scale, labelled, series_colour, series_marker
from runner.export.plots.curves import HEIGHT, WIDTH, draw_legend

_SPREAD: Final = 0.22
"""Largest distance of the points of single seeds from their group's line, in rows."""
_MEASURES: Final = (
    ("largest", "largest difference", 1),
    ("mean", "mean difference", 1),
    ("greedy_share", "other greedy action, %", 100),
)


def intervals_svg(metric: MetricResult, labels: list[str]) -> str:
    """Return each group's seeds as points, its median as a tick, and its IQM with the 95 % interval.

    The labels are those of all groups, in the order of their colours.
    """
    bottom = 12.0 + max(100.0, 30.0 * len(metric.groups))
    drawn = [
        value
        for group in metric.groups
        for value in (*group.values, group.median, group.iqm.low, group.iqm.high)
        if math.isfinite(value)
    ]
    x = Scale.around(np.array(drawn), 40.0, WIDTH - 10)
    y = Scale(len(metric.groups) - 0.4, -0.6, bottom, 12.0)
    chart = Chart(x, y, WIDTH, bottom + 34, f"{metric.title}: values of the groups")
    chart.x_ticks()
    chart.shape([(x.start, bottom), (x.end, bottom)], stroke=palette.INK)
    chart.text((x.start + x.end) / 2, chart.height - 5, metric.unit, "middle")
    for row, group in enumerate(metric.groups):
        number = labels.index(group.label)
        chart.text(x.start - 8, y.at(row) + 3, letter(number), "end", bold=True)
        _draw_group(chart, group, row, number)
    return chart.svg()


def profile_chart(
    heading: str,
    title: str,
    unit: str,
    thresholds: Sequence[float],
    groups: Sequence[GroupResult] | Sequence[AlgorithmResult],
    labels: Sequence[str],
    is_lower_better: bool = False,
) -> Chart:
    """Return performance profiles over levels in a unit, with their bands.

    `heading`, above the chart, may be empty; `title` is the description for screen readers; `labels` are
    those of all groups, in the order of their colours. Where lower is better, a run reaches a level by being
    lower.
    """
    levels = np.array(thresholds)
    x, y = Scale.around(levels, 50.0, WIDTH - 10), Scale(0, 103, 146.0, 16.0 if not heading else 32.0)
    chart = Chart(x, y, WIDTH, HEIGHT, title)
    chart.x_ticks()
    chart.y_ticks(labelled(range(0, 101, 20)))
    sign = "at most" if is_lower_better else "at least"
    chart.frame(heading, 25.0 if heading else 14.0, f"{unit}, {sign}", ["percent of runs"])
    for group in groups:
        number = labels.index(group.label)
        share = 100 * np.array(group.profile)
        low, high = 100 * np.array(group.profile_low), 100 * np.array(group.profile_high)
        if not np.isnan(low).any():
            chart.band(levels, low, high, series_colour(number), opacity=0.2)
        steps, heights = np.repeat(levels, 2), np.repeat(share, 2)
        # A share holds from its level on where lower is better, else up to it.
        line = (steps[1:], heights[:-1]) if is_lower_better else (steps[:-1], heights[1:])
        chart.marked_line(*line, number, at=(levels, share))
    return chart


def tables_svg(tables: Sequence[TableDiff]) -> str:
    """Return the largest and the mean difference, and the share of other greedy actions, over episodes."""
    agents = list(dict.fromkeys(table.agent for table in tables))
    colours = [series_colour(2 + i % 3) for i in range(len(agents))]
    last = max(table.episode for table in tables) or 1
    canvas = Canvas(WIDTH, 270.0, "Difference of the Q-tables over training episodes")
    for row, (name, label, factor) in enumerate(_MEASURES):
        high = factor * max(getattr(table, name) for table in tables) * 1.06 or 1.0
        is_last = row == len(_MEASURES) - 1
        x, y = Scale(0.0, last * 1.02, 50.0, WIDTH - 10), Scale(0.0, high, 84.0, 32.0)
        chart = Chart(x, y, WIDTH, 119.0, "")
        chart.x_ticks([(tick, text if is_last else "") for tick, text in labelled(x.ticks)])
        chart.y_ticks(labelled(y.ticks[:: 1 if len(y.ticks) < 5 else 2]))
        chart.frame(label, 27.0, "training episodes" if is_last else "")
        for i, agent in enumerate(agents):
            own = [(table.episode, factor * getattr(table, name)) for table in tables if table.agent == agent]
            episodes, values = np.array(own, np.float64).T
            chart.line(episodes, values, colours[i], i)
            chart.markers(episodes, values, colours[i], i, 1.6)
        canvas.place(chart, 0, 76.0 * row)
    if len(agents) > 1:
        draw_legend(canvas, 150.0, 24.0, [spoken(agent) for agent in agents], colours)
    return canvas.svg()


def letter(number: int) -> str:
    """Return the letter of a group: A, B, ...; its number if there are more than 26."""
    return chr(ord("A") + number) if number < 26 else str(number + 1)


def _draw_group(chart: Chart, group: GroupResult, row: int, number: int) -> None:
    colour = series_colour(number)
    height = chart.y.at(row)
    values = np.array([value for value in group.values if math.isfinite(value)])
    spread = np.linspace(-1, 1, len(values)) if len(values) > 1 else np.zeros(len(values))
    chart.markers(values, row + _SPREAD * spread, colour, 0, 1.2, opacity=0.45)
    if math.isfinite(group.median):
        median = chart.x.at(group.median)
        chart.shape([(median, height - 7.5), (median, height + 7.5)], stroke=palette.INK, width=1.6)
    if all(map(math.isfinite, (group.iqm.value, group.iqm.low, group.iqm.high))):
        draw_estimate(chart, group.iqm, row, number, 3.0)


def draw_estimate(chart: Chart, estimate: Estimate, row: int, number: int, radius: float) -> None:
    """Draw a value as the marker of a series in a row of a chart, and its interval as a thick line."""
    if math.isfinite(estimate.low):
        ends = [(chart.x.at(end), chart.y.at(row)) for end in (estimate.low, estimate.high)]
        chart.shape(ends, stroke=series_colour(number), width=radius + 0.4)
    value = np.array([estimate.value])
    at = np.array([float(row)])
    chart.markers(value, at, series_colour(number), series_marker(number), radius, edge=palette.INK)
