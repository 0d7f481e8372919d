"""Charts of how a training went: what it did on its machine, and its returns, lengths and actions.

Lines show steps a second, processor, memory, GPUs, disk and network over time. Histograms are heat maps: the
share of the values of each stretch of training that are in a range.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from runner.analysis.axes import axis_of
from runner.analysis.histograms import ValueCounts
from runner.analysis.sections import Figure
from runner.drawing import palette
from runner.environments.naming import spoken
from runner.errors import shortened
from runner.export.plots.chart import (
    SMALL,
    Chart,
    Scale,
    labelled,
    number_on_axis,
    series_colour,
    series_marker,
)
from runner.export.plots.curves import HEIGHT, WIDTH, draw_legend
from runner.recording.machine import SAMPLE_SECONDS, Clock, HostMetrics
from runner.util import humanize
from runner.util.arrays import Floats

_INTERVALS: Final = 200
"""The most intervals of the time in which steps are counted."""
_GB, _MB = 1e9, 1e6
_SIZES: Final = {
    "memory_bytes": "Memory of the process, largest",
    "host_memory_total": "Memory of the machine",
    "gpu_memory_bytes": "GPU memory, largest",
    "disk_free_bytes": "Disk, free at the last sample",
}

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


class _Panel(NamedTuple):
    title: str
    unit: str
    lines: dict[str, Floats]
    top: float = 0.0
    """The least upper end of the axis."""


def machine_facts(clock: Clock, host: HostMetrics | None) -> dict[str, str]:
    """Return the facts of a run's time and of its machine, by name."""
    sessions = len(clock.earlier)
    rate = clock.steps_a_second
    facts = {
        "Time": humanize.duration(clock.duration) + (f", in {sessions} sessions" if sessions > 1 else ""),
        "Steps a second, mean": humanize.UNKNOWN if rate is None else f"{rate:,.0f}",
    }
    largest = {} if host is None else host.largest
    return facts | {_SIZES[name]: humanize.size(size) for name, size in largest.items()}


def machine_plots(clock: Clock, host: HostMetrics | None) -> Iterator[Figure]:
    """Yield the charts of a run over its time; those of its machine only if that was recorded."""
    edges = np.linspace(0, clock.duration, 1 + min(_INTERVALS, max(1, int(clock.duration / SAMPLE_SECONDS))))
    done = np.interp(edges, clock.seconds, clock.positions)
    if clock.duration > 0:
        rate = {"": np.diff(done) / np.diff(edges)}
        yield _plot(_Panel("Steps a second", "steps a second", rate), edges[1:], clock.duration)
    if host is not None:
        for panel in _host_panels(host):
            yield _plot(panel, host.seconds, clock.duration)


def _host_panels(host: HostMetrics) -> list[_Panel]:
    of = host.values
    panels = [
        _Panel("Processor, this process", "percent of one core", {"": of["cpu_percent"]}),
        _Panel("Processor, all of the machine", "percent", {"": of["host_cpu_percent"]}, 100.0),
        _Panel(
            "Memory",
            "GB",
            {"this process": of["memory_bytes"] / _GB, "all of the machine": of["host_memory_bytes"] / _GB},
        ),
    ]
    gpus = [f"GPU {k}" for k in range(host.gpus)]
    if gpus:
        use = of["gpu_percent"].T
        memory = of["gpu_memory_bytes"].T / _GB
        panels += [
            _Panel("GPU", "percent", dict(zip(gpus, use, strict=True)), 100.0),
            _Panel("GPU memory", "GB", dict(zip(gpus, memory, strict=True))),
        ]
    for title, lines in (
        ("Disk", {"read": "disk_read_bytes", "written": "disk_written_bytes"}),
        ("Network", {"received": "network_received_bytes", "sent": "network_sent_bytes"}),
    ):
        rates = {name: host.rate(field) / _MB for name, field in lines.items()}
        panels.append(_Panel(f"{title}, all of the machine", "MB a second", rates))
    return [panel for panel in panels if any(np.isfinite(values).any() for values in panel.lines.values())]


def _plot(panel: _Panel, seconds: Floats, duration: float) -> Figure:
    unit, divisor = next(
        scale
        for scale in (("hours", 3600.0), ("minutes", 60.0), ("seconds", 1.0))
        if duration >= 2 * scale[1] or scale[1] == 1
    )
    usable = {name: np.where(np.isfinite(values), values, np.nan) for name, values in panel.lines.items()}
    highest = max(float(np.nanmax(values, initial=0.0)) for values in usable.values())
    y = Scale(0.0, max(panel.top, 1.06 * highest) or 1.0, HEIGHT - 34, 32.0)
    chart = Chart(Scale(0.0, duration / divisor or 1.0, 50.0, WIDTH - 8), y, WIDTH, HEIGHT, panel.title)
    chart.x_ticks()
    chart.y_ticks(labelled(y.ticks, short=highest >= 10_000))
    chart.frame(panel.title, 25.0 if len(usable) == 1 else 14.0, unit, [panel.unit])
    for number, values in enumerate(usable.values()):
        is_known = ~np.isnan(values)
        places = seconds[is_known] / divisor
        known_values = values[is_known]
        chart.line(places, known_values, series_colour(number), number)
        if len(places) < 3:  # a line through one point is invisible
            chart.markers(places, known_values, series_colour(number), series_marker(number), 1.7)
    if len(usable) > 1:
        draw_legend(chart, chart.x.start, y.end - 8, list(usable), [*map(series_colour, range(len(usable)))])
    return Figure(chart.svg())


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
