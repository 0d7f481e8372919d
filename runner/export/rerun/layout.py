"""How the viewer arranges a run: the blueprint, and the parts of the picture that never change."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from runner.drawing import palette
from runner.environments.mdp import Mdp
from runner.environments.naming import numbered_actions, spoken
from runner.export.rerun.columns import rgba
from runner.export.rerun.metrics import TRAINING_MEANS
from runner.export.rerun.scene import Placements, Scene
from runner.recording.metrics import METRICS

FRAMES_PER_SECOND: Final = 10.0
GRID_MARGIN: Final = 0.8
PLOTS: Final = (
    *(
        (
            metric.heading.capitalize(),
            (
                *(f"train/metrics/{name}" for name in TRAINING_MEANS if name == metric.name),
                f"eval/metrics/{metric.name}",
            ),
        )
        for metric in METRICS
    ),
    ("Collisions per episode", ("train/metrics/collisions", "eval/metrics/collisions")),
    ("Q-table filled (%)", ("train/metrics/filled_percent",)),
    ("Epsilon, step size", ("train/metrics/epsilon", "train/metrics/step_size")),
    ("Rewards (% of the last steps)", ("train/metrics/reward_percent",)),
)
"""The views of metrics: title, and the entities whose lines it shows."""
_RESULTS: Final = len(METRICS)
"""Number of views, the first ones, that show results of evaluations."""

NAME_X: Final = 1.0
BAR_LEFT: Final = 2.5
BAR_LENGTH: Final = 5.0
NUMBER_X: Final = 9.4
GREEDY_X: Final = 12.2
CHOSEN_X: Final = 15.2
TABLE_WIDTH: Final = 17.0
TABLE_TOP: Final = -1.7
"""Columns and top of the table of values, in rows of height 1."""
LABEL_RISE: Final = 0.5
"""From a row of the table up to the point of a label in it, which is written below that point."""
MAP_LABEL_Y: Final = -2.6
_AGENT_GAP: Final = 2.0


@dataclass(frozen=True, eq=False)
class RunView:
    """What decides which views a tabular run has, and what is sent for them."""

    root: str
    """Entity path of everything of the run; empty for the root."""
    title: str
    mdp: Mdp
    scene: Scene | None
    learners: tuple[str, ...]
    has_steps: bool = True
    has_values: bool = False
    last: int = 0
    """Steps executed in the whole run; 0 if not known yet."""
    focus: tuple[int, int] | None = None
    """First and last step shown where values of steps are lines; None for the whole run."""

    def draw_background(self, stream: rr.RecordingStream) -> None:
        """Log what never changes: cells, walls, landmarks, and the frames of table and maps."""
        if self.has_values:
            _draw_table(stream, f"{self.root}/table/words", self.mdp)
        if self.scene is not None:
            _draw_grid(stream, f"{self.root}/scene", self.scene)
            if self.scene.placements is not None:
                _draw_blocks(stream, f"{self.root}/frame", self.scene.placements)

    def grid_view(self) -> rrb.View:
        """Return the view of the grid; without a scene that of state and action as lines."""
        if self.scene is None:
            entities = [f"{phase}/{name}" for phase in ("train", "eval") for name in ("state", "action")]
            axis = time_axis(self.last, self.focus)
            return self._view(rrb.TimeSeriesView, f"{self.title}: state and action", entities, axis_x=axis)
        bounds = rrb.VisualBounds2D(
            x_range=(-GRID_MARGIN, self.scene.columns + GRID_MARGIN),
            y_range=(-GRID_MARGIN - 0.1, self.scene.rows + GRID_MARGIN + 0.1),
        )
        entities = ["scene/**", "train/grid/**", "eval/grid/**", "notice/**"]
        return self._view(rrb.Spatial2DView, self.title, entities, visual_bounds=bounds)

    def value_views(self) -> list[rrb.View]:
        """Return the views of Q-values: the table, and a map of each learner where there are any."""
        bottom = float(bar_rows(self.mdp)[-1][-1]) + 0.9
        bounds = rrb.VisualBounds2D(x_range=(-0.4, TABLE_WIDTH), y_range=(TABLE_TOP, bottom))
        entities = ["table/**", "train/q/**", "eval/q/**"]
        name = "Q-values of this state, before the move"
        views = [self._view(rrb.Spatial2DView, name, entities, visual_bounds=bounds)]
        placements = self.scene.placements if self.scene else None
        if placements is None:
            return views
        bounds = rrb.VisualBounds2D(
            x_range=(-0.5, placements.width + 0.5), y_range=(-3.2, placements.height + 0.5)
        )
        for learner in self.learners:
            entities = ["frame/**", f"train/map/{learner}/**", f"eval/map/{learner}/**"]
            name = f"{spoken(learner)}: max Q, greedy moves"
            views.append(self._view(rrb.Spatial2DView, name, entities, visual_bounds=bounds))
        return views

    def event_view(self) -> rrb.View:
        """Return the view of the log of events."""
        columns = rrb.TextLogColumns(timeline_columns=["step"], text_log_columns=["body"])
        return self._view(rrb.TextLogView, "Events", ["train/events", "eval/events"], columns=columns)

    def _view(self, kind: type[rrb.View], name: str, entities: Sequence[str], **options: Any) -> rrb.View:
        contents = [f"{self.root}/{entity}" for entity in entities]
        return kind(origin=f"{self.root}/", contents=contents, name=name, **options)


def runs_view(runs: Sequence[RunView], entities: set[str] | None) -> rrb.Container:
    """Return the arrangement of one run with tables, or of several side by side.

    `entities` are those of recorded metrics; None if they are not known yet.
    """
    plots = _plots(runs, entities)
    body: rrb.Container
    if len(runs) == 1:
        columns: list[rrb.View | rrb.Container] = [rrb.Grid(*plots, grid_columns=2)]
        shares = [1]
        if runs[0].has_steps:
            columns.insert(0, rrb.Vertical(runs[0].grid_view(), runs[0].event_view(), row_shares=[3, 1]))
            shares = [4, 5]
        if runs[0].has_values:
            table, *maps = runs[0].value_views()
            below = [rrb.Horizontal(*maps)] if len(maps) > 1 else maps
            columns.insert(1, rrb.Vertical(table, *below, row_shares=[1, 1]) if below else table)
            shares = [4, 3, 4]
        body = rrb.Horizontal(*columns, column_shares=shares)
    else:
        halves = [
            rrb.Horizontal(run.grid_view(), rrb.Tabs(*run.value_views(), run.event_view()), name=run.title)
            for run in runs
            if run.has_steps
        ]
        rows = [
            rrb.Horizontal(*plots[:_RESULTS], name="Results"),
            rrb.Horizontal(*plots[_RESULTS:], name="Training"),
        ]
        body = rrb.Tabs(*(row for row in rows if row.contents))
        if halves:
            body = rrb.Vertical(rrb.Horizontal(*halves), body, row_shares=[7, 3])
    return body


def arranged(
    views: Sequence[rrb.View | rrb.Container], play_state: Literal["following", "paused"]
) -> rrb.Blueprint:
    """Return the blueprint of these views, one above the other, with the panels around them."""
    return rrb.Blueprint(
        views[0] if len(views) == 1 else rrb.Vertical(*views),
        rrb.TimePanel(state="collapsed", timeline="step", fps=FRAMES_PER_SECOND, play_state=play_state),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
    )


def time_axis(last: int, focus: tuple[int, int] | None = None) -> rrb.TimeAxis:
    """Return a time axis over `focus`, or from 0 to the step `last`, or to the cursor if that is 0."""
    start, last = focus or (0, last)
    end = rr.TimeRangeBoundary.absolute(seq=last) if last else rr.TimeRangeBoundary.cursor_relative(seq=0)
    return rrb.TimeAxis(view_range=rr.TimeRange(start=rr.TimeRangeBoundary.absolute(seq=start), end=end))


def _plots(runs: Sequence[RunView], entities: set[str] | None) -> list[rrb.View]:
    axis = time_axis(max(run.last for run in runs))
    views: list[rrb.View] = []
    for name, paths in PLOTS:
        contents = [f"{run.root}/{path}" for run in runs for path in paths]
        if shown := [entity for entity in contents if entities is None or entity in entities]:
            legend = rrb.PlotLegend(visible=True)
            views.append(
                rrb.TimeSeriesView(origin="/", contents=shown, name=name, axis_x=axis, plot_legend=legend)
            )
    return views


def bar_rows(mdp: Mdp) -> list[NDArray[np.float64]]:
    """Return the y of each agent's rows in the table of values, from top to bottom."""
    rows: list[NDArray[np.float64]] = []
    top = 1.0
    for count in mdp.action_counts:
        rows.append(np.arange(count, dtype=np.float64) + top)
        top += count + _AGENT_GAP
    return rows


def _draw_table(stream: rr.RecordingStream, path: str, mdp: Mdp) -> None:
    """Log the headings and names around the table of values."""
    labels: list[tuple[float, float, str, str]] = []  # x, y, text and colour
    agents = zip(mdp.agents, bar_rows(mdp), numbered_actions(mdp), strict=True)
    for i, (agent, rows, names) in enumerate(agents):
        labels.append((NAME_X, float(rows[0]) - 1.15, spoken(agent).upper(), palette.agent(i)))
        labels += [(NAME_X, float(y), name, palette.MIDTONE) for y, name in zip(rows, names, strict=True)]
    middle = BAR_LEFT + BAR_LENGTH / 2
    headings = {middle: "worst to best", NUMBER_X: "Q", GREEDY_X: "greedy", CHOSEN_X: "chosen"}
    labels += [(x, -0.15, heading, palette.MIDTONE) for x, heading in headings.items()]
    points = rr.Points2D(
        [(x, y - LABEL_RISE) for x, y, _, _ in labels],
        labels=[text for _, _, text, _ in labels],
        colors=[rgba(colour) for _, _, _, colour in labels],
        radii=0.0,
        show_labels=True,
    )
    stream.log(path, points, static=True)


def _draw_blocks(stream: rr.RecordingStream, path: str, placements: Placements) -> None:
    """Log the lines between the blocks of a map."""
    rows, columns = placements.block
    lines = _lines(range(0, placements.height + 1, rows), range(0, placements.width + 1, columns))
    stream.log(path, rr.LineStrips2D(lines, colors=[(255, 255, 255)], radii=0.06, draw_order=30), static=True)


def _draw_grid(stream: rr.RecordingStream, path: str, scene: Scene) -> None:
    """Log cells, walls and landmarks."""
    rows, columns = scene.rows, scene.columns
    grey = palette.rgb(palette.MIDTONE)
    cells = rr.LineStrips2D(
        _lines(range(rows + 1), range(columns + 1)), colors=[(*grey, 90)], radii=0.008, draw_order=10
    )
    stream.log(f"{path}/cells", cells, static=True)
    border: Any = [(0, 0), (columns, 0), (columns, rows), (0, rows), (0, 0)]
    walls = [border, *(_wall(first, second) for first, second in scene.description["walls"])]
    stream.log(f"{path}/walls", rr.LineStrips2D(walls, colors=[grey], radii=0.05, draw_order=25), static=True)
    marks = scene.description["landmarks"]
    if not marks:
        return
    # A line 0.46 wide around this square and along its diagonal fills a cell.
    square = np.array([(0.25, 0.25), (0.75, 0.25), (0.75, 0.75), (0.25, 0.75), (0.25, 0.25), (0.75, 0.75)])
    corners = [(float(column), float(row)) for row, column in (mark["cell"] for mark in marks)]
    colours = [palette.rgb(mark["colour"]) for mark in marks]
    tints = rr.LineStrips2D(
        [square + corner for corner in corners],
        colors=[(*colour, 110) for colour in colours],
        radii=0.23,
        draw_order=5,
    )
    stream.log(f"{path}/landmarks", tints, static=True)
    names = rr.Points2D(
        [(x + 0.14, y + 0.72) for x, y in corners],
        labels=[mark["name"] for mark in marks],
        colors=colours,
        radii=0.0,
        show_labels=True,
        draw_order=26,
    )
    stream.log(f"{path}/names", names, static=True)


def _lines(rows: range, columns: range) -> list[Any]:
    """Return horizontal lines at these rows and vertical ones at these columns, over all of them."""
    across: list[object] = [[(columns[0], y), (columns[-1], y)] for y in rows]
    return across + [[(x, rows[0]), (x, rows[-1])] for x in columns]


def _wall(first: Sequence[int], second: Sequence[int]) -> list[tuple[float, float]]:
    """Return the line between two neighbouring cells."""
    (row, column), (other_row, other_column) = first, second
    if row == other_row:
        x = max(column, other_column)
        return [(x, row), (x, row + 1)]
    y = max(row, other_row)
    return [(column, y), (column + 1, y)]
