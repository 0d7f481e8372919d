"""How the viewer arranges a run: the blueprint, and the parts of the picture that never change."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import rerun as rr
import rerun.blueprint as rrb

from runner.drawing import palette
from runner.environments.mdp import Mdp
from runner.environments.naming import spoken
from runner.export.rerun.maps import draw_blocks
from runner.export.rerun.metrics import TRAINING_MEANS
from runner.export.rerun.scene import Scene
from runner.export.rerun.values import TOP, WIDTH, bar_rows, draw_table
from runner.recording.metrics import METRICS

FRAMES_A_SECOND: Final = 10.0
PLOTS: Final = (
    *(
        (
            metric.heading.capitalize(),
            (
                *(f"train/metrics/{n}" for n in TRAINING_MEANS if n == metric.name),
                f"eval/metrics/{metric.name}",
            ),
        )
        for metric in METRICS
    ),
    ("Collisions an episode", ("train/metrics/collisions", "eval/metrics/collisions")),
    ("Q-table filled (%)", ("train/metrics/filled_percent",)),
    ("Epsilon, step size", ("train/metrics/epsilon", "train/metrics/step_size")),
    ("Rewards (% of the last steps)", ("train/metrics/reward_percent",)),
)
"""The views of metrics: title, and the entities whose lines it shows."""
_RESULTS: Final = len(METRICS)
"""Number of views, the first ones, that show results of evaluations."""


@dataclass(frozen=True)
class Shown:
    """What the blueprint needs to know of a run."""

    root: str
    title: str
    mdp: Mdp
    scene: Scene | None
    learners: tuple[str, ...]
    steps: bool
    """Whether any steps are exported."""
    last: int
    """Steps executed in the whole run; 0 if that is not known yet."""
    paths: frozenset[str] | None
    """Metrics that there are; None if that is not known yet."""
    values: bool = True
    """Whether values of the tables are exported."""


def blueprint(runs: Sequence[Shown]) -> rrb.Blueprint:
    """Return the arrangement for one run, or for several side by side; it opens at the last step."""
    last = max(run.last for run in runs)
    plots = _plots(runs, last)
    with_steps = [run for run in runs if run.steps]
    body: Any
    if len(runs) == 1:
        parts = [*(_single(with_steps[0]) if with_steps else ()), rrb.Grid(*plots, grid_columns=2)]
        shares = {3: [4, 3, 4], 2: [4, 5]}.get(len(parts), [1])
        body = rrb.Horizontal(*parts, column_shares=shares)
    else:
        halves = [rrb.Horizontal(*_half(run), name=run.title) for run in with_steps]
        rows = [
            rrb.Horizontal(*plots[:_RESULTS], name="Results"),
            rrb.Horizontal(*plots[_RESULTS:], name="Training"),
        ]
        below = rrb.Tabs(*(row for row in rows if row.contents))
        body = rrb.Vertical(rrb.Horizontal(*halves), below, row_shares=[7, 3]) if halves else below
    return rrb.Blueprint(
        body,
        rrb.TimePanel(state="collapsed", timeline="step", fps=FRAMES_A_SECOND, play_state="following"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
    )


def loop_blueprint(parts: Sequence[Any]) -> rrb.Blueprint:
    """Return the arrangement for somebody's own loops, each arranged already."""
    return rrb.Blueprint(
        parts[0] if len(parts) == 1 else rrb.Vertical(*parts),
        rrb.TimePanel(state="collapsed", timeline="step", fps=FRAMES_A_SECOND, play_state="paused"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
    )


def _single(run: Shown) -> list[Any]:
    left = rrb.Vertical(_grid(run), _events(run), row_shares=[3, 1])
    if not run.values:
        return [left]
    maps = _maps(run)
    if not maps:
        return [left, _values(run)]
    below = rrb.Horizontal(*maps) if len(maps) > 1 else maps[0]
    return [left, rrb.Vertical(_values(run), below, row_shares=[1, 1])]


def _half(run: Shown) -> list[Any]:
    return [_grid(run), rrb.Tabs(_values(run), *_maps(run), _events(run))]


def _grid(run: Shown) -> Any:
    if run.scene is None:
        contents = [
            f"{run.root}/{phase}/{what}" for phase in ("train", "eval") for what in ("state", "action")
        ]
        return rrb.TimeSeriesView(
            origin=f"{run.root}/",
            contents=contents,
            name=f"{run.title}: state and action",
            axis_x=whole_axis(run.last),
        )
    margin = 0.8
    bounds = rrb.VisualBounds2D(
        x_range=(-margin, run.scene.columns + margin), y_range=(-margin - 0.1, run.scene.rows + 0.9)
    )
    contents = [
        f"{run.root}/scene/**",
        f"{run.root}/train/grid/**",
        f"{run.root}/eval/grid/**",
        f"{run.root}/notice/**",
    ]
    return rrb.Spatial2DView(origin=f"{run.root}/", contents=contents, visual_bounds=bounds, name=run.title)


def _values(run: Shown) -> Any:
    bottom = float(bar_rows(run.mdp)[-1][-1]) + 0.9
    bounds = rrb.VisualBounds2D(x_range=(-0.4, WIDTH), y_range=(TOP, bottom))
    contents = [f"{run.root}/table/**", f"{run.root}/train/q/**", f"{run.root}/eval/q/**"]
    return rrb.Spatial2DView(
        origin=f"{run.root}/",
        contents=contents,
        visual_bounds=bounds,
        name="Q-values of this state, before the move",
    )


def _maps(run: Shown) -> list[Any]:
    if run.scene is None or run.scene.placements is None:
        return []
    pictures = run.scene.placements
    bounds = rrb.VisualBounds2D(x_range=(-0.5, pictures.width + 0.5), y_range=(-3.2, pictures.height + 0.5))
    views = []
    for learner in run.learners:
        contents = [
            f"{run.root}/frame/**",
            f"{run.root}/train/map/{learner}/**",
            f"{run.root}/eval/map/{learner}/**",
        ]
        views.append(
            rrb.Spatial2DView(
                origin=f"{run.root}/",
                contents=contents,
                visual_bounds=bounds,
                name=f"{spoken(learner)}: max Q, greedy moves",
            )
        )
    return views


def _events(run: Shown) -> Any:
    contents = [f"{run.root}/train/events", f"{run.root}/eval/events"]
    columns = rrb.TextLogColumns(timeline_columns=["step"], text_log_columns=["body"])
    return rrb.TextLogView(origin=f"{run.root}/", contents=contents, name="Events", columns=columns)


def whole_axis(last: int) -> rrb.TimeAxis:
    """Return a time axis from 0 to the step `last`; to the cursor if that is 0, not known yet."""
    start, end = rr.TimeRangeBoundary.absolute(seq=0), rr.TimeRangeBoundary.cursor_relative(seq=0)
    if last:
        end = rr.TimeRangeBoundary.absolute(seq=last)
    return rrb.TimeAxis(view_range=rr.TimeRange(start=start, end=end))


def _plots(runs: Sequence[Shown], last: int) -> list[Any]:
    axis = whole_axis(last)
    views = []
    for name, paths in PLOTS:
        contents = [
            f"{run.root}/{path}" for run in runs for path in paths if run.paths is None or path in run.paths
        ]
        if contents:
            views.append(
                rrb.TimeSeriesView(
                    origin="/",
                    contents=contents,
                    name=name,
                    axis_x=axis,
                    plot_legend=rrb.PlotLegend(visible=True),
                )
            )
    return views


def draw_background(stream: rr.RecordingStream, run: Shown) -> None:
    """Log what never changes: cells, walls, landmarks, and the frame of the table of values."""
    if run.steps and run.values:
        draw_table(stream, f"{run.root}/table/words", run.mdp)
    if run.scene is not None and run.steps:
        _draw_scene(stream, f"{run.root}/scene", run.scene)
        if run.scene.placements is not None:
            draw_blocks(stream, f"{run.root}/frame", run.scene.placements)


def _draw_scene(stream: rr.RecordingStream, path: str, scene: Scene) -> None:
    rows, columns = scene.rows, scene.columns
    across: list[Any] = [[(0, y), (columns, y)] for y in range(rows + 1)]
    down = [[(x, 0), (x, rows)] for x in range(columns + 1)]
    stream.log(
        f"{path}/cells",
        rr.LineStrips2D(across + down, colors=[(128, 128, 128, 90)], radii=0.008, draw_order=10),
        static=True,
    )
    border: Any = [(0, 0), (columns, 0), (columns, rows), (0, rows), (0, 0)]
    walls = [border, *(_wall(first, second) for first, second in scene.description.get("walls", []))]
    stream.log(
        f"{path}/walls",
        rr.LineStrips2D(walls, colors=[(128, 128, 128)], radii=0.05, draw_order=25),
        static=True,
    )
    marks = scene.description.get("landmarks", [])
    tints = [(*palette.rgb(mark["colour"]), 110) for mark in marks]
    if marks:
        stream.log(
            f"{path}/landmarks",
            rr.LineStrips2D(
                [_square(*mark["cell"]) for mark in marks], colors=tints, radii=0.23, draw_order=5
            ),
            static=True,
        )
        stream.log(
            f"{path}/names",
            rr.Points2D(
                [(c + 0.14, r + 0.72) for r, c in (mark["cell"] for mark in marks)],
                labels=[mark["name"] for mark in marks],
                colors=[palette.rgb(mark["colour"]) for mark in marks],
                radii=0.0,
                show_labels=True,
                draw_order=26,
            ),
            static=True,
        )


def _square(row: int, column: int) -> list[tuple[float, float]]:
    """Return a line that fills a cell when it is drawn 0.46 wide."""
    low, high = 0.25, 0.75
    x, y = float(column), float(row)
    return [
        (x + low, y + low),
        (x + high, y + low),
        (x + high, y + high),
        (x + low, y + high),
        (x + low, y + low),
        (x + high, y + high),
    ]


def _wall(first: Sequence[int], second: Sequence[int]) -> list[tuple[float, float]]:
    (row, column), (other_row, other_column) = first, second
    if row == other_row:
        x = max(column, other_column)
        return [(x, row), (x, row + 1)]
    y = max(row, other_row)
    return [(column, y), (column + 1, y)]
