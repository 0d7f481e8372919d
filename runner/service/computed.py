"""Responses that take long to compute, for child processes."""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import tempfile
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from http import HTTPStatus
from itertools import islice
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from runner.analysis.axes import AXES, EPISODES, Axis, axes_of, axis_of
from runner.analysis.episodes import EpisodeRef
from runner.analysis.evaluations import training_records
from runner.analysis.frames import Phase, episode_columns, step_columns
from runner.analysis.groups import duplicates, groups_of
from runner.analysis.histograms import histograms
from runner.analysis.panels import Curve, NoMetrics, Panel, panels_of, smoothed
from runner.analysis.series import (
    RunSeries,
    read_series,
    series_of,
)
from runner.archive.places import default_target
from runner.errors import RunnerError
from runner.export.encoder import FORMATS
from runner.export.film import Shot, usual_speed, write_film
from runner.export.pictures import Pictures
from runner.export.plots.curves import curves_sheet, footnote
from runner.export.plots.image import svg_file
from runner.export.plots.style import CurveStyle, style_of, visible
from runner.export.plugin import installed_export
from runner.export.reports.report import render_report
from runner.export.rerun.cache import cached_export
from runner.export.rerun.selection import Request
from runner.export.rerun.viewer import require_rerun
from runner.recording import schema
from runner.recording.reader import open_recording
from runner.runs.run import Run
from runner.service.errors import Refused
from runner.util import humanize
from runner.util.extras import require
from runner.util.values import finite
from runner.views.view import Answer, FileAnswer, Given

MAX_ROWS: Final = 1000
"""The most rows of a query, and the most episodes of a search."""
MAX_FILM_STEPS: Final = 5_000
"""The most steps of a film, as one film is made at a time."""
MAX_NAMES: Final = 10_000
"""The most names of logged values in a response."""
AxisName = Annotated[
    str,
    Field(
        max_length=1000,
        description=f"The horizontal axis: one of {', '.join(AXES)}, or a name of logged values.",
    ),
]
RecordKind = Literal["training", "optimality"]


class FigureOptions(BaseModel, frozen=True):
    """Which metrics are shown, and how."""

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
    """Which curves are shown, and what of them."""

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


def curves(paths: Sequence[Path], options: CurveOptions, lines: bool = False) -> bytes:
    """Return the metrics of runs over an axis as JSON, runs that differ only in the seed as one curve.

    `lines` adds the single runs of a curve.
    """
    series: list[RunSeries] = []
    common: list[Axis] = []
    for path in paths:
        with open_recording(path) as recording:
            own = axes_of(recording)
            common = [each for each in common if each in own] if series else own
            series.append(read_series(recording, axis_of(options.axis), options.metric))
    over = series[0].axis if series else axis_of(options.axis)
    if over not in common and options.axis not in AXES:
        common.append(over)
    groups = groups_of(series)
    panels: list[Panel] = []
    shown: list[ShownCurve] = []
    with contextlib.suppress(NoMetrics):
        for panel in panels_of(groups):
            if not options.metric or panel.metric in options.metric:
                panels.append(panel)
                shown += [_shown_curve(panel, curve, options, lines) for curve in panel.curves]
    most = max((curve.of for curve in shown if curve.thinned), default=0)
    notes = [footnote(groups, panels, options.style), *map(humanize.sentence, duplicates(groups))]
    if most:
        drawn = "the lowest and highest of each stretch are drawn; zoom in for all of them."
        notes.insert(0, f"Thinned: of up to {most:,} points a curve {drawn}")
    result = Curves(
        over.name,
        [AxisInfo(each.name, each.title, each.label) for each in common],
        [CurveGroup(group.label, [run.run_id for run in group.runs], group.left_out) for group in groups],
        shown,
        " ".join(dict.fromkeys(run.averaged for run in series if run.averaged)),
        notes if shown else ["No metrics were recorded."],
        list(dict.fromkeys(name for run in series for name in run.names))[:MAX_NAMES],
    )
    return as_json(result)


def run_histograms(path: Path, axis: str) -> bytes:
    """Return the histograms of a run's training over an axis, as JSON."""
    with open_recording(path) as recording:
        result, notes = histograms(recording, axis_of(axis))
        return as_json({"run_id": recording.run_id, "histograms": result, "notes": notes})


def _shown_curve(panel: Panel, curve: Curve, options: CurveOptions, lines: bool) -> ShownCurve:
    start, stop = options.start, math.inf if options.stop is None else options.stop
    drawn = visible(curve.places, curve.middle, style_of(panel, options.style))
    inside = np.flatnonzero((curve.places >= start) & (curve.places < stop) & drawn)
    chosen = inside[thinned(curve.middle[inside], options.points)]
    memory = max((panel.last if options.stop is None else stop) - start, 0) * options.smooth / 100
    has_band = len(curve.runs) > 1
    return ShownCurve(
        metric=panel.metric,
        line=curve.line,
        group=curve.group,
        title=panel.title,
        unit=panel.unit,
        positions=curve.places[chosen].tolist(),
        values=curve.middle[chosen].tolist(),
        smoothed=smoothed(curve.places, curve.middle, memory)[chosen].tolist() if memory else None,
        low=curve.low[chosen].tolist() if has_band else None,
        high=curve.high[chosen].tolist() if has_band else None,
        runs=curve.runs[:, chosen].tolist() if has_band and lines else [],
        of=len(inside),
        thinned=len(chosen) < len(inside),
    )


def records(path: Path, kind: RecordKind, rows: range, limit: int) -> bytes:
    """Return reports of training or exact measures by their numbers, as JSON."""
    with open_recording(path) as recording:
        if kind == "optimality":
            everything = list(recording.table(schema.OPTIMALITY_TOPIC).decoded())
        else:
            recording.require_job("a report of training", "Its metrics can be had all the same.")
            everything = [each.as_json() for each in training_records(recording)]
        shown = everything[rows.start : rows.stop]
        require_few(len(shown), limit)
        page = {"run_id": recording.run_id, "start": rows.start, "total": len(everything), "records": shown}
        return as_json(page)


def require_few(found: int, limit: int) -> None:
    """Refuse a range of more records than a response may have."""
    if found > limit:
        raise Refused(
            HTTPStatus.UNPROCESSABLE_ENTITY,
            f"query: found a range of {found:,} records, expected at most {limit:,}; request them in parts.",
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


def answer(subject: Path | Sequence[Run], question: Callable[..., Answer], values: Given) -> bytes:
    """Return the answer to a question about a recording or some runs, as --json prints it."""
    with open_recording(subject) if isinstance(subject, Path) else nullcontext(subject) as content:
        return as_json(question(content, **dict(values)).as_json())


def answer_file(path: Path, question: Callable[..., FileAnswer], values: Given) -> bytes:
    """Return the file of the answer to a question about a recording."""
    with open_recording(path) as recording, io.BytesIO() as stream:
        question(recording, **dict(values)).write(stream)
        return stream.getvalue()


def installed_file(path: Path, name: str) -> bytes:
    """Return the file that an export of an installed package makes of a recording."""
    with tempfile.TemporaryDirectory() as folder, open_recording(path) as recording:
        file = Path(folder) / "export"
        installed_export(name).write(recording, file)
        return file.read_bytes()


def report(path: Path) -> bytes:
    """Return the report of a run, a page without links to others."""
    return render_report([path])[0].encode()


def film(path: Path, title: str, step: EpisodeRef, ending: str) -> bytes:
    """Return the film of an episode from a step on, below the title of its run.

    The ending of its file, such as `.mp4`, is its format.
    """
    if ending not in FORMATS:
        raise RunnerError(f"format: found {ending[:20]!r}, expected one of {', '.join(FORMATS)}.")
    with tempfile.TemporaryDirectory() as folder, open_recording(path) as recording:
        file = Path(folder, f"film{ending}")
        shown = step.resolved(recording)
        pictures = Pictures(recording, shown.phase, shown.number_in(recording))
        if shown.t > pictures.steps:
            raise shown.no_step(recording, pictures.steps, shown.t)
        if (steps := pictures.steps - shown.t) > MAX_FILM_STEPS:
            raise RunnerError(
                f"found {steps:,} steps to film, expected at most {MAX_FILM_STEPS:,}: begin at a later step, "
                "or use `dualtaxi export film`, which has no limit."
            )
        shot = Shot(f"{title}: {shown.title}", pictures, shown.t)
        write_film(file, shot, usual_speed(pictures.source), None, lambda _: None)
        return file.read_bytes()


def archive(run: Run, remove: bool) -> bytes:
    """Archive a run as `dualtaxi archive` does; `remove` its recording once the archive was compared."""
    require("pyarrow", extra="archive", purpose="an archive")
    from runner.archive.runs import archive_run

    return as_json(archive_run(run, default_target(run.folder.parent), remove).as_json())


def arrow(path: Path, table: str, phase: Phase, rows: range) -> bytes:
    """Return the columns of steps or episodes by their numbers as an Arrow stream."""
    require("pyarrow", extra="archive", purpose="Arrow")
    import pyarrow as pa

    with open_recording(path) as recording:
        if table == "steps":
            columns = step_columns(recording, phase, start=rows.start, stop=rows.stop)
        else:
            columns = episode_columns(recording, phase, rows.start, rows.stop)
    arrays = {
        name: pa.array(values if values.ndim == 1 else values.tolist()) for name, values in columns.items()
    }
    whole = pa.table(arrays)
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, whole.schema) as writer:
        writer.write_table(whole)
    return bytes(sink.getvalue())


def plot(paths: Sequence[Path], options: FigureOptions) -> bytes:
    """Return metrics of runs over an axis in one figure, as SVG."""
    metrics = options.metric
    groups = groups_of(series_of(paths, axis_of(options.axis), metrics))
    panels = [panel for panel in panels_of(groups) if not metrics or panel.metric in metrics]
    if not panels:
        raise RunnerError(f"metric: found {', '.join(metrics)[:200]}, expected metrics that a run recorded.")
    return svg_file(curves_sheet(groups, panels, options.style))


def replay(runs: Sequence[Run], request: Request) -> bytes:
    """Return the path of an export for the Rerun viewer, from the user's cache or new."""
    require_rerun("a replay")
    return os.fsencode(cached_export(runs, request)[0])


def query(roots: tuple[Path, ...], text: str, runs: str) -> bytes:
    """Return the first rows of a query in SQL, as JSON."""
    require("pyarrow", extra="sql", purpose="SQL")
    from runner.query.sql import sql

    result = sql(text, recordings=roots, runs=runs)
    with contextlib.closing(result.rows()) as rows:
        first = list(islice(rows, MAX_ROWS + 1))
    return as_json(
        {
            "columns": result.columns.names,
            "rows": first[:MAX_ROWS],
            "more": len(first) > MAX_ROWS,
            "left_out": result.left_out,
        }
    )


def find(roots: tuple[Path, ...], expression: str, runs: str, phase: str, sort: str, limit: int) -> bytes:
    """Return the episodes that match an expression, as `dualtaxi find --json` prints them."""
    require("pyarrow", extra="sql", purpose="`find`")
    from runner.query import find

    found = find.find(expression, roots, runs=runs, phase=phase or None, sort=sort, limit=limit or MAX_ROWS)
    return as_json(found.as_json())


def as_json(value: object) -> bytes:
    """Return a value as JSON; NaN and infinity become null."""
    return json.dumps(finite(value), allow_nan=False, ensure_ascii=False).encode(errors="replace")
