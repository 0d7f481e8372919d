"""The plots of a sweep as one figure for print, drawn with Matplotlib."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.analysis.groups import Group
from runner.drawing import palette
from runner.export.plots.figure import (
    STYLE,
    draw_panel,
    matplotlib_of,
    number_on_axis,
)
from runner.export.plots.metrics import Panel
from runner.sweep.plots import Axis, Picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Values = NDArray[np.float64]
BEST: Final = palette.SERIES[1]
_CHARACTERS: Final = 110
"""Of a line above or below the figure."""


def save_figure(path: Path, title: str, picture: Picture, groups: Sequence[Group], panel: Panel) -> None:
    """Write one figure: the objective along each parameter, parallel coordinates, and learning curves.

    Args:
        path: where to, as its suffix says.
        title: above it.
        picture: of the trials.
        groups: the runs whose curves are drawn.
        panel: their metric.

    Raises:
        MissingExtra: Matplotlib is not installed.
        OSError: the file cannot be written.
    """
    mpl = matplotlib_of("a plot")
    columns = 2 if len(picture.axes) in (2, 4) else min(3, len(picture.axes))
    rows = math.ceil(len(picture.axes) / columns)
    told = [
        (line, palette.SERIES[number])
        for number, group in enumerate(groups)
        for line in textwrap.wrap(group.label, _CHARACTERS, subsequent_indent="    ")
    ]
    head, foot = 0.45, 0.25 + 0.16 * (len(told) + 1)
    height = head + 2.3 * rows + 2.9 + 2.5 + foot
    with mpl.rc_context(STYLE):
        room = (0, foot / height, 1, 1 - (head + foot) / height)
        figure = mpl.figure.Figure(
            figsize=(10.2, height),
            layout=mpl.layout_engine.ConstrainedLayoutEngine(rect=room, h_pad=0.08, w_pad=0.08),
        )
        grid = figure.add_gridspec(rows + 2, columns, height_ratios=[2.3] * rows + [2.9, 2.5])
        for number, axis in enumerate(picture.axes):
            draw_parameter(figure.add_subplot(grid[divmod(number, columns)]), picture, axis)
        draw_parallel(figure.add_subplot(grid[rows, :]), picture)
        draw_panel(figure.add_subplot(grid[rows + 1, :]), panel, len(groups))
        figure.text(0.01, 1 - 0.1 / height, title, fontsize=13, weight="bold", va="top")
        for number, (line, colour) in enumerate([(picture.footnote, palette.INK), *told]):
            y = (foot - 0.12 - 0.16 * number) / height
            figure.text(0.01, y, line, color=colour, fontsize=7.5, va="top")
        stamp = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}.get(path.suffix.lower(), {})
        figure.savefig(path, metadata=stamp)


def draw_parameter(axes: Axes, picture: Picture, axis: Axis) -> None:
    """Draw the objective of the trials against one of their parameters, the best one in another colour.

    Trials that were given up are hollow.
    """
    from matplotlib.ticker import NullFormatter

    values = np.array(picture.values)
    x = np.array(axis.values)
    for place, (low, high) in zip(axis.values, picture.ranges, strict=True):
        axes.plot([place, place], [low, high], color=palette.SERIES[0], linewidth=0.8, alpha=0.25)
    kept = np.array([trial.state == "finished" for trial in picture.trials[1:]], dtype=np.bool_)
    dots: dict[str, Any] = {"color": palette.SERIES[0], "markersize": 3.5, "alpha": 0.6, "linestyle": ""}
    axes.plot(x[1:][kept], values[1:][kept], "o", markeredgewidth=0, **dots)
    axes.plot(x[1:][~kept], values[1:][~kept], "o", fillstyle="none", **dots)
    axes.plot(x[:1], values[:1], "D", color=BEST, markersize=6, label="best")
    if axis.choices:
        axes.set_xticks(range(len(axis.choices)), [textwrap.shorten(choice, 24) for choice in axis.choices])
        if sum(map(len, axis.choices)) > 28:
            axes.tick_params(axis="x", labelrotation=20)
        axes.set_xlim(-0.5, len(axis.choices) - 0.5)
    else:
        if axis.log:
            axes.set_xscale("log")
            crowded = x.max() > 10 * x.min()
            axes.xaxis.set_minor_formatter(NullFormatter() if crowded else number_on_axis)
        axes.xaxis.set_major_formatter(number_on_axis)
    _objective_axis(axes, picture)
    axes.set_title(axis.path)
    axes.grid(visible=True)
    axes.set_axisbelow(True)


def draw_parallel(axes: Axes, picture: Picture) -> None:
    """Draw each trial as a line over all parameters to its objective, coloured by its place among them."""
    from matplotlib import colormaps

    columns = [_unit(np.array(axis.values), axis.log, axis.choices) for axis in picture.axes]
    columns.append(_unit(np.array(picture.values), picture.log, ()))
    lines = np.array(columns).T
    colours = colormaps["cividis"](np.linspace(0.0, 1.0, len(lines)))
    for line, colour in reversed(list(zip(lines, colours, strict=True))):
        axes.plot(line, color=colour, linewidth=0.9, alpha=0.7)
    axes.plot(lines[0], color=BEST, linewidth=2.2)
    for column in range(len(columns)):
        axes.axvline(column, color=palette.INK, linewidth=0.7)
    for column, axis in enumerate(picture.axes):
        _label_column(axes, column, axis.values, axis.log, axis.choices)
    _label_column(axes, len(columns) - 1, picture.values, picture.log, ())
    names = [*(axis.path for axis in picture.axes), picture.objective]
    axes.set_xticks(range(len(names)), [_folded(name) for name in names])
    axes.set_yticks([])
    axes.set_ylim(-0.05, 1.05)
    axes.set_xlim(-0.1, len(columns) - 0.75)
    axes.spines[["left", "bottom"]].set_visible(False)
    axes.tick_params(axis="x", length=0)
    axes.set_title("Each trial a line, the best one thick; dark lines are better than light ones")


def _folded(name: str) -> str:
    """Return a name over several lines if it is long, broken where its parts end."""
    return re.sub(r"([.,]|_(?=\w{8}))\s*", r"\1\n", name) if len(name) > 24 else name


def _unit(values: Values, log: bool, choices: tuple[str, ...]) -> Values:
    """Return where values stand between the lowest, 0, and the highest, 1."""
    if choices:
        return values / max(len(choices) - 1, 1)
    scaled = np.log(values) if log else values
    width = scaled.max() - scaled.min()
    return (scaled - scaled.min()) / width if width else np.full(len(values), 0.5)


def _label_column(
    axes: Axes, column: int, values: Sequence[float], log: bool, choices: tuple[str, ...]
) -> None:
    """Write the choices, or the lowest and the highest value, beside a line of the parallel coordinates."""
    told: dict[float, str] = {}
    if choices:
        for number, choice in enumerate(choices):
            told[number / max(len(choices) - 1, 1)] = textwrap.shorten(choice, 18)
    else:
        for value in (min(values), max(values)):
            at = float(_unit(np.array([*values, value]), log, ())[-1])
            told[at] = f"{value:,.4g}"
    for at, text in told.items():
        axes.annotate(
            text,
            (column, at),
            (5, 0),
            textcoords="offset points",
            fontsize=7.5,
            va="center",
            zorder=5,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 1},
        )


def _objective_axis(axes: Axes, picture: Picture) -> None:
    if picture.log:
        axes.set_yscale("log")
    axes.yaxis.set_major_formatter(number_on_axis)
    better = "lower" if picture.lower_is_better else "higher"
    axes.set_ylabel("\n".join([*textwrap.wrap(picture.objective, 30), f"({better} is better)"]))
