"""Histograms over training as heat maps: the share of the values of each stretch that are in a range."""

from __future__ import annotations

from typing import Final

import numpy as np

from runner.analysis.axes import axis_of
from runner.analysis.histograms import ValueCounts
from runner.analysis.sections import Figure
from runner.drawing import palette
from runner.environments.naming import spoken
from runner.errors import shortened
from runner.export.plots.chart import SMALL, Chart, Scale, labelled, number_on_axis
from runner.export.plots.curves import HEIGHT, WIDTH

_TITLES: Final = {
    "return": "Returns of training episodes",
    "length": "Lengths of training episodes",
    "action": "Actions in training",
    "reward": "Rewards in training",
}
_MAX_LETTERS: Final = 20
_LETTER: Final = 4.8
"""The width of a letter of a label, with room for wide ones."""
EXPLANATION: Final = (
    "In each stretch of training, the share of its values in each range: the lighter, the more; nothing is "
    "drawn where there is none."
)


def heatmap_plots(histograms: list[ValueCounts]) -> list[Figure]:
    """Return the heat maps for a page, of what is not constant."""
    varying = [histogram for histogram in histograms if len(histogram.names) != 1]
    return [Figure(heatmap_chart(histogram).svg()) for histogram in varying]


def constants_in(histograms: list[ValueCounts]) -> list[str]:
    """Return a sentence on each quantity that has one value, of which a heat map shows nothing."""
    return [
        f"{title_of(histogram)}: always {histogram.names[0]}."
        for histogram in histograms
        if len(histogram.names) == 1
    ]


def title_of(histogram: ValueCounts) -> str:
    """Return the title of a heat map."""
    return _TITLES[histogram.quantity] + (f": {spoken(histogram.line)}" if histogram.line else "")


def heatmap_chart(histogram: ValueCounts) -> Chart:
    """Return the heat map of a histogram."""
    counts = np.array(histogram.counts, np.float64)
    totals = counts.sum(axis=1, keepdims=True)
    shares = np.divide(counts, totals, out=np.zeros_like(counts), where=totals > 0)
    rows = counts.shape[1]
    names = [shortened(name, _MAX_LETTERS) for name in histogram.names]
    left = max(56.0, 16 + _LETTER * max(map(len, names), default=0))
    axis = axis_of(histogram.axis)
    x = Scale(0.0, histogram.edges[-1], left, WIDTH - 16)
    low, high = (0.0, float(rows)) if histogram.names else (histogram.values[0], histogram.values[-1])
    y = Scale(low, high, HEIGHT - 34, 34.0)
    title = title_of(histogram)
    chart = Chart(x, y, WIDTH, HEIGHT, f"{title} over {axis.title}, {histogram.unit}")
    edges = np.arange(rows + 1.0) if histogram.names else np.array(histogram.values)
    lines = y(edges)
    columns = x(np.array(histogram.edges))
    levels = np.ceil(shares / (shares.max() or 1.0) * (palette.LEVELS - 1)).astype(int)
    for level in np.unique(levels[levels > 0]).tolist():
        k, j = np.nonzero(levels == level)
        cells = np.column_stack(
            [columns[k], lines[j + 1], columns[k + 1] - columns[k], lines[j] - lines[j + 1]]
        )
        chart.cells(cells, palette.ramp_colour(level))
    ticks = x.ticks if not axis.whole else [tick for tick in x.ticks if tick == int(tick)]
    for tick, text in labelled(ticks, short=histogram.edges[-1] >= 10_000):
        chart.shape([(x.at(tick), y.start), (x.at(tick), y.start + 3)], stroke=palette.INK)
        chart.text(x.at(tick), y.start + 11.5, text, "middle", size=8)
    named = [(k + 0.5, name) for k, name in enumerate(names)]
    for at, name in named[:: -(-rows // 10)] or [(tick, number_on_axis(tick)) for tick in y.ticks]:
        chart.text(x.start - 5, y.at(at) + 3, name, "end", size=8)
    chart.frame(title, 14.0, axis.label)
    chart.text(x.start, 26.0, f"{histogram.unit}; lightest: {100 * shares.max():.0f} %", size=SMALL)
    return chart
