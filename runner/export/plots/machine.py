"""Charts of how a training went on its machine: steps a second, processor, memory, GPUs, disk, network."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from runner.analysis.sections import Figure
from runner.export.plots.chart import Chart, Scale, labelled, series_colour, series_marker
from runner.export.plots.curves import HEIGHT, WIDTH, draw_legend
from runner.recording.machine import SAMPLE_SECONDS, Clock, HostMetrics
from runner.util import humanize
from runner.util.arrays import Floats

Values = Floats
_INTERVALS: Final = 200
"""The most intervals of the time in which steps are counted."""
_GB, _MB = 1e9, 1e6
_SIZES: Final = {
    "memory_bytes": "Memory of the process, largest",
    "host_memory_total": "Memory of the machine",
    "gpu_memory_bytes": "GPU memory, largest",
    "disk_free_bytes": "Disk, free at the last sample",
}


class _Panel(NamedTuple):
    title: str
    unit: str
    lines: dict[str, Values]
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


def _plot(panel: _Panel, seconds: Values, duration: float) -> Figure:
    unit, divisor = next(
        each
        for each in (("hours", 3600.0), ("minutes", 60.0), ("seconds", 1.0))
        if duration >= 2 * each[1] or each[1] == 1
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
        shown = values[is_known]
        chart.line(places, shown, series_colour(number), number)
        if len(places) < 3:  # a line through one point is invisible
            chart.markers(places, shown, series_colour(number), series_marker(number), 1.7)
    if len(usable) > 1:
        draw_legend(chart, chart.x.start, y.end - 8, list(usable), [*map(series_colour, range(len(usable)))])
    return Figure(chart.svg())
