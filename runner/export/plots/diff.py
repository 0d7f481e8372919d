"""How far two runs' Q-tables are apart over training, as a small SVG for a page."""

from __future__ import annotations

from collections.abc import Sequence

from runner.analysis.diff import TableDiff
from runner.drawing import palette
from runner.environments.naming import spoken
from runner.export.plots.figure import (
    DASHES,
    MARKERS,
    STYLE,
    matplotlib_of,
    number_on_axis,
    svg_for_page,
)


def tables_svg(tables: Sequence[TableDiff]) -> str:
    """Return the largest and the mean difference, and the share of other greedy actions, over episodes."""
    mpl = matplotlib_of("a page")
    agents = list(dict.fromkeys(table.agent for table in tables))
    kinds = (
        ("largest", "largest difference"),
        ("mean", "mean difference"),
        ("greedy_share", "other greedy action, %"),
    )
    with mpl.rc_context(STYLE):
        figure = mpl.figure.Figure(figsize=(4.0, 3.6))
        for row, (name, label) in enumerate(kinds):
            axes = figure.add_axes((0.17, 0.71 - 0.28 * row, 0.79, 0.23))
            for i, agent in enumerate(agents):
                own = [table for table in tables if table.agent == agent]
                values = [getattr(table, name) * (100 if name == "greedy_share" else 1) for table in own]
                axes.plot(
                    [table.episode for table in own],
                    values,
                    color=palette.SERIES[2 + i % 3],
                    linestyle=DASHES[i % len(DASHES)],
                    marker=MARKERS[i % len(MARKERS)],
                    markersize=3.2,
                    label=spoken(agent),
                )
            axes.set_title(label, fontsize=8.5, pad=3)
            axes.set_ylim(bottom=0)
            axes.set_xlim(left=0)
            axes.grid(visible=True)
            axes.xaxis.set_major_formatter(number_on_axis)
            axes.tick_params(labelbottom=row == len(kinds) - 1)
            if row == 0 and len(agents) > 1:
                axes.legend(
                    ncols=len(agents), loc="lower right", bbox_to_anchor=(1.02, 0.96), borderaxespad=0.1
                )
        axes.set_xlabel("training episodes")
        return svg_for_page(figure, "tables", "Difference of the Q-tables over training episodes")
