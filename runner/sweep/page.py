"""A sweep as one self-contained page: its ranking, what mattered, and how the best trial learned."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import ClassVar

from runner.analysis.groups import Group
from runner.analysis.sections import Section
from runner.export.plots.curves import Plot, footnote, panel_plots
from runner.export.reports.rendering import LegendEntry, View, render
from runner.sweep.charts import learning, picture_of, picture_plots
from runner.sweep.results import Results, sections


@dataclass(frozen=True)
class _SweepView(View):
    TEMPLATE: ClassVar = "sweep.html"
    title: str
    lead: list[str]
    sections: list[Section]
    parameters: list[Plot]
    note: str
    best: str | None
    legend: list[LegendEntry]
    plots: list[Plot]
    footnote: str
    moment: str


def render_sweep(results: Results, recordings: Path) -> str:
    """Return the page of a sweep whose runs are in a recordings folder."""
    picture = picture_of(results)
    groups, panels = learning(results, recordings)
    ranking, *others = sections(results)
    view = _SweepView(
        title=ranking.title,
        lead=ranking.sentences,
        sections=[Section("Ranking", grids=ranking.grids), *others],
        parameters=picture_plots(picture),
        note=picture.footnote,
        best=results.best_yaml,
        legend=sweep_legend(groups),
        plots=panel_plots(panels, len(groups)),
        footnote=footnote(groups, panels),
        moment=f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
    )
    return render(view)


def sweep_legend(groups: list[Group]) -> list[LegendEntry]:
    """Return which trial each group of runs belongs to."""
    parts = (group.described.partition(", ") for group in groups)
    return [LegendEntry(trial, rest) for trial, _, rest in parts]
