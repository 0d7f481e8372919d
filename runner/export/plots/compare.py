"""The plots of a comparison, as small SVGs for a page: intervals, and performance profiles.

Groups have the colours and markers that they have in the learning curves.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

import numpy as np

from runner.analysis.compare import GroupResult, MetricResult
from runner.drawing import palette
from runner.export.plots.figure import (
    MARKERS,
    STYLE,
    matplotlib_of,
    number_on_axis,
    svg_for_page,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_WIDTH: Final = 4.0
_HEIGHT: Final = 2.3
_SPREAD: Final = 0.22
"""How far the points of single seeds stand apart from their group's line."""


def intervals_svg(metric: MetricResult, labels: list[str]) -> str:
    """Return each group's seeds as points, its median as a tick, and its IQM with the 95 % interval.

    Args:
        metric: what is drawn.
        labels: of all groups, in the order of their colours.
    """
    height = max(_HEIGHT, 0.75 + 0.42 * len(metric.groups))

    def drawn(axes: Axes) -> None:
        for row, group in enumerate(metric.groups):
            _draw_group(axes, group, row, labels.index(group.label))
        axes.set_ylim(len(metric.groups) - 0.4, -0.6)
        axes.set_yticks(range(len(metric.groups)), [letter(labels.index(g.label)) for g in metric.groups])
        axes.spines["left"].set_visible(False)
        axes.tick_params(axis="y", length=0)
        axes.set_xlabel(metric.unit)

    return _svg(metric, f"{metric.title}: values of the groups", "values", height, drawn)


def profile_svg(metric: MetricResult, labels: list[str]) -> str:
    """Return the share of each group's runs that are at least as good as a level, over the levels."""

    def drawn(axes: Axes) -> None:
        for group in metric.groups:
            number = labels.index(group.label)
            colour = palette.SERIES[number % len(palette.SERIES)]
            axes.step(
                metric.thresholds,
                100 * np.array(group.profile),
                where="post" if metric.higher_is_better is False else "pre",
                color=colour,
                marker=MARKERS[number % len(MARKERS)],
                markersize=3.2,
                markevery=max(len(metric.thresholds) // 8, 1),
            )
            low, high = 100 * np.array(group.profile_low), 100 * np.array(group.profile_high)
            axes.fill_between(metric.thresholds, low, high, color=colour, alpha=0.2, linewidth=0)
        axes.set_ylim(0, 103)
        axes.set_yticks(range(0, 101, 20))
        sign = "at most" if metric.higher_is_better is False else "at least"
        axes.set_xlabel(f"{metric.unit}, {sign}")
        axes.set_ylabel("percent of runs")

    return _svg(metric, f"{metric.title}: performance profile", "profile", _HEIGHT, drawn)


def _draw_group(axes: Axes, group: GroupResult, row: int, number: int) -> None:
    colour = palette.SERIES[number % len(palette.SERIES)]
    values = [value for value in group.values if math.isfinite(value)]
    offsets = (
        row + _SPREAD * np.linspace(-1, 1, len(values)) if len(values) > 1 else np.full(len(values), row)
    )
    axes.plot(values, offsets, linestyle="", marker=".", markersize=4, color=colour, alpha=0.45)
    if math.isfinite(group.median):
        axes.plot([group.median], [row], marker="|", markersize=15, markeredgewidth=1.6, color=palette.INK)
    if all(map(math.isfinite, (group.iqm.value, group.iqm.low, group.iqm.high))):
        axes.plot(
            [group.iqm.low, group.iqm.high], [row, row], color=colour, linewidth=3.4, solid_capstyle="butt"
        )
        marker = MARKERS[number % len(MARKERS)]
        axes.plot(
            [group.iqm.value], [row], marker=marker, markersize=6, color=colour, markeredgecolor=palette.INK
        )


def _svg(metric: MetricResult, title: str, kind: str, height: float, draw: Callable[[Axes], None]) -> str:
    mpl = matplotlib_of("a page")
    with mpl.rc_context(STYLE):
        figure = mpl.figure.Figure(figsize=(_WIDTH, height))
        axes = figure.add_axes((0.68 / _WIDTH, 0.5 / height, 0.8, 1 - 0.72 / height))
        draw(axes)
        axes.grid(visible=True)
        axes.set_axisbelow(True)
        axes.margins(x=0.05)
        axes.xaxis.set_major_locator(mpl.ticker.MaxNLocator(5, steps=[1, 2, 5, 10]))
        axes.xaxis.set_major_formatter(number_on_axis)
        return svg_for_page(figure, f"{kind}-{metric.name}", title)


def letter(number: int) -> str:
    """Return what stands for a group in a plot: A, B, ..."""
    return chr(ord("A") + number) if number < 26 else str(number + 1)
