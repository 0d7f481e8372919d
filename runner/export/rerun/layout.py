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
"""The tab of a loop for lines of all its environments; other tabs are groups of their own."""
PICTURES: Final = ("train", "eval", "picture")
SHARES: Final = {"grid": 4, "train": 3, "eval": 3, "picture": 3, "array": 2, "log": 1}
"""The groups at the left of a loop, with their shares of the height; pictures share one."""
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
    parts = [_jobs(jobs)] if jobs else []
    parts += [_loop(run) for run in runs if run not in jobs]
    return rrb.Blueprint(
        parts[0] if len(parts) == 1 else rrb.Vertical(*parts),
        rrb.TimePanel(state="collapsed", timeline="step", fps=FRAMES_PER_SECOND, play_state="paused"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
    )


def _jobs(jobs: Sequence[Writer]) -> rrb.Container:
    """Return the arrangement of one job, or of several side by side."""
    last, plots = max(job.last for job in jobs), []
    for title in dict.fromkeys(PLOTS.values()):
        if shown := [job.views["plots", title] for job in jobs if ("plots", title) in job.views]:
            entities = [entity for _, of_job in shown for entity in of_job]
            plots.append(_drawn(shown[0][0], "/", entities, last))
    if len(jobs) == 1:
        columns: list[Shown] = [rrb.Grid(*plots, grid_columns=2)]
        if values := _group(jobs[0], "values"):
            table, *maps = values
            grid = _group(jobs[0], "grid", "events")
            below: list[Shown] = [rrb.Horizontal(*maps)] if len(maps) > 1 else [*maps]
            middle = rrb.Vertical(table, *below, row_shares=[1, 1]) if below else table
            columns = [rrb.Vertical(*grid, row_shares=[3, 1]), middle, *columns]
        return rrb.Horizontal(*columns, column_shares=[4, 3, 4] if values else [1])
    halves = [
        rrb.Horizontal(*grid, rrb.Tabs(*_group(job, "values", "events")), name=job.title)
        for job in jobs
        if (grid := _group(job, "grid"))
    ]
    rows = {"Results": plots[: len(METRICS)], "Training": plots[len(METRICS) :]}
    tabs = rrb.Tabs(*(rrb.Horizontal(*row, name=name) for name, row in rows.items() if row))
    return rrb.Vertical(rrb.Horizontal(*halves), tabs, row_shares=[7, 3]) if halves else tabs


def _loop(loop: Writer) -> rrb.Container:
    """Return the arrangement of a loop: its pictures at the left, its lines at the right."""
    left: list[tuple[Shown, int]] = []
    for group, share in SHARES.items():
        views: list[Shown] = [*_group(loop, group)]
        if group in PICTURES and views:
            views = [rrb.Grid(*views, grid_columns=math.ceil(math.sqrt(len(views))))]
        left += [(view, share) for view in views]
    further = ("bars", "logged")
    tabs = [
        rrb.Grid(*_group(loop, tab, *(further if tab == OVERVIEW else ())), grid_columns=2, name=tab)
        for tab in dict.fromkeys([OVERVIEW, *(group for group, _ in loop.views)])
        if tab not in (*SHARES, *further)
    ]
    right = tabs[0] if len(tabs) == 1 else rrb.Tabs(*tabs, active_tab=0)
    if not left:
        return rrb.Vertical(right, name=loop.title)
    shown, shares = zip(*left, strict=True)
    column = rrb.Vertical(*shown, row_shares=shares)
    recording = loop.recording
    share = 3 if max(recording.environments, len(recording.agents)) > 1 else 2
    return rrb.Horizontal(column, right, column_shares=[share, 3], name=loop.title)


def _group(run: Writer, *groups: str) -> list[rrb.View]:
    """Return the views of groups, as many as are shown."""
    views = []
    for group in groups:
        of_group = [(view, entities) for view, entities in run.views.values() if view.group == group]
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
