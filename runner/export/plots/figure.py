"""Panels drawn with Matplotlib as one figure for print; `svg_charts` draws those of pages.

Groups of runs differ in colour and marker, agents in the kind of line, so that nothing is told by colour
alone; the colours are those of Okabe and Ito. Percent goes from 0 to 100, and what cannot be negative
begins at zero.
"""

from __future__ import annotations

import io
import math
import re
import textwrap
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from runner.analysis.groups import Group
from runner.analysis.series import is_loop, values_left_out
from runner.drawing import palette
from runner.environments.naming import spoken
from runner.errors import RunnerError
from runner.export.plots.metrics import Curve, Panel
from runner.recording.metrics import SHARES
from runner.util.extras import require

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SUFFIXES: Final = (".png", ".svg", ".pdf")

MARKERS: Final = ("o", "s", "^", "D", "v", "P", "X")
DASHES: Final = ("-", (0, (4, 1.5)), (0, (1, 1.2)), (0, (5, 1, 1, 1)))
_PANEL: Final = 2.3
_LEFT: Final = 0.68
_RIGHT: Final = 0.14
_ABOVE: Final = 0.44
_BELOW: Final = 0.48
"""Height of a panel with its texts, and the room for them around its axes, in inches."""
_LETTERS_AN_INCH: Final = 17
"""Letters of a footnote that fit on an inch."""
_BAND_OPACITY: Final = 0.2
STYLE: Final = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 8.5,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titley": 1.0,  # else every title is placed by measuring all that is drawn
    "axes.labelsize": 8.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": palette.INK,
    "axes.labelcolor": palette.INK,
    "text.color": palette.INK,
    "xtick.color": palette.INK,
    "ytick.color": palette.INK,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.fontsize": 7.5,
    "legend.frameon": False,
    "lines.linewidth": 1.5,
    "grid.linewidth": 0.5,
    "grid.color": palette.INK,
    "grid.alpha": 0.15,
    "svg.fonttype": "none",
    "svg.hashsalt": "dualtaxi",
    "pdf.fonttype": 42,
    "savefig.dpi": 160,
}


def matplotlib_of(purpose: str) -> Any:
    """Return the module `matplotlib`.

    Raises:
        MissingExtra: it is not installed.
    """
    modules = ("matplotlib", "matplotlib.figure", "matplotlib.layout_engine", "matplotlib.ticker")
    return require(*modules, extra="plots", purpose=purpose)


def check_suffix(path: Path) -> None:
    """Refuse a file that no figure can be written to.

    Raises:
        RunnerError: its suffix is none of `SUFFIXES`.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise RunnerError(f"{path}: found the ending {path.suffix!r}, expected one of {', '.join(SUFFIXES)}.")


def save_figure(path: Path, groups: Sequence[Group], panels: Sequence[Panel]) -> None:
    """Write one figure of all panels, as the path's suffix says.

    Raises:
        MissingExtra: Matplotlib is not installed.
        OSError: the file cannot be written.
    """
    mpl = matplotlib_of("a plot")
    stamp = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}.get(path.suffix.lower(), {})
    with mpl.rc_context(STYLE):
        draw_figure(groups, panels).savefig(path, metadata=stamp)


def draw_figure(groups: Sequence[Group], panels: Sequence[Panel]) -> Figure:
    """Return the figure of all panels, three beside each other, with a legend of the groups above."""
    mpl = matplotlib_of("a plot")
    columns = min(3, len(panels))
    narrow = [panel for panel in panels if not is_wide(panel)]
    wide = [panel for panel in panels if is_wide(panel)]
    rows = math.ceil(len(narrow) / columns) + len(wide)
    width = max(3.4 * columns, 6.8)
    notes = textwrap.wrap(footnote(groups), round(width * _LETTERS_AN_INCH))
    head, foot = 0.55 + 0.19 * len(groups), 0.08 + 0.14 * len(notes)
    height = head + _PANEL * rows + foot
    with mpl.rc_context(STYLE):
        figure: Figure = mpl.figure.Figure(figsize=(width, height))
        # The places are computed here: a layout engine would draw everything once more to find them.
        grid = figure.add_gridspec(
            rows,
            columns,
            left=_LEFT / width,
            right=1 - _RIGHT / width,
            bottom=(foot + _BELOW) / height,
            top=1 - (head + _ABOVE) / height,
            wspace=(_LEFT + _RIGHT) / (width / columns - _LEFT - _RIGHT),
            hspace=(_ABOVE + _BELOW) / (_PANEL - _ABOVE - _BELOW),
        )
        for number, panel in enumerate(narrow):
            draw_panel(figure.add_subplot(grid[divmod(number, columns)]), panel, len(groups))
        for number, panel in enumerate(wide):  # the last column is for its legend
            place = grid[rows - len(wide) + number, : max(columns - 1, 1)]
            draw_panel(figure.add_subplot(place), panel, len(groups))
        _heading(figure, groups, height)
        figure.text(0.01, 0.06 / height, "\n".join(notes), fontsize=7.5, va="bottom")
    return figure


def is_wide(panel: Panel) -> bool:
    """Return whether a panel takes all the room beside it: it has a legend of many lines."""
    return panel.metric == SHARES


def draw_panel(axes: Axes, panel: Panel, groups: int) -> None:
    """Draw a panel on axes."""
    if panel.metric == SHARES:
        _draw_shares(axes, panel)
    else:
        for curve in panel.curves:
            _draw_curve(axes, panel, curve, groups)
        _legend(axes, panel, groups)
    axes.set_title(panel.title, pad=18 if _has_legend(panel) else 6)
    axes.set_ylabel(panel.unit)
    axes.set_xlabel("training episodes")
    axes.grid(visible=True)
    axes.set_axisbelow(True)
    _honest_axes(axes, panel)


def footnote(groups: Sequence[Group]) -> str:
    """Return what lines and bands mean, and which values are not drawn."""
    runs = [run for group in groups for run in group.runs]
    left_out = "".join(f" {sentence}" for sentence in values_left_out(runs))
    loops = any(is_loop(run) for run in runs)
    greedy = "" if loops else " Evaluation trials follow the greedy policy: no exploring."
    if max(len(group.runs) for group in groups) == 1:
        return f"Each line is one run, as reported.{greedy}{left_out}"
    between = " Between its points a run is interpolated." if loops else ""
    return (
        "Lines: median over the runs of a configuration that have come as far; bands: from the lowest run to "
        f"the highest.{between}{greedy}{left_out}"
    )


def _draw_curve(axes: Axes, panel: Panel, curve: Curve, groups: int) -> None:
    line = panel.lines.index(curve.line)
    by_line = groups == 1 and len(panel.lines) > 1
    colour = palette.SERIES[(line if by_line else curve.group) % len(palette.SERIES)]
    marker = _marker(line if by_line else curve.group)
    axes.plot(
        curve.episodes,
        curve.median,
        color=colour,
        linestyle=DASHES[line % len(DASHES)],
        marker=marker,
        markersize=3.2,
        markevery=max(len(curve.episodes) // 8, 1),
        label=curve.line,
    )
    if (curve.high > curve.low).any():
        axes.fill_between(
            curve.episodes, curve.low, curve.high, color=colour, alpha=_BAND_OPACITY, linewidth=0
        )


def _marker(number: int) -> str:
    """Return the marker of a line; one that has the colour of an earlier line has another marker."""
    return MARKERS[(number + number // len(palette.SERIES)) % len(MARKERS)]


def _draw_shares(axes: Axes, panel: Panel) -> None:
    """Draw shares of a whole on top of each other, the lowest reward darkest and at the bottom."""
    from matplotlib import colormaps

    colours = colormaps["cividis"](np.linspace(0, 1, len(panel.curves)))
    bottom = np.zeros_like(panel.curves[0].median)
    for curve, colour in zip(panel.curves, colours, strict=True):
        top = bottom + np.interp(panel.curves[0].episodes, curve.episodes, curve.median)
        axes.fill_between(
            panel.curves[0].episodes,
            bottom,
            top,
            color=colour,
            linewidth=0.3,
            edgecolor="white",
            label=curve.line,
        )
        bottom = top
    legend = axes.legend(
        title="reward of a step",
        reverse=True,
        loc="center left",
        bbox_to_anchor=(1.01, 0.5),
        ncols=2 if len(panel.curves) > 8 else 1,
    )
    legend.set_in_layout(False)


def _honest_axes(axes: Axes, panel: Panel) -> None:
    """Begin at zero what cannot be negative, end percent at 100, and mark zero elsewhere."""
    from matplotlib.ticker import MaxNLocator

    axes.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10], integer=True))
    axes.xaxis.set_major_formatter(number_on_axis)
    largest = max(float(np.abs([curve.low, curve.high]).max()) for curve in panel.curves)
    axes.yaxis.set_major_formatter(_thousands if largest >= 10_000 else number_on_axis)
    axes.set_xlim(left=0)
    if panel.percent:
        axes.set_ylim(0, 100 if panel.metric == SHARES else 103)
        axes.set_yticks(range(0, 101, 20))
        return
    axes.yaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    if panel.at_least_zero:
        top = max(float(np.max(curve.high)) for curve in panel.curves)
        axes.set_ylim(0, top * 1.06 or 1.0)
    else:
        axes.axhline(0, color=palette.INK, linewidth=0.6)


def number_on_axis(value: float, _: object = None) -> str:
    """Return a number as an axis shows it: `20,000`, `0.5`, `2.5M`."""
    text = f"{value:,.0f}" if abs(value) >= 1000 else f"{value:g}"
    if abs(value) >= 1e6:
        text = f"{value / 1e6:g}M"
    return text.replace("-", "\N{MINUS SIGN}")


def _thousands(value: float, _: object = None) -> str:
    """Return a large number where there is little room: `20k`."""
    return f"{number_on_axis(value / 1e3)}k" if 0 < abs(value) < 1e6 else number_on_axis(value)


def _has_legend(panel: Panel) -> bool:
    return len(panel.lines) > 1 and panel.metric != SHARES


def _legend(axes: Axes, panel: Panel, groups: int) -> None:
    """Name the lines of a panel, above it, where it has several; groups are named once for all panels."""
    from matplotlib.lines import Line2D

    if not _has_legend(panel):
        return
    handles = [
        Line2D(
            [],
            [],
            color=palette.SERIES[number % len(palette.SERIES)] if groups == 1 else palette.INK,
            linestyle=DASHES[number % len(DASHES)],
            marker=_marker(number) if groups == 1 else "",
            markersize=3.2,
            label=spoken(line) or "all",
        )
        for number, line in enumerate(panel.lines)
    ]
    axes.legend(
        handles=handles,
        loc="lower left",
        bbox_to_anchor=(-0.02, 0.985),
        ncols=len(handles),
        handlelength=2.2,
        columnspacing=1.2,
        borderaxespad=0.1,
    )


def _heading(figure: Figure, groups: Sequence[Group], height: float) -> None:
    """Write above the panels which colour is which runs."""
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=palette.SERIES[i % len(palette.SERIES)], marker=_marker(i), markersize=4)
        for i in range(len(groups))
    ]
    figure.text(
        0.01, 1 - 0.1 / height, "Metrics over training episodes", fontsize=13, weight="bold", va="top"
    )
    figure.legend(
        handles,
        [group.described for group in groups],
        loc="upper left",
        bbox_to_anchor=(0.0, 1 - 0.35 / height),
        fontsize=8.5,
        borderaxespad=0.2,
    )


def svg_for_page(figure: Figure, name: str, title: str) -> str:
    """Return a figure as an `<svg>` element alone, its ink that of the page; call it where `STYLE` is set.

    Args:
        figure: what is shown.
        name: set before its ids, so that they are the page's only ones.
        title: what readers of the page hear.
    """
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    element = buffer.getvalue()
    element = element[element.index("<svg") :]
    element = re.sub(r"<metadata>.*?</metadata>", "", element, flags=re.DOTALL)
    element = element.replace(palette.INK, "currentColor")
    for number, colour in enumerate(palette.SERIES):  # the page has lighter ones for the dark
        element = element.replace(colour.lower(), f"var(--line-{number}, {colour})")
    element = re.sub(r' width="[\d.]+pt" height="[\d.]+pt"', "", element, count=1)
    name = re.sub(r"\W+", "-", name)
    element = re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>{name}-", element)
    element = re.sub(r"\s*\n\s*", " ", element)
    return element.replace("<svg ", f'<svg role="img" aria-label="{escape(title)}" ', 1)
