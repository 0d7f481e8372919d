"""Charts of comparisons: intervals and profiles of groups, distances of Q-tables, scores over environments.

An explanation compares mixtures of settings: bars of estimates, and the values of each mixture.
Groups have the colours and markers that they have in the learning curves.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Collection, Sequence
from typing import Final, NamedTuple

import numpy as np

from runner.analysis.compare import GroupResult, MetricResult
from runner.analysis.compare.sections import AGGREGATES, TASKS_EXPLANATION
from runner.analysis.compare.tasks import AlgorithmResult, TaskComparison
from runner.analysis.diff.extent import TableDiff
from runner.analysis.statistics import Estimate
from runner.drawing import palette
from runner.environments.naming import spoken
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
from runner.export.plots.curves import HEIGHT, WIDTH, draw_legend
from runner.util.arrays import Floats

_SPREAD: Final = 0.22
"""Largest distance of the points of single seeds from their group's line, in rows."""
_MEASURES: Final = (
    ("largest", "largest difference", 1),
    ("mean", "mean difference", 1),
    ("greedy_share", "other greedy action, %", 100),
)
"""Fields of a `TableDiff`, their labels and the factors of their axes."""
_SCORE: Final = "normalised score"
_LETTERS: Final = 150
"""Letters of a note on a line of the sheet."""
_NAMES: Final = 205.0
"""Where charts begin, right of the names of settings."""
_WIDTH: Final = 590.0
_ROW: Final = 20.0
"""Width of a chart of mixtures, and height of a bar's row, in points."""
_MAX_NAME: Final = 38
"""Letters of a setting's name."""


# --- groups of runs -----------------------------------------------------------------------------------


def intervals_svg(metric: MetricResult, labels: list[str]) -> str:
    """Return each group's seeds as points, its median as a tick, and its IQM with the 95 % interval.

    The labels are those of all groups, in the order of their colours.
    """
    bottom = 12.0 + max(100.0, 30.0 * len(metric.groups))
    drawn = [(*group.values, group.median, group.iqm.low, group.iqm.high) for group in metric.groups]
    x = Scale.around(np.concatenate(drawn), 40.0, WIDTH - 10)
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


def draw_estimate(chart: Chart, estimate: Estimate, row: int, number: int, radius: float) -> None:
    """Draw a value as the marker of a series in a row of a chart, and its interval as a thick line."""
    if math.isfinite(estimate.low):
        ends = [(chart.x.at(end), chart.y.at(row)) for end in (estimate.low, estimate.high)]
        chart.shape(ends, stroke=series_colour(number), width=radius + 0.4)
    value = np.array([estimate.value])
    at = np.array([float(row)])
    chart.markers(value, at, series_colour(number), series_marker(number), radius, edge=palette.INK)


def letter(number: int) -> str:
    """Return the letter of a group: A, B, ...; its number if there are more than 26."""
    return chr(ord("A") + number) if number < 26 else str(number + 1)


# --- two runs -----------------------------------------------------------------------------------------


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
            points = [
                (table.episode, factor * getattr(table, name)) for table in tables if table.agent == agent
            ]
            episodes, values = np.array(points, np.float64).T
            chart.line(episodes, values, colours[i], i)
            chart.markers(episodes, values, colours[i], i, 1.6)
        canvas.place(chart, 0, 76.0 * row)
    if len(agents) > 1:
        draw_legend(canvas, 150.0, 24.0, [spoken(agent) for agent in agents], colours)
    return canvas.svg()


# --- algorithms over environments ---------------------------------------------------------------------


def tasks_sheet(comparison: TaskComparison) -> Canvas:
    """Return all charts on one sheet, with a legend above and notes below."""
    charts = task_charts(comparison)
    notes = textwrap.wrap(TASKS_EXPLANATION, _LETTERS)
    head = 46.0 + 14 * len(comparison.algorithms)
    height = head + max(chart.height for chart in charts) + 10 * len(notes) + 8
    sheet = Canvas(
        WIDTH * len(charts), height, f"Normalised scores over {len(comparison.tasks)} environments"
    )
    sheet.text(10, 20, sheet.title, size=13, bold=True)
    sheet.text(10, 34, f"{comparison.title}, {comparison.moment}; by {comparison.normalised_by}", size=SMALL)
    for i, result in enumerate(comparison.algorithms):
        y = 50.0 + 14 * i
        sheet.shape([(12, y - 3), (36, y - 3)], stroke=series_colour(i), width=1.5)
        sheet.text(42, y, f"{letter(i)}: {result.label}, {sum(result.seeds.values())} runs")
    for i, chart in enumerate(charts):
        sheet.place(chart, WIDTH * i, head)
    sheet.notes(notes)
    return sheet


def task_charts(comparison: TaskComparison) -> list[Canvas]:
    """Return the charts: each aggregate, the performance profile, and the curve where runs have one."""
    labels = [result.label for result in comparison.algorithms]
    title = f"Performance profile over {len(comparison.tasks)} environments"
    profile = profile_chart(
        "Performance profile", title, _SCORE, comparison.thresholds, comparison.algorithms, labels
    )
    curves = [_curves(comparison)] if len(comparison.positions) > 1 else []
    return [_aggregates(comparison), profile, *curves]


def _aggregates(comparison: TaskComparison) -> Canvas:
    """Return a row for each aggregate, with the value and interval of each algorithm."""
    count = len(comparison.algorithms)
    row = max(34.0, 9.0 * count + 16)
    canvas = Canvas(WIDTH, max(HEIGHT, 32 + row * len(AGGREGATES)), "Aggregates of normalised scores")
    canvas.text(78.0, 25, "Aggregates, with 95 % intervals", size=9.5, bold=True)
    for k, (name, estimate_of) in enumerate(AGGREGATES):
        top = 32 + row * k
        estimates = [estimate_of(result) for result in comparison.algorithms]
        x = Scale.around(_ends(estimates), 78.0, WIDTH - 10)
        chart = Chart(x, Scale(count - 0.4, -0.6, top + row - 16, top), 0, 0, "")
        chart.x_ticks()
        for i, estimate in enumerate(estimates):
            draw_estimate(chart, estimate, i, i, 2.6)
        chart.text(70.0, top + (row - 16) / 2 + 3, name, "end")
        canvas.place(chart, 0, 0)
    return canvas


def _curves(comparison: TaskComparison) -> Chart:
    """Return the IQM of the scores over the positions that all runs cover."""
    places = np.array(comparison.positions)
    ends = [result.curve for result in comparison.algorithms]
    ends += [part for r in comparison.algorithms for part in (r.curve_low, r.curve_high)]
    values = np.array(ends)
    y = Scale.around(values, 146.0, 32.0)
    chart = Chart(Scale(places[0], places[-1], 50.0, WIDTH - 10), y, WIDTH, HEIGHT, "Sample efficiency")
    chart.x_ticks(labelled(chart.x.ticks, short=places[-1] >= 10_000))
    chart.y_ticks()
    chart.frame("Sample efficiency", 25.0, comparison.axis, [f"{_SCORE}, IQM"])
    for i, result in enumerate(comparison.algorithms):
        low, high = np.array(result.curve_low), np.array(result.curve_high)
        if not np.isnan(low).any():
            chart.band(places, low, high, series_colour(i), opacity=0.2)
        chart.marked_line(places, np.array(result.curve), i)
    return chart


# --- mixtures of settings -----------------------------------------------------------------------------


class BarColumn(NamedTuple):
    """A mixture: the settings that are changed in it, and its values, one a seed."""

    changed: Collection[str]
    values: Sequence[float]
    is_marked: bool
    """Whether it has the second colour."""


def bars_chart(title: str, rows: list[tuple[str, Estimate]]) -> Chart:
    """Return a bar from 0 for each named estimate, with its interval; pale if that includes 0."""
    bottom = 24.0 + _ROW * len(rows)
    x = Scale.around(np.append(_ends([estimate for _, estimate in rows]), 0.0), _NAMES, _WIDTH - 10)
    chart = Chart(x, Scale(len(rows) - 0.5, -0.5, bottom, 24.0), _WIDTH, bottom + 18, title)
    chart.text(5, 14, title, size=9.5, bold=True)
    chart.x_ticks()
    zero = x.at(0)
    for row, (name, share) in enumerate(rows):
        middle = chart.y.at(row)
        end = x.at(share.value)
        corners = [(zero, middle - 6), (end, middle - 6), (end, middle + 6), (zero, middle + 6)]
        chart.shape(corners, fill=series_colour(0), opacity=0.75 if share.excludes_zero else 0.3)
        if math.isfinite(share.low):
            low, high = x.at(share.low), x.at(share.high)
            serifs = ([(at, middle - 3), (at, middle + 3)] for at in (low, high))
            for line in ([(low, middle), (high, middle)], *serifs):
                chart.shape(line, stroke=palette.INK, width=1.2)
        chart.text(_NAMES - 8, middle + 3, _short(name), "end")
    chart.shape([(zero, 24), (zero, bottom)], stroke=palette.INK)
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
    for column, mixture in enumerate(columns):
        results = np.array(mixture.values)
        colour = series_colour(1 if mixture.is_marked else 0)
        spread = np.linspace(-0.18, 0.18, len(results)) if len(results) > 1 else np.zeros(1)
        chart.markers(column + spread, results, colour, 0, 1.3, opacity=0.5)
        chart.line(np.array([column - 0.32, column + 0.32]), np.full(2, results.mean()), colour, width=2.2)
        for row, name in enumerate(names):
            place = np.array([[x.at(column), bottom + 16 + 16 * row]])
            chart.marks.append(Markers(place, 0, 3.5, colour if name in mixture.changed else "", colour, 1.0))
    for row, name in enumerate(names):
        chart.text(_NAMES - 8, bottom + 19 + 16 * row, _short(name), "end")
    return chart


def _ends(estimates: Sequence[Estimate]) -> Floats:
    """Return the values of estimates, and the ends of their intervals."""
    return np.array([(estimate.low, estimate.value, estimate.high) for estimate in estimates])


def _short(name: str) -> str:
    """Return a name that fits left of a chart; of a pair of settings the longer one is shortened."""
    parts = name.split(" x ")
    if (excess := len(name) - _MAX_NAME) > 0:
        at = max(range(len(parts)), key=lambda i: len(parts[i]))
        parts[at] = f"{parts[at][: max(len(parts[at]) - excess - 1, 3)]}…"
    return " x ".join(parts)
