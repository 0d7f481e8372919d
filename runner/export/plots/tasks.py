"""Charts of a comparison over environments: aggregates, performance profiles, sample-efficiency curves."""

from __future__ import annotations

import math
import textwrap
from typing import Final

import numpy as np

from runner.analysis.compare.sections import AGGREGATES, TASKS_EXPLANATION
from runner.analysis.compare.tasks import TaskComparison
from runner.export.plots.chart import SMALL, Canvas, Chart, Scale, labelled, series_colour
from runner.export.plots.comparisons import draw_estimate, letter, profile_chart
from runner.export.plots.curves import HEIGHT, WIDTH

_SCORE: Final = "normalised score"
_LETTERS: Final = 150
"""Letters of a note on a line of the sheet."""


def task_charts(comparison: TaskComparison) -> list[Canvas]:
    """Return the charts: each aggregate, the performance profile, and the curve where runs have one."""
    labels = [result.label for result in comparison.algorithms]
    title = f"Performance profile over {len(comparison.tasks)} environments"
    profile = profile_chart(
        "Performance profile", title, _SCORE, comparison.thresholds, comparison.algorithms, labels
    )
    curves = [_curves(comparison)] if len(comparison.positions) > 1 else []
    return [_aggregates(comparison), profile, *curves]


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


def _aggregates(comparison: TaskComparison) -> Canvas:
    """Return a row for each aggregate, with the value and interval of each algorithm."""
    count = len(comparison.algorithms)
    row = max(34.0, 9.0 * count + 16)
    canvas = Canvas(WIDTH, max(HEIGHT, 32 + row * len(AGGREGATES)), "Aggregates of normalised scores")
    canvas.text(78.0, 25, "Aggregates, with 95 % intervals", size=9.5, bold=True)
    for k, (name, estimate_of) in enumerate(AGGREGATES):
        top = 32 + row * k
        ends = [
            end
            for result in comparison.algorithms
            for end in (estimate_of(result).low, estimate_of(result).value, estimate_of(result).high)
            if math.isfinite(end)
        ]
        chart = Chart(
            Scale.around(np.array(ends), 78.0, WIDTH - 10),
            Scale(count - 0.4, -0.6, top + row - 16, top),
            0,
            0,
            "",
        )
        chart.x_ticks()
        for i, result in enumerate(comparison.algorithms):
            draw_estimate(chart, estimate_of(result), i, i, 2.6)
        chart.text(70.0, top + (row - 16) / 2 + 3, name, "end")
        canvas.place(chart, 0, 0)
    return canvas


def _curves(comparison: TaskComparison) -> Chart:
    """Return the IQM of the scores over the positions that all runs cover."""
    places = np.array(comparison.positions)
    ends = [result.curve for result in comparison.algorithms]
    ends += [part for r in comparison.algorithms for part in (r.curve_low, r.curve_high)]
    values = np.array(ends)
    y = Scale.around(values[np.isfinite(values)], 146.0, 32.0)
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
