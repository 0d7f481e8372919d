"""A comparison of algorithms over environments as one self-contained page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from runner.analysis.compare.task_sections import EXPLANATION, task_sections
from runner.analysis.compare.tasks import TaskComparison
from runner.analysis.sections import Section
from runner.export.plots.comparisons import letter
from runner.export.plots.tasks import task_charts
from runner.export.reports.rendering import LegendEntry, View, render


@dataclass(frozen=True)
class _TasksView(View):
    TEMPLATE: ClassVar = "tasks.html"
    title: str
    sections: Sequence[Section]
    legend: list[LegendEntry]
    charts: list[str]
    moment: str
    explanation: str = EXPLANATION


def render_tasks(comparison: TaskComparison) -> str:
    """Return the page.

    Raises:
        MissingExtra: Jinja2 is not installed.
    """
    labels = [result.label for result in comparison.algorithms]
    return render(
        _TasksView(
            title=f"{' against '.join(labels)} over {len(comparison.tasks)} environments",
            sections=task_sections(comparison)[:-1],
            legend=[
                LegendEntry(letter(i), f"{result.label}: {sum(result.seeds.values())} runs")
                for i, result in enumerate(comparison.algorithms)
            ],
            charts=[chart.svg() for chart in task_charts(comparison)],
            moment=comparison.moment,
        )
    )
