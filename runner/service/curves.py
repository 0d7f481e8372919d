"""Curves of metrics of runs, for child processes: as JSON for charts, and drawn in one figure."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from runner.analysis.axes import AXES, EPISODES, Axis, axes_of, axis_of
from runner.analysis.groups import Curve, Group, NoMetrics, Panel, duplicates, groups_of, panels_of, smoothed
from runner.analysis.series import RunSeries, read_series, series_of, values_left_out
from runner.environments.naming import spoken
from runner.errors import RunnerError
from runner.export.plots.chart import svg_file
from runner.export.plots.comparisons import letter
from runner.export.plots.curves import CurveStyle, curves_sheet, footnote, not_drawn, style_of, visible
from runner.recording.reader import open_recording
from runner.service.computed import as_json
from runner.util import humanize
from runner.util.row_text import csv_lines
from runner.util.values import finite

MAX_NAMES: Final = 10_000
"""The most names of logged values in a response."""
MAX_AXES: Final = 200
"""The most axes to choose from."""
AxisName = Annotated[
    str,
    Field(
        max_length=1000,
        description=f"The horizontal axis: one of {', '.join(AXES)}, or a name of logged values.",
    ),
]


class FigureOptions(BaseModel, frozen=True):
    """Metrics, and how they are drawn."""

    metric: tuple[str, ...] = Field(
        (),
        max_length=100,
        description="Default: all, with the first 64 names of logged values; `training.logged.NAME` for any.",
    )
    axis: AxisName = EPISODES.name
    smooth: float = Field(
        0,
        ge=0,
        le=100,
        allow_inf_nan=False,
        description="Memory of an exponential mean, in percent of the axis from start to stop; 0: none.",
    )
    log_x: bool = Field(False, description="A logarithmic horizontal axis, without points at 0.")
    log_y: bool = Field(False, description="Logarithmic vertical axes, without points at 0 or below.")

    @property
    def style(self) -> CurveStyle:
        """How the curves are drawn."""
        return CurveStyle(smooth=self.smooth, log_x=self.log_x, log_y=self.log_y)


class CurveOptions(FigureOptions, frozen=True):
    """Metrics, axis and range of curves."""

    start: float = Field(0, ge=0, allow_inf_nan=False, description="The first position.")
    stop: float | None = Field(
        None, ge=0, allow_inf_nan=False, description="The first position not included."
    )
    points: int = Field(0, ge=0, le=100_000, description="Maximum of a curve; 0: all.")


@dataclass(frozen=True)
class ShownCurve:
    """A metric of a group of runs over an axis; what is not finite is null."""

    metric: str
    line: str
    """An agent or a reward; empty if the metric has one line only."""
    group: int
    """Number of its group."""
    title: str
    unit: str
    label: str
    """Its name in a key: its group, if there are several runs, and its line, if there are several."""
    colour: int
    """Number of its colour among those of lines."""
    dash: int
    """Number of its line, and so of its dashes."""
    summary: str
    """What it shows between `start` and `stop`, in words."""
    positions: list[float]
    values: list[float | None]
    """The interquartile mean over several runs; below four runs, their mean."""
    smoothed: list[float | None] | None
    """The exponential mean of the values, if it was requested."""
    low: list[float | None] | None
    """The lower end of the 95 % interval over several runs; below four runs, the lowest."""
    high: list[float | None] | None
    runs: list[list[float | None]]
    """The values of each run of the group, if they were requested."""
    run_labels: list[str]
    """The names of these runs in a key."""
    of: int
    """The number of points between `start` and `stop` that the axes can show."""
    thinned: bool
    """Whether only the lowest and the highest point of each section are included."""


@dataclass(frozen=True)
class AxisInfo:
    """An axis that all of the runs have."""

    name: str
    title: str
    label: str


@dataclass(frozen=True)
class CurveGroup:
    """Runs that differ in nothing but the seed."""

    label: str
    runs: list[str]
    left_out: Sequence[str]
    """Runs that repeat one of these."""


@dataclass(frozen=True)
class Curves:
    """The metrics of runs."""

    axis: str
    axes: list[AxisInfo]
    groups: list[CurveGroup]
    curves: list[ShownCurve]
    averaged: str
    """What the values of loops are means over; empty if every recorded point is there."""
    notes: list[str]
    """What is drawn, and what is left out."""
    names: list[str]
    """Names of logged values, the first 10,000, of which `training.logged.NAME` is a metric."""


def curves_of(
    paths: Sequence[Path], options: CurveOptions, lines: bool = False, table: bool = False
) -> bytes:
    """Return the metrics of runs over an axis as JSON, runs that differ only in the seed as one curve.

    `lines` adds the single runs of a curve. With `table`, the curves are the columns of a CSV file.
    """
    series: list[RunSeries] = []
    common: list[Axis] = []
    for path in paths:
        with open_recording(path) as recording:
            axes = axes_of(recording)
            common = [axis for axis in common if axis in axes] if series else axes
            series.append(read_series(recording, axis_of(options.axis), options.metric))
    over = series[0].axis if series else axis_of(options.axis)
    offered = common[:MAX_AXES]
    if over not in offered:
        offered.append(over)
    logged = list(dict.fromkeys(name for run in series for name in run.names))[:MAX_NAMES]
    groups = groups_of(series)
    names = {run.run_id: (letter(number), run.name) for number, run in enumerate(series)}
    panels: list[Panel] = []
    curves: list[ShownCurve] = []
    with contextlib.suppress(NoMetrics):
        for panel in panels_of(groups):
            if not options.metric or panel.metric in options.metric:
                panels.append(panel)
                curves += [
                    _shown_curve(panel, curve, options, lines, groups, names) for curve in panel.curves
                ]
    if table:
        return "".join(csv_lines(*_columns(over.name, curves))).encode()
    most = max((curve.of for curve in curves if curve.thinned), default=0)
    notes = [footnote(groups, panels, options.style), *map(humanize.sentence, duplicates(groups))]
    averaged = " ".join(dict.fromkeys(run.averaged for run in series if run.averaged))
    if most:
        drawn = "the lowest and highest of each stretch are drawn; zoom in for all of them."
        notes.insert(0, f"Thinned: of up to {most:,} points a curve {drawn}")
    elif not any((averaged, *values_left_out(series), not_drawn(panels, options.style))) and all(
        len(group.runs) == 1 for group in groups
    ):
        notes.insert(0, "Every recorded point is drawn.")
    result = Curves(
        over.name,
        [AxisInfo(axis.name, axis.title, axis.label) for axis in offered],
        [CurveGroup(group.label, [run.run_id for run in group.runs], group.left_out) for group in groups],
        curves,
        averaged,
        notes if curves else ["No metrics were recorded."],
        logged,
    )
    return as_json(result)


def figure_of(paths: Sequence[Path], options: FigureOptions) -> bytes:
    """Return metrics of runs over an axis in one figure, as SVG."""
    metrics = options.metric
    groups = groups_of(series_of(paths, axis_of(options.axis), metrics))
    panels = [panel for panel in panels_of(groups) if not metrics or panel.metric in metrics]
    if not panels:
        raise RunnerError(f"metric: found {', '.join(metrics)[:200]}, expected metrics that a run recorded.")
    return svg_file(curves_sheet(groups, panels, options.style))


def _columns(axis: str, curves: Sequence[ShownCurve]) -> tuple[list[str], Iterator[list[object]]]:
    """Return the headings and the rows of a table with the axis, and each curve with its band and runs."""
    has_several = len({curve.metric for curve in curves}) > 1
    columns = [
        (f"{curve.title}: {name}" if has_several else name, dict(zip(curve.positions, values, strict=True)))
        for curve in curves
        for name, values in (
            (f"{curve.label}, high", curve.high),
            (f"{curve.label}, low", curve.low),
            *zip(curve.run_labels, curve.runs, strict=True),
            (curve.label, curve.values),
        )
        if values is not None
    ]
    positions = sorted({position for curve in curves for position in curve.positions})
    rows = ([at, *(finite(values.get(at)) for _, values in columns)] for at in positions)
    return [axis, *(name for name, _ in columns)], rows


def _shown_curve(
    panel: Panel,
    curve: Curve,
    options: CurveOptions,
    lines: bool,
    groups: Sequence[Group],
    names: Mapping[str, tuple[str, str]],
) -> ShownCurve:
    start, stop = options.start, math.inf if options.stop is None else options.stop
    is_visible = visible(curve.places, curve.middle, style_of(panel, options.style))
    inside = np.flatnonzero((curve.places >= start) & (curve.places < stop) & is_visible)
    drawn = inside[thinned(curve.middle[inside], options.points)]
    memory = max((panel.last if options.stop is None else stop) - start, 0) * options.smooth / 100
    has_band = len(curve.runs) > 1
    group, number = groups[curve.group], panel.lines.index(curve.line)
    line = [spoken(curve.line)] if len(panel.lines) > 1 and curve.line else []
    letters = ", ".join(names[run.run_id][0] for run in group.runs)
    many = len(group.runs) > 5
    of = f"{group.label}, {len(group.runs)} runs" if many else f"{letters}: {group.label}"
    label = ", ".join([of, *line] if len(names) > 1 else line) or panel.title
    ends = (
        [curve.middle[inside[-1]], curve.middle[inside].min(), curve.middle[inside].max()]
        if len(inside)
        else []
    )
    return ShownCurve(
        metric=panel.metric,
        line=curve.line,
        group=curve.group,
        title=panel.title,
        unit=panel.unit,
        label=label,
        colour=curve.group if len(groups) > 1 else number,
        dash=number,
        summary="{} ends at {}, between {} and {}".format(label, *map(humanize.measure, ends))
        if ends
        else f"{label} has no point in this part",
        positions=curve.places[drawn].tolist(),
        values=curve.middle[drawn].tolist(),
        smoothed=smoothed(curve.places, curve.middle, memory)[drawn].tolist() if memory else None,
        low=curve.low[drawn].tolist() if has_band else None,
        high=curve.high[drawn].tolist() if has_band else None,
        runs=curve.runs[:, drawn].tolist() if has_band and lines else [],
        run_labels=[", ".join([": ".join(names[run]), *line]) for run in curve.ids if has_band and lines],
        of=len(inside),
        thinned=len(drawn) < len(inside),
    )


def thinned(values: NDArray[np.float64], points: int) -> NDArray[np.intp]:
    """Return the indices of the lowest and the highest value of each section, so that no extreme is lost.

    The values are float64 [n]; `points` is the maximum number of indices, 0 for all.
    """
    if points == 0 or len(values) <= points:
        return np.arange(len(values))
    sections = np.array_split(np.arange(len(values)), max(points // 2, 1))
    comparable = np.where(np.isnan(values), np.inf, values)
    lowest = [part[np.argmin(comparable[part])] for part in sections]
    comparable = np.where(np.isnan(values), -np.inf, values)
    highest = [part[np.argmax(comparable[part])] for part in sections]
    return np.unique([*lowest, *highest])
