"""Comparisons as self-contained pages: of groups of runs, and of algorithms over environments."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

from runner.analysis.compare import Comparison, MetricResult
from runner.analysis.compare.sections import EXPLANATION, metric_section, summary
from runner.analysis.compare.task_sections import EXPLANATION as TASKS_EXPLANATION
from runner.analysis.compare.task_sections import task_sections
from runner.analysis.compare.tasks import TaskComparison
from runner.analysis.groups import Group
from runner.analysis.sections import Grid, Section
from runner.export.plots.comparisons import intervals_svg, letter, profile_chart
from runner.export.plots.curves import plots_of
from runner.export.plots.tasks import task_charts
from runner.export.reports.rendering import Figure, LegendEntry, render
from runner.util.humanize import UNKNOWN, counted


class ComparedMetric(NamedTuple):
    """A metric on the page."""

    id: str
    section: Section
    figures: list[Figure]


def render_comparison(comparison: Comparison, groups: Sequence[Group]) -> str:
    """Return the page of a comparison, with the learning curves of its groups."""
    labels = [group.label for group in groups]
    plots, footnote = plots_of(groups)
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
    return render(
        "compare.html",
        title=" against ".join(labels) if len(labels) < 4 else f"{len(labels)} groups of runs compared",
        lead=summary(comparison),
        notes=comparison.notes,
        legend=[
            LegendEntry(letter(i), f"{group.label}: {counted(len(group.runs), 'run')}")
            for i, group in enumerate(groups)
        ],
        metrics=[_metric(metric, labels) for metric in comparison.metrics],
        plots=plots,
        footnote=footnote,
        runs=Grid(("run", "group", "name", "seed", "status"), rows),
        moment=comparison.moment,
        explanation=EXPLANATION,
    )


def _metric(metric: MetricResult, labels: list[str]) -> ComparedMetric:
    section = metric_section(metric, profile=False)
    figures = [Figure(intervals_svg(metric, labels), "Values")] if metric.groups else []
    if metric.groups and len(metric.thresholds) > 1:
        title, is_lower_better = f"{metric.title}: performance profile", metric.higher_is_better is False
        chart = profile_chart(
            "", title, metric.unit, metric.thresholds, metric.groups, labels, is_lower_better
        )
        figures.append(Figure(chart.svg(), "Performance profile"))
    return ComparedMetric("metric-" + re.sub(r"\W+", "-", metric.name), section, figures)


def render_tasks(comparison: TaskComparison) -> str:
    """Return the page of a comparison over environments."""
    labels = [result.label for result in comparison.algorithms]
    return render(
        "tasks.html",
        title=f"{' against '.join(labels)} over {len(comparison.tasks)} environments",
        sections=task_sections(comparison)[:-1],
        legend=tasks_legend(comparison),
        charts=[chart.svg() for chart in task_charts(comparison)],
        moment=comparison.moment,
        explanation=TASKS_EXPLANATION,
    )


def tasks_legend(comparison: TaskComparison) -> list[LegendEntry]:
    """Return the legend of charts over environments."""
    return [
        LegendEntry(letter(i), f"{result.label}: {sum(result.seeds.values())} runs")
        for i, result in enumerate(comparison.algorithms)
    ]
