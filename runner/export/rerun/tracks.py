"""What one entity shows over time: readers of runs yield tracks, one writer sends them.

The viewer's blueprint follows from the views of the tracks that were sent.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import ArrayLike, NDArray

from runner.drawing import palette
from runner.export.rerun.selection import MAX_MEMBERS, Selection
from runner.recording import schema
from runner.recording.marks import Mark
from runner.recording.metrics import METRICS
from runner.recording.reader import Recording
from runner.recording.schema import STEP_NANOSECONDS
from runner.util.arrays import Array, Scalar

APPLICATION: Final = "dualtaxi"
MAX_ROWS: Final = 8_192
"""Maximum number of rows sent at once: the web viewer drops larger columns."""
MAX_QUEUED: Final = 40 * MAX_ROWS
"""Rows that may wait to be compressed, which takes longer than making them."""
_STRIP: Final = rr.components.LineStrip2D.arrow_type()
Colour = tuple[int, ...]
GREY: Final[Colour] = palette.rgb(palette.MIDTONE)
Points = NDArray[np.float32]
"""[..., 2]: x and y."""
Times = dict[str, Array]
"""[n] numbers by timeline."""

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


class TrackView(NamedTuple):
    """A view of the viewer, of all tracks that name it."""

    group: str
    """Decides where it is placed."""
    name: str
    kind: type[rrb.View] = rrb.TimeSeriesView
    options: Mapping[str, Any] = {}
    has_focus: bool = False
    """Whether its time axis shows the episodes that were asked for alone."""


@dataclass(frozen=True)
class Track:
    """Rows of an entity; its first track also has what never changes."""

    entity: str
    """Its path below that of the run."""
    times: Times = field(default_factory=dict)
    columns: Iterable[Any] = ()
    """Components of as many rows as there are times."""
    static: Sequence[Any] = ()
    view: TrackView | None = None
    row: tuple[int, rr.AsComponents] | None = None
    """A step, and what is shown from it on: a single row, which Rerun sends together with others."""


@dataclass(eq=False)
class Writer:
    """Sends the tracks of a run to a stream, and keeps which views they have."""

    stream: rr.RecordingStream
    recording: Recording
    selection: Selection
    title: str
    marks: Sequence[Mark] = ()
    """The marks at its steps."""
    root: str = ""
    """Entity path of everything of the run; empty for the root."""
    tint: str | None = None
    """Base colour of its metrics, where runs are compared."""
    stage: Callable[[str], None] = lambda _: None
    """Called with what takes long."""
    last: int = 0
    """The last step of the run, or else of its lines that were sent."""
    entities: set[str] = field(default_factory=set)
    views: dict[tuple[str, str], tuple[TrackView, dict[str, None]]] = field(default_factory=dict)
    """By group and name, each with its entities."""
    _queued: int = 0

    def send(self, tracks: Iterable[Track]) -> None:
        """Send tracks by columns."""
        for track in tracks:
            entity = f"{self.root}/{track.entity}"
            if track.entity not in self.entities:
                self.entities.add(track.entity)
                for archetype in track.static:
                    self.stream.log(entity, archetype, static=True)
            if view := track.view:
                self.views.setdefault((view.group, view.name), (view, {}))[1][entity] = None
            if track.row:
                step, components = track.row
                self.stream.set_time("step", sequence=step)
                self.stream.log(entity, components)
            if track.times:
                steps = track.times["step"]
                if "episode" in track.times:
                    self.last = max(self.last, int(steps.max()))
                times = [rr.TimeColumn(name, sequence=numbers) for name, numbers in track.times.items()]
                self.stream.send_columns(entity, times, track.columns)
                self._queued += len(steps)
                if self._queued > MAX_QUEUED:
                    self.stream.flush()
                    self._queued = 0


def times_of(log_time: ArrayLike, **timelines: Array) -> Times:
    """Return the timeline `step` of log times, and others."""
    steps = np.asarray(log_time, np.int64) // STEP_NANOSECONDS
    return {"step": steps, **{name: numbers.astype(np.int64) for name, numbers in timelines.items()}}


def columns(archetype: object, **parts: Array) -> list[rr.ComponentColumn]:
    """Return the columns of n rows of a class such as `rerun.Points2D`, without one object per row.

    The parts are, by component, numbers [n, instances] or text, points [n, instances, 2], or line strips
    [n, strips, points, 2].
    """
    made = []
    for name, part in parts.items():
        # Arrow refuses memory that is not aligned, which the field of a lone record may be.
        items = pa.array(np.require(part, requirements=["C", "A"]).reshape(-1))
        if part.ndim > 2:
            items = pa.FixedSizeListArray.from_arrays(items, type=_STRIP.value_type)
        if part.ndim > 3:
            strips = np.arange(part[..., 0, 0].size + 1, dtype=np.int32) * np.int32(part.shape[2])
            items = pa.ListArray.from_arrays(strips, items, type=_STRIP)
        rows = np.arange(len(part) + 1, dtype=np.int32) * np.int32(part.shape[1])
        descriptor = getattr(archetype, f"descriptor_{name}")()
        batch = rr.AnyBatchValue(descriptor, items)  # other ways would copy it
        made.append(rr.ComponentColumn(descriptor, batch, offsets=rows))
    return made


def scalars(values: Array) -> list[rr.ComponentColumn]:
    """Return the column of series, [n, series]."""
    return columns(rr.Scalars, scalars=values.astype(np.float64, copy=False))


def cleared(entity: str, steps: Array | Sequence[int]) -> Iterator[Track]:
    """Yield the track that clears an entity, and all below it, from each of these steps on."""
    if len(steps):
        yield Track(entity, {"step": np.array(steps)}, rr.Clear.columns(is_recursive=[True] * len(steps)))


def repeated(row: NDArray[Scalar], n: int) -> NDArray[Scalar]:
    """Return n rows of the same content, [n, ...]."""
    return np.broadcast_to(row, (n, *row.shape))


def pairs(points: Iterable[Sequence[float]]) -> Points:
    """Return points or sizes as an array, [points, 2]."""
    return np.array(list(points), np.float32).reshape(-1, 2)


def centred(count: int, spacing: float) -> list[float]:
    """Return positions at equal distances around 0."""
    return [(i - (count - 1) / 2) * spacing for i in range(count)]


def text_track(entity: str, times: Times, where: tuple[float, float], rows: Sequence[str]) -> Track:
    """Return a track of one text per row, always at the same point."""
    return Track(entity, times, rr.Points2D.columns(positions=[where] * len(rows), labels=rows))


def agent_colours(agents: Iterable[int]) -> list[Colour]:
    """Return the colours of agents, or of their movers, by number."""
    return [palette.rgb(palette.agent(i)) for i in agents]


def labels_alone(**parts: Any) -> rr.Points2D:
    """Return points of which only the labels are drawn."""
    return rr.Points2D.from_fields(radii=0.0, show_labels=True, **parts)


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
        rows, heights = zip(*left, strict=True)
        is_wide = values or max(run.recording.environments, len(run.recording.agents)) > 1
        columns.append((rrb.Vertical(*rows, row_shares=heights), 3.0 if is_wide else 2.0))
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
        if views := [job.views[OVERVIEW, title] for job in jobs if (OVERVIEW, title) in job.views]:
            entities = [entity for _, of_job in views for entity in of_job]
            plots.append(_drawn(views[0][0], "/", entities, last))
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
