"""The steps of one phase: rewards, the grid, and a log of events.

A frame is one step: the state it was taken in and the move that was made from there.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache, partial
from typing import Any, Final, NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from runner.drawing import palette
from runner.environments.mdp import Mdp, events_of
from runner.environments.naming import events_in_words, states_in_words
from runner.export.rerun.labels import GridLabels
from runner.export.rerun.metrics import EVENTS, log_track, phase_colours, series_lines
from runner.export.rerun.scene import Scene
from runner.export.rerun.tracks import (
    GREY,
    Floats,
    Points,
    Times,
    Track,
    TrackView,
    agent_colours,
    columns,
    labels_alone,
    pairs,
    repeated,
    scalars,
    text_track,
)
from runner.util.arrays import Flags, Ints, Ints32, Records

TRAIL_STEPS: Final = 5
TITLE_Y: Final = -0.62
GRID_MARGIN: Final = 0.8
NO_ARRAY: Final[NDArray[Any]] = np.empty(0)


class Batch(NamedTuple):
    """n steps of one phase, with the learners' Q-values and maps of them if they are known."""

    records: Records
    times: Times
    """Evaluation is shown by the training episodes before it."""
    number: Ints
    """[n]: the number of the episode, or of the trial within its evaluation."""
    values: Floats = NO_ARRAY
    """[n, sum of the agents' action counts]: the value of each agent's own actions; with a joint table the
    best over the actions of the others. Empty if they are unknown, or not exported."""
    greedy: Ints = NO_ARRAY
    """[n, agents]: each agent's greedy action."""
    map_rows: Ints = NO_ARRAY
    """[k]: the steps that have maps."""
    value_maps: NDArray[np.float32] = NO_ARRAY
    """[k, learners, pixels]: the greatest value in the state of each pixel; nan for no state."""
    greedy_maps: Ints32 = NO_ARRAY
    """[k, learners, pixels]: the learner's greedy action there; -1 for no state."""

    def at(self, rows: slice | Ints | Flags) -> Times:
        """Return the timelines of some rows."""
        return {name: numbers[rows] for name, numbers in self.times.items()}

    def starts(self, before: int = -2) -> Flags:
        """Return which steps do not follow the one before them, the first the time `before`."""
        starts: Flags = np.diff(self.times["step"], prepend=before) != 1
        return starts

    def edges(self) -> set[int]:
        """Return the first steps of stretches of time without gaps, and the steps after their last ones."""
        steps = self.times["step"]
        starts = self.starts()
        return {*steps[starts].tolist(), *(steps[np.append(starts[1:], True)] + 1).tolist()}


class StepTracks:
    """Makes the tracks of a phase: the grid, or without a scene states and actions as lines."""

    def __init__(self, phase: str, title: str, labels: GridLabels) -> None:
        self._phase = phase
        self._labels = labels
        self._states = states_in_words(labels.mdp)
        self._entry = cache(partial(_entry, labels.mdp))
        self._before: Ints | None = None
        """The last states of the batch before, as many as a trail may show."""
        parts: dict[str, list[Any]] = {}
        if scene := labels.scene:
            view = grid_view(title, scene)
            colours = agent_colours(range(len(scene.movers)))
            shapes = zip(scene.shapes, scene.owners, strict=True)
            fills = [palette.rgb(shape.colour or palette.agent(owner)) for shape, owner in shapes]
            radii = [shape.radius for shape in scene.shapes]
            faded = [(*colour, 120) for colour in colours]
            parts["grid/things"] = [
                labels_alone(draw_order=50.0),
                rr.Boxes2D.from_fields(radii=radii, colors=fills, draw_order=40.0),
                rr.Arrows2D.from_fields(colors=colours, radii=0.035, draw_order=45.0),
                rr.LineStrips2D.from_fields(colors=faded, radii=0.05, draw_order=30.0),
            ]
            parts["grid/title"] = [labels_alone(colors=[GREY])]
            goal = palette.rgb(palette.GOAL)
            parts["grid/goal"] = [rr.Boxes2D.from_fields(colors=[goal], radii=0.04, show_labels=True)]
        else:
            view = TrackView("grid", f"{title}: state and action", has_focus=True)
            for name, colour in zip(("state", "action"), phase_colours(phase, 2), strict=True):
                parts[name] = [series_lines([f"{name} ({phase})"], [colour])]
        self.still = [Track(f"{phase}/{part}", static=static, view=view) for part, static in parts.items()]
        self.still.append(Track(f"{phase}/events", view=EVENTS))
        """What never changes."""

    def of(self, batch: Batch) -> Iterator[Track]:
        """Yield the tracks of a batch of steps."""
        events = events_of(self._labels.mdp, batch.records)
        yield from self._events(batch, events)
        if scene := self._labels.scene:
            yield from self._grid(scene, batch, events)
        else:
            for name in ("state", "action"):
                values = scalars(batch.records[name][:, None])
                yield Track(f"{self._phase}/{name}", batch.times, values)

    def _grid(self, scene: Scene, batch: Batch, events: NDArray[np.uint32]) -> Iterator[Track]:
        """Yield the grid of each step: movers, passengers, goals, trails and moves.

        The movers, passengers and texts of a step are points of one entity, with their arrows and trails,
        because a row costs more than its content.
        """
        records = batch.records
        labels = self._labels
        path = f"{self._phase}/grid"
        state = records["state"]
        texts = labels.of_steps(records, events)
        origins = scene.mover_points.take(state, axis=0)
        moved = scene.mover_points.take(records["next_state"], axis=0) - origins
        vectors = np.where(moved.any(axis=2, keepdims=True), moved, scene.moves[records["action"]])
        things = [
            *columns(rr.Points2D, positions=labels.points.take(state, axis=0), class_ids=texts),
            *columns(rr.Boxes2D, centers=scene.shape_centres.take(state, axis=0)),
            *columns(rr.Arrows2D, vectors=vectors, origins=origins),
            *columns(rr.LineStrips2D, strips=self._trails(scene, state, records["t"])),
        ]
        yield Track(f"{path}/things", batch.times, things)
        # Sizes wherever the grid may have been cleared: static ones would stay visible.
        begins = records["t"] == 0
        times = batch.at(begins | batch.starts())
        sizes = repeated(pairs(shape.half_size for shape in scene.shapes), len(times["step"]))
        yield Track(f"{path}/things", times, columns(rr.Boxes2D, half_sizes=sizes))
        if not begins.any():
            return
        times = batch.at(begins)
        titles = [
            f"TRAINING, episode {trained:,}"
            if self._phase == "train"
            else f"EVALUATION after {trained:,} episodes, trial {trial:,}"
            for trained, trial in zip(times["episode"], batch.number[begins], strict=True)
        ]
        yield text_track(f"{path}/title", times, (scene.columns / 2, TITLE_Y), titles)
        if scene.goals:
            centres = scene.centres[state[begins]][:, scene.goals]
            goals = columns(
                rr.Boxes2D,
                centers=centres,
                half_sizes=np.full_like(centres, 0.44),
                labels=repeated(np.array([scene.labels[goal] for goal in scene.goals]), len(centres)),
            )
            yield Track(f"{path}/goal", times, goals)

    def _trails(self, scene: Scene, state: Ints, t: Ints) -> Points:
        """Return each mover's path over the last steps of the episode, [n, movers, TRAIL_STEPS + 1, 2]."""
        before = np.repeat(state[:1], TRAIL_STEPS) if self._before is None else self._before
        states = np.concatenate((before, state))
        self._before = states[-TRAIL_STEPS:]
        # A point as one number of eight bytes: fewer and larger values to copy.
        points = scene.mover_points.take(states, axis=0).view(np.int64)[..., 0]
        lines = np.ascontiguousarray(sliding_window_view(points, TRAIL_STEPS + 1, axis=0))
        early = np.flatnonzero(t < TRAIL_STEPS)
        back = np.minimum(np.arange(TRAIL_STEPS, -1, -1), t[early, None])
        lines[early] = points[early[:, None] + TRAIL_STEPS - back].swapaxes(1, 2)
        return lines[..., None].view(np.float32)

    def _events(self, batch: Batch, events: NDArray[np.uint32]) -> Iterator[Track]:
        """Yield the text log: beginnings and ends of episodes, pickups, collisions; not illegal actions."""
        mdp = self._labels.mdp
        records = batch.records
        entity = f"{self._phase}/events"
        if len(begins := np.flatnonzero(records["t"] == 0)):
            kind = "episode" if self._phase == "train" else "trial"
            states = zip(batch.number[begins], self._states[records["state"][begins]], strict=True)
            lines = [f"{kind} {number:,} begins: {state}" for number, state in states]
            yield log_track(entity, batch.at(begins), lines)
        names = enumerate(mdp.event_names)
        masks = events & np.uint32(sum(1 << bit for bit, name in names if ".illegal" not in name))
        endings = np.where(records["terminated"], 1, 2 * records["truncated"])
        if len(rows := np.flatnonzero(masks | endings)):
            lines, levels = [], []
            parts = (part[rows].tolist() for part in (masks, endings, records["t"]))
            for mask, ending, t in zip(*parts, strict=True):
                text, level = self._entry(mask, ending)
                lines.append(f"{text} after {t + 1} steps" if ending else text)
                levels.append(level)
            yield log_track(entity, batch.at(rows), lines, levels)


def _entry(mdp: Mdp, mask: int, ending: int) -> tuple[str, str]:
    """Return text and level for a mask of events and an ending (0: none, 1: terminal, 2: time-out)."""
    text = events_in_words(mdp, mask)
    is_bad = "collision" in text and not mask & mdp.success_mask
    end = ("", "episode over", "time-out")[ending]
    return ", ".join(filter(None, (text, end))), "WARN" if is_bad else "INFO"


def grid_view(title: str, scene: Scene) -> TrackView:
    """Return the view of the grid."""
    bounds = rrb.VisualBounds2D(
        x_range=(-GRID_MARGIN, scene.columns + GRID_MARGIN),
        y_range=(-GRID_MARGIN - 0.1, scene.rows + GRID_MARGIN + 0.1),
    )
    return TrackView("grid", title, rrb.Spatial2DView, {"visual_bounds": bounds})
