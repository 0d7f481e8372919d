"""A sweep as one self-contained page: what came of it, what mattered, and how the best trial learned."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from runner.analysis.groups import Group
from runner.drawing import palette
from runner.export.plots.curves import footnote, panel_plots
from runner.export.reports.rendering import templates
from runner.export.reports.report import require_packages
from runner.sweep.charts import parallel_chart, parameter_chart
from runner.sweep.plots import learning, picture_of
from runner.sweep.results import Results, sections


def render_sweep(results: Results, recordings: Path) -> str:
    """Return the page.

    Args:
        results: of the sweep.
        recordings: the folder of its runs.

    Raises:
        MissingExtra: Jinja2 is not installed.
        RunnerError: no trial is finished yet, or a run cannot be read.
    """
    require_packages()
    picture = picture_of(results)
    groups, panels = learning(results, recordings)
    made = sections(results)
    return (
        templates()
        .get_template("sweep.html")
        .render(
            title=made[0].title,
            lead=made[0].sentences,
            sections=[_section(each) for each in made],
            parameters=[parameter_chart(picture, axis).svg() for axis in picture.axes],
            parallel=parallel_chart(picture).svg(),
            note=picture.footnote,
            best=results.best_yaml,
            legend=[(i % len(palette.SERIES), *_told(group)) for i, group in enumerate(groups)],
            panels=panel_plots(panels, len(groups)),
            footnote=footnote(groups),
            moment=f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
        )
    )


def _told(group: Group) -> tuple[str, str]:
    """Return which trial a group's runs are of, and what there is to say of it."""
    which, _, rest = group.described.partition(", ")
    return which, rest


def _section(section: Any) -> dict[str, Any]:
    return {
        "id": re.sub(r"\W+", "-", section.title.partition(":")[0].lower()),
        "title": section.title,
        "sentences": section.sentences,
        "grids": section.grids,
    }
