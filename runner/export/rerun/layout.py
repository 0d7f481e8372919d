"""How the viewer arranges what was sent: the blueprint follows from the views of the tracks."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Final

import rerun as rr
import rerun.blueprint as rrb

from runner.export.rerun.selection import MAX_MEMBERS
from runner.export.rerun.tracks import TrackView, Writer
from runner.recording import schema
from runner.recording.metrics import METRICS

FRAMES_PER_SECOND: Final = 10.0
OVERVIEW: Final = "Overview"
"""The tab for metrics of a job, or lines of all environments of a loop; other groups have their own."""
PICTURES: Final = ("train", "eval", "picture")
SHARES: Final = {"grid": 4.0, **dict.fromkeys(PICTURES, 3.0), "array": 2.0, "events": 4 / 3, "log": 1.0}
"""The groups at the left, with their shares of the height; pictures share one."""
VALUES: Final = "values"
"""The group in the middle: the table of values above, their maps below."""
FURTHER: Final = ("bars", "logged")
"""Groups in the overview, too."""
MAX_SHOWN: Final = {**dict.fromkeys(PICTURES, MAX_MEMBERS), "array": 2, "bars": 2, "logged": 6}
"""Views of a group in the blueprint; all are sent."""
PLOTS: Final = {
    **{metric.name: metric.heading.capitalize() for metric in METRICS},
    "collisions": "Collisions per episode",
    "filled_percent": "Q-table filled (%)",
    **dict.fromkeys(("epsilon", "step_size"), "Epsilon, step size"),
    "reward_percent": "Rewards (% of the last steps)",
}
"""The view of each metric that is shown, in their order; the first ones show results of evaluations."""
Shown = rrb.View | rrb.Container


def blueprint(runs: Sequence[Writer]) -> rrb.Blueprint:
    """Return the arrangement of runs, jobs above loops, with the panels around it."""
    jobs = [run for run in runs if run.recording.has_tables]
    loops = [run for run in runs if run not in jobs]
    parts = [_compared(jobs), *map(_alone, loops)] if len(jobs) > 1 else [*map(_alone, jobs + loops)]
    return rrb.Blueprint(
        parts[0] if len(parts) == 1 else rrb.Vertical(*parts),
        rrb.TimePanel(state="collapsed", timeline="step", fps=FRAMES_PER_SECOND, play_state="paused"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
    )


def _alone(run: Writer) -> rrb.Container:
    """Return the arrangement of a run: its pictures at the left, values in the middle, lines at the right."""
    left: list[tuple[Shown, float]] = []
    for group, share in SHARES.items():
        views: list[Shown] = [*_group(run, group)]
        if group in PICTURES and views:
            views = [rrb.Grid(*views, grid_columns=math.ceil(math.sqrt(len(views))))]
        left += [(view, share) for view in views]
    tabs = [
        rrb.Grid(*_group(run, tab, *(FURTHER if tab == OVERVIEW else ())), grid_columns=2, name=tab)
        for tab in dict.fromkeys([OVERVIEW, *(group for group, _ in run.views)])
        if tab not in (*SHARES, VALUES, *FURTHER)
    ]
    right = tabs[0] if len(tabs) == 1 else rrb.Tabs(*tabs, active_tab=0)
    columns: list[tuple[Shown, float]] = []
    values = _group(run, VALUES)
    if left:
        shown, heights = zip(*left, strict=True)
        is_wide = values or max(run.recording.environments, len(run.recording.agents)) > 1
        columns.append((rrb.Vertical(*shown, row_shares=heights), 3.0 if is_wide else 2.0))
    if values:
        table, *maps = values
        below: list[Shown] = [rrb.Horizontal(*maps)] if len(maps) > 1 else [*maps]
        columns.append((rrb.Vertical(table, *below), 2.25))
    parts, widths = zip(*columns, (right, 3.0), strict=True)
    return rrb.Horizontal(*parts, column_shares=widths, name=run.title)


def _compared(jobs: Sequence[Writer]) -> rrb.Container:
    """Return the arrangement of several jobs: side by side, above the lines of all."""
    last = max(job.last for job in jobs)
    plots = []
    for title in dict.fromkeys(PLOTS.values()):
        if shown := [job.views[OVERVIEW, title] for job in jobs if (OVERVIEW, title) in job.views]:
            entities = [entity for _, of_job in shown for entity in of_job]
            plots.append(_drawn(shown[0][0], "/", entities, last))
    halves = [
        rrb.Horizontal(*grid, rrb.Tabs(*_group(job, VALUES, "events")), name=job.title)
        for job in jobs
        if (grid := _group(job, "grid"))
    ]
    rows = {"Results": plots[: len(METRICS)], "Training": plots[len(METRICS) :]}
    tabs = rrb.Tabs(*(rrb.Horizontal(*row, name=name) for name, row in rows.items() if row))
    return rrb.Vertical(rrb.Horizontal(*halves), tabs, row_shares=[7, 3]) if halves else tabs


def _group(run: Writer, *groups: str) -> list[rrb.View]:
    """Return the views of groups, as many as are shown."""
    views = []
    titles = [*PLOTS.values()]
    for group in groups:
        of_group = [(view, entities) for view, entities in run.views.values() if view.group == group]
        of_group.sort(key=lambda shown: titles.index(shown[0].name) if shown[0].name in titles else 0)
        if group in schema.PHASES:  # frames: environments by number
            of_group.sort(key=lambda shown: (len(shown[0].name), shown[0].name))
        for view, entities in of_group[: MAX_SHOWN.get(group)]:
            views.append(_drawn(view, f"{run.root}/", entities, run.last, run.selection.focus))
    return views


def _drawn(
    view: TrackView, origin: str, entities: Iterable[str], last: int, focus: tuple[int, int] | None = None
) -> rrb.View:
    """Return a view; lines over the whole run, or over the focus."""
    options = dict(view.options)
    if view.kind is rrb.TimeSeriesView:
        start, end = (view.has_focus and focus) or (0, last)
        bounds = [rr.TimeRangeBoundary.absolute(seq=step) for step in (start, end)]
        options["axis_x"] = rrb.TimeAxis(view_range=rr.TimeRange(*bounds))
    return view.kind(origin=origin, contents=[*entities], name=view.name, **options)
