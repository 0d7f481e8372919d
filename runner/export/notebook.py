"""Runs in a notebook: the report of a run, plots of several, and the Rerun viewer inline.

    import runner
    from runner.export.notebook import rerun_view

    run = runner.run("quick")
    run                       # summary, replay, plots and maps
    runner.plot(run, other)   # the learning curves of both
    rerun_view(run)           # the Rerun viewer, where rerun-notebook is installed

Everything is read from the recordings.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Final

from runner.errors import MissingExtra
from runner.runs.run import Run
from runner.util.extras import require

HEIGHT: Final = 760
"""Height of a report in pixels; it scrolls inside."""

_FRAME_STYLE: Final = """<style>
.picture { display: flex; flex-direction: column; }
.picture svg { max-height: 19rem; }
.scrub { order: -1; margin: 0 0 .6rem; }
</style>
"""
"""The slider goes above a smaller picture, so that both are visible without scrolling inside the frame."""


@dataclass(frozen=True)
class Html:
    """HTML that a notebook displays."""

    html: str = field(repr=False)

    def _repr_html_(self) -> str:
        return self.html


@dataclass(frozen=True)
class Picture:
    """A PNG that a notebook displays."""

    png: bytes = field(repr=False)

    def _repr_png_(self) -> bytes:
        return self.png


def register_formatters() -> None:
    """Make IPython display each `Run` as its report; without a running shell, do nothing."""
    from IPython import get_ipython

    shell = get_ipython()
    if shell is not None:
        shell.display_formatter.formatters["text/html"].for_type(Run, run_html)


def run_html(run: Run) -> str:
    """Return the result of a run as a sentence, and its report in a frame; facts if packages are missing."""
    if not run.recording.is_file():
        return facts_html(run)
    try:
        return _result_html(run) + report(run).html
    except MissingExtra as error:
        return facts_html(run) + f"<p>{escape(str(error))}</p>"


def report(
    *runs: Run,
    axis: str = "episodes",
    lines: bool = False,
    smooth: float = 0,
    log_x: bool = False,
    log_y: bool = False,
    height: int = HEIGHT,
) -> Html:
    """Return the report of runs (summary, replay, plots, maps) in a frame of its own.

    Args:
        runs: the runs.
        axis: of the plots; it and how curves are drawn are as for `plot`.
        lines: as for `plot`.
        smooth: as for `plot`.
        log_x: as for `plot`.
        log_y: as for `plot`.
        height: in pixels.

    Raises:
        MissingExtra: Jinja2 is not installed.
        RecordingError: a recording cannot be read, or does not have the axis.
        RunnerError: there is no such axis, or smooth is not from 0 to 100.
    """
    from runner.analysis.axes import axis_of
    from runner.archive.places import at_hand
    from runner.export.plots.curves import CurveStyle
    from runner.export.reports.rendering import framed
    from runner.export.reports.report import render_report

    paths = [at_hand(run).recording for run in runs]
    style = CurveStyle(lines, smooth, log_x, log_y)
    page, _ = render_report(paths, axis=axis_of(axis), style=style)
    page = page.replace("</head>", f"{_FRAME_STYLE}</head>", 1)
    title = ", ".join(f"{run.name}, run {run.run_id}" for run in runs)
    return Html(framed(title, page, height, sandbox="allow-scripts"))


def plot(
    *runs: Run,
    axis: str = "episodes",
    lines: bool = False,
    smooth: float = 0,
    log_x: bool = False,
    log_y: bool = False,
) -> Picture:
    """Return the learning curves of runs as one picture, as `dualtaxi plot` draws them.

    Args:
        runs: the runs; those that differ in nothing but the seed are one line with a band.
        axis: `episodes`, `steps`, `updates` or `time`.
        lines: draw each run as a thin line too.
        smooth: draw exponential means with this memory, in percent of the axis, 0 to 100; 0 for none.
        log_x: draw a logarithmic horizontal axis.
        log_y: draw logarithmic vertical axes.

    Raises:
        MissingExtra: Matplotlib is not installed.
        RecordingError: a recording cannot be read, or does not have the axis.
        RunnerError: there is no such axis, or smooth is not from 0 to 100.
    """
    from runner.analysis.axes import axis_of
    from runner.analysis.groups import groups_of, panels_of
    from runner.analysis.series import series_of
    from runner.archive.places import at_hand
    from runner.export.plots.chart import write_image
    from runner.export.plots.curves import CurveStyle, curves_sheet

    style = CurveStyle(lines, smooth, log_x, log_y)
    over = axis_of(axis)
    series = series_of((at_hand(run).recording for run in runs), over)
    groups = groups_of(series)
    buffer = io.BytesIO()
    write_image(curves_sheet(groups, panels_of(groups), style), buffer, "png", dpi=110)
    return Picture(buffer.getvalue())


def rerun_view(
    *runs: Run,
    episodes: Sequence[tuple[int, int | None]] = (),
    evaluations: Sequence[int] = (),
    width: int = 1000,
    height: int = 640,
) -> object:
    """Return the Rerun viewer with runs in it, as a widget.

    Args:
        runs: the runs.
        episodes: ranges of training episodes (start, stop), by default a selection.
        evaluations: the number of training episodes before each evaluation to show.
        width: in pixels.
        height: in pixels.

    Raises:
        MissingExtra: rerun-notebook is not installed.
        RecordingError: a recording cannot be read, or does not have these episodes.
    """
    notebook = require("rerun_notebook", extra="notebook", purpose="the Rerun viewer in a notebook")
    from runner.export.rerun.selection import Request
    from runner.export.rerun.viewer import cached_export

    path, _ = cached_export(runs, Request(episodes=tuple(episodes), evaluations=tuple(evaluations)))
    viewer = notebook.Viewer(width=width, height=height)
    viewer.send_rrd(path.read_bytes())
    return viewer


def _result_html(run: Run) -> str:
    """Return the last evaluation of a run as a sentence, for programs that do not display frames."""
    last = run.summary.last_evaluation
    if last is None:
        return f"<p><b>{escape(run.title)}</b></p>"
    percent, length = (last.values.get(name) for name in ("success_percent", "mean_length"))
    success = "" if percent is None else f"{percent:.1f} % of trials succeed, "
    steps = "" if length is None else f"{length:,.1f} steps on average"
    return f"<p><b>{escape(run.title)}</b>, last evaluation: {success}{steps}.</p>"


def facts_html(run: Run) -> str:
    """Return all about a run as `dualtaxi show` prints it."""
    from runner.analysis.sections import html
    from runner.analysis.summary import describe_run

    return html(describe_run(run, with_results=False).sections())
