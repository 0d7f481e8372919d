"""A comparison of groups of runs as one self-contained page."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from runner.analysis.compare import Comparison, MetricResult
from runner.analysis.compare.sections import EXPLANATION, in_short, metric_section
from runner.analysis.groups import Group
from runner.analysis.sections import Grid
from runner.drawing import palette
from runner.export.plots.comparisons import intervals_svg, letter, profile_svg
from runner.export.plots.curves import footnote, plots_of
from runner.export.reports.rendering import templates
from runner.export.reports.report import require_packages
from runner.util.humanize import UNKNOWN


def render_comparison(comparison: Comparison, groups: Sequence[Group]) -> str:
    """Return the page.

    Args:
        comparison: of these groups.
        groups: the same, for their learning curves.

    Raises:
        MissingExtra: Jinja2 or Matplotlib is not installed.
    """
    require_packages()
    labels = [group.label for group in groups]
    return (
        templates()
        .get_template("compare.html")
        .render(
            title=" against ".join(labels) if len(labels) < 4 else f"{len(labels)} groups of runs compared",
            lead=in_short(comparison),
            notes=comparison.notes,
            legend=[
                (
                    i % len(palette.SERIES),
                    letter(i),
                    _described(group),
                )
                for i, group in enumerate(groups)
            ],
            metrics=[_metric(metric, labels) for metric in comparison.metrics],
            panels=plots_of(groups),
            footnote=footnote(groups),
            runs=_runs(groups),
            explanation=EXPLANATION,
            moment=comparison.moment,
        )
    )


def _described(group: Group) -> str:
    return f"{group.label}: {len(group.runs)} run{'s' if len(group.runs) > 1 else ''}"


def _metric(metric: MetricResult, labels: list[str]) -> dict[str, Any]:
    section = metric_section(metric, profile=False)
    figures = [{"svg": intervals_svg(metric, labels), "caption": "Values"}]
    if len(metric.thresholds) > 1:
        figures.append({"svg": profile_svg(metric, labels), "caption": "Performance profile"})
    return {
        "id": "metric-" + re.sub(r"\W+", "-", metric.name),
        "title": section.title,
        "sentences": section.sentences,
        "grids": section.grids,
        "figures": figures if metric.groups else [],
    }


def _runs(groups: Sequence[Group]) -> Grid:
    rows = [
        (
            run.run_id,
            f"{letter(i)}: {group.label}",
            run.name,
            UNKNOWN if run.seed is None else str(run.seed),
            run.status,
        )
        for i, group in enumerate(groups)
        for run in group.runs
    ]
    return Grid(("run", "group", "name", "seed", "state"), rows)
