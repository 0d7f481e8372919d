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
from runner.export.rerun.metrics import phase_colours, series_lines
from runner.export.rerun.scene import Scene
from runner.export.rerun.tracks import (
    Floats,
    Points,
    Times,
    Track,
    TrackView,
    agent_colours,
    columns,
    grey_text,
    pairs,
    repeated,
    scalars,
    text_track,
    texts,
    times_of,
)
from runner.util.arrays import Ints, Records

TRAIL_STEPS: Final = 5
TITLE_Y: Final = -0.62
GRID_MARGIN: Final = 0.8
NO_ARRAY: Final[NDArray[Any]] = np.empty(0)


class Batch(NamedTuple):
    """n steps of one phase, with the learners' Q-values and maps of them if they are known."""

    records: Records
    episode: Ints
    """[n]: training episodes; for evaluation those before it."""
    number: Ints
    """[n]: the number of the episode, or of the trial within its evaluation."""
    values: Floats = NO_ARRAY
    """[n, sum of the agents' action counts]: the value of each agent's own actions; with a joint table the
    best over the actions of the others. Empty if they are unknown, or not exported."""
    greedy: Ints = NO_ARRAY
    """[n, agents]: each agent's greedy action."""
    has_map: NDArray[np.bool_] = NO_ARRAY
    """[n]: the k steps that have maps."""
    value_maps: NDArray[np.float32] = NO_ARRAY
    """[k, learners, pixels]: the greatest value in the state of each pixel; nan for no state."""
    greedy_maps: NDArray[np.int32] = NO_ARRAY
    """[k, learners, pixels]: the learner's greedy action there; -1 for no state."""

    def times(self, rows: slice | Ints = slice(None)) -> Times:
        """Return the timelines of some rows."""
        records = self.records[rows]
        return times_of(records["log_time"], episode=self.episode[rows], t=records["t"])

    def edges(self) -> set[int]:
        """Return the first steps of stretches of time without gaps, and the steps after their last ones."""
        steps = self.times()["step"]
        starts, stops = np.diff(steps, prepend=-2) != 1, np.diff(steps, append=-2) != 1
        return {*steps[starts].tolist(), *(steps[stops] + 1).tolist()}


class StepTracks:
    """Makes the tracks of a phase: the grid, or without a scene states and actions as lines."""

    def __init__(self, phase: str, title: str, labels: GridLabels) -> None:
        self._phase, self._labels = phase, labels
        self._states = states_in_words(labels.mdp)
        self._entry = cache(partial(_entry, labels.mdp))
        self._before: Ints | None = None
        """The last states of the batch before, as many as a trail may show."""
        parts: dict[str, list[Any]] = {}
        if scene := labels.scene:
            view = grid_view(title, scene)
            colours = agent_colours(range(len(scene.movers)))
            radii = [shape.radius for shape in scene.shapes]
            fills, faded = [palette.rgb(shape.colour) for shape in scene.shapes], [(*c, 120) for c in colours]
            parts["grid/things"] = [
                rr.Points2D.from_fields(radii=0.0, show_labels=True, draw_order=50.0),
                rr.Boxes2D.from_fields(radii=radii, colors=fills, draw_order=40.0),
                rr.Arrows2D.from_fields(colors=colours, radii=0.035, draw_order=45.0),
                rr.LineStrips2D.from_fields(colors=faded, radii=0.05, draw_order=30.0),
            ]
            parts["grid/title"] = [grey_text()]
            goal = palette.rgb(palette.GOAL)
            parts["grid/goal"] = [rr.Boxes2D.from_fields(colors=[goal], radii=0.04, show_labels=True)]
        else:
            view = TrackView("grid", f"{title}: state and action", has_focus=True)
            for name, colour in zip(("state", "action"), phase_colours(phase, 2), strict=True):
                parts[name] = [series_lines([f"{name} ({phase})"], [colour])]
        self.still = [Track(f"{phase}/{part}", static=static, view=view) for part, static in parts.items()]
        """What never changes."""

    def of(self, batch: Batch) -> Iterator[Track]:
        """Yield the tracks of a batch of steps."""
        records, times = batch.records, batch.times()
        events = events_of(self._labels.mdp, records)
        yield from self._events(batch, events)
        if scene := self._labels.scene:
            yield from self._grid(scene, batch, events, times)
        else:
            for name in ("state", "action"):
                yield Track(f"{self._phase}/{name}", times, scalars(records[name][:, None]))

    def _grid(self, scene: Scene, batch: Batch, events: NDArray[np.uint32], times: Times) -> Iterator[Track]:
        """Yield the grid of each step: movers, passengers, goals, trails and moves.

        The movers, passengers and texts of a step are points of one entity, with their arrows and trails,
        because a row costs more than its content.
        """
        records, labels, path = batch.records, self._labels, f"{self._phase}/grid"
        state, next_state = (records[name].astype(np.int64) for name in ("state", "next_state"))
        points, origins = labels.points.take(state, axis=0), scene.mover_points.take(state, axis=0)
        moved = scene.mover_points.take(next_state, axis=0) - origins
        blocked = scene.moves.take(records["action"].astype(np.int64), axis=0)
        vectors = np.where(moved.any(axis=2, keepdims=True), moved, blocked)
        things = [
            *columns(rr.Points2D, positions=points, class_ids=labels.of_steps(records, events)),
            *columns(rr.Boxes2D, centers=scene.shape_centres.take(state, axis=0)),
            *columns(rr.Arrows2D, vectors=vectors, origins=origins),
            *columns(rr.LineStrips2D, strips=self._trails(scene, state, records["t"])),
        ]
        yield Track(f"{path}/things", times, things)
        # Sizes wherever the grid may have been cleared: static ones would stay visible.
        begins = records["t"] == 0
        rows = np.flatnonzero(begins | (np.diff(times["step"], prepend=-1) != 1))
        sizes = repeated(pairs(shape.half_size for shape in scene.shapes), len(rows))
        yield Track(f"{path}/things", batch.times(rows), columns(rr.Boxes2D, half_sizes=sizes))
        if not begins.any():
            return
        times, n = batch.times(begins), int(begins.sum())
        titles = [
            f"TRAINING, episode {trained:,}"
            if self._phase == "train"
            else f"EVALUATION after {trained:,} episodes, trial {trial:,}"
            for trained, trial in zip(batch.episode[begins], batch.number[begins], strict=True)
        ]
        yield text_track(f"{path}/title", times, (scene.columns / 2, TITLE_Y), titles)
        if scene.goals:
            goals = columns(
                rr.Boxes2D,
                centers=scene.goal_points[records["state"][begins]],
                half_sizes=repeated(pairs([(0.44, 0.44)] * len(scene.goals)), n),
                labels=repeated(np.array([scene.labels[goal] for goal in scene.goals]), n),
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
        mdp, records = self._labels.mdp, batch.records
        names = enumerate(mdp.event_names)
        masks = events & np.uint32(sum(1 << bit for bit, name in names if ".illegal" not in name))
        endings = np.where(records["terminated"], 1, 2 * records["truncated"])
        kind = "episode" if self._phase == "train" else "trial"
        begins, happened = np.flatnonzero(records["t"] == 0), np.flatnonzero((masks != 0) | (endings != 0))
        states = zip(batch.number[begins], self._states[records["state"][begins]], strict=True)
        lines = [f"{kind} {number:,} begins: {state}" for number, state in states]
        levels = ["INFO"] * len(lines)
        happenings = (part[happened].tolist() for part in (masks, endings, records["t"]))
        for mask, ending, t in zip(*happenings, strict=True):
            text, level = self._entry(mask, ending)
            lines.append(f"{text} after {t + 1} steps" if ending else text)
            levels.append(level)
        if lines:
            rows = np.concatenate((begins, happened))
            order = np.argsort(rows, kind="stable")
            log = columns(rr.TextLog, text=texts(lines)[order], level=texts(levels)[order])
            yield Track(f"{self._phase}/events", batch.times(rows[order]), log)


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
