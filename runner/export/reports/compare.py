"""Comparisons as self-contained pages: of groups of runs, and of algorithms over environments."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from runner.analysis.compare import Comparison, MetricResult
from runner.analysis.compare.sections import sections, summary, task_sections
from runner.analysis.compare.tasks import TaskComparison
from runner.analysis.groups import Group
from runner.analysis.sections import Figure, Grid, LegendEntry, Section
from runner.export.plots.comparisons import intervals_svg, letter, profile_chart, task_charts
from runner.export.plots.curves import curves_section
from runner.export.reports.rendering import render
from runner.util.humanize import UNKNOWN, counted

_KEY = (
    "In the plots of values, a dot is a run, the tick the median, the large sign the IQM, and the bar its "
    "interval. A performance profile shows the share of the runs that reach a level; bands are pointwise "
    "95 % intervals."
)


def render_comparison(comparison: Comparison, groups: Sequence[Group]) -> str:
    """Return the page of a comparison, with the learning curves of its groups."""
    labels = [group.label for group in groups]
    _, *metrics, how = sections(comparison)
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
        " against ".join(labels) if len(labels) < 4 else f"{len(labels)} groups of runs compared",
        summary(comparison),
        [
            *(
                replace(section, figures=list(_figures(metric, labels)), layout="pair")
                for section, metric in zip(metrics, comparison.metrics, strict=True)
            ),
            curves_section(groups),
            Section("Runs", grids=[Grid(("run", "group", "name", "seed", "status"), rows)]),
            replace(how, sentences=[*how.sentences, _KEY]),
        ],
        f"the recordings of these runs, {comparison.moment}",
        notes=comparison.notes,
        legend=[
            LegendEntry(letter(i), f"{group.label}: {counted(len(group.runs), 'run')}")
            for i, group in enumerate(groups)
        ],
    )


def _figures(metric: MetricResult, labels: list[str]) -> Iterator[Figure]:
    if not metric.groups:
        return
    yield Figure(intervals_svg(metric, labels), "Values")
    if len(metric.thresholds) > 1:
        title = f"{metric.title}: performance profile"
        is_lower_better = metric.higher_is_better is False
        chart = profile_chart(
            "", title, metric.unit, metric.thresholds, metric.groups, labels, is_lower_better
        )
        yield Figure(chart.svg(), "Performance profile")


def render_tasks(comparison: TaskComparison) -> str:
    """Return the page of a comparison over environments."""
    labels = [result.label for result in comparison.algorithms]
    return render(
        f"{' against '.join(labels)} over {len(comparison.tasks)} environments",
        [],
        drawn_task_sections(comparison),
        f"the recordings of these runs, {comparison.moment}",
    )


def drawn_task_sections(comparison: TaskComparison) -> list[Section]:
    """Return the text of a comparison over environments with its charts."""
    algorithms, scores, how = task_sections(comparison)
    legend = [
        LegendEntry(letter(i), f"{result.label}: {sum(result.seeds.values())} runs")
        for i, result in enumerate(comparison.algorithms)
    ]
    figures = [Figure(chart.svg()) for chart in task_charts(comparison)]
    sentences = [*scores.sentences, "Bands are pointwise 95 % intervals."]
    return [replace(scores, sentences=sentences, figures=figures, legend=legend), algorithms, how]
