"""The grid at each step: who is where, carries whom, came which way, does what, and what came of it."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from runner.analysis.outcomes import events_of
from runner.drawing import palette
from runner.export.rerun.classes import Vocabulary
from runner.export.rerun.columns import Batch, Sender, ink, instances, place, rgba, strips, texts
from runner.export.rerun.scene import TRAIL_STEPS, Marks, Scene

TITLE_Y: Final = -0.62
FACTS_BELOW: Final = 0.35
LINE: Final = 0.3
"""Between the lines below the grid."""
MOVER_LABEL: Final = -0.5
"""From a mover to its label, which is written below that point: above what is drawn."""
OTHER_LABEL: Final = 0.12
"""From a passenger to its label: below what is drawn."""


class GridWriter(Sender):
    """Sends the grid of one phase.

    The movers, passengers and written facts of a step are the points of one entity, with their arrows and
    trails: a row costs more than what is in it.
    """

    def __init__(
        self, stream: rr.RecordingStream, path: str, scene: Scene, marks: Marks, words: Vocabulary
    ) -> None:
        super().__init__(stream, path)
        self._scene = scene
        self._marks = marks
        self._words = words
        self._label_offsets = np.array(
            [[0.0, MOVER_LABEL]] * len(scene.movers) + [[0.0, OTHER_LABEL]] * len(scene.passengers),
            np.float32,
        )

    def dress(self) -> None:
        """Log sizes and colours."""
        movers = len(self._scene.movers)
        colours = [palette.agent(i) for i in range(movers)]
        shapes = self._scene.shapes
        self.static(
            "grid/things",
            rr.Points2D.from_fields(radii=0.0, show_labels=True, draw_order=50.0),
            rr.Boxes2D.from_fields(
                radii=[shape.radius for shape in shapes],
                colors=[rgba(shape.colour) for shape in shapes],
                draw_order=40.0,
            ),
            rr.Arrows2D.from_fields(colors=[rgba(c) for c in colours], radii=0.035, draw_order=45.0),
            rr.LineStrips2D.from_fields(colors=[rgba(c, 120) for c in colours], radii=0.05, draw_order=30.0),
        )
        self.static("grid/title", rr.Points2D.from_fields(radii=0.0, show_labels=True))
        self.static(
            "grid/goal", rr.Boxes2D.from_fields(colors=[rgba(palette.GOAL)], radii=0.04, show_labels=True)
        )

    def write(self, batch: Batch, phase: str) -> None:
        """Send the grid of each step of a batch."""
        self.send("grid/things", batch.times(), self._things(batch))
        self._send_sizes(batch)
        rows = np.flatnonzero(batch.records["t"] == 0)
        if len(rows):
            self._episodes(batch, rows, phase)

    def _send_sizes(self, batch: Batch) -> None:
        """Send the sizes of what is drawn where it may have been cleared; if static, they stayed for ever."""
        begins = batch.records["t"] == 0
        begins[0] = True
        begins[1:] |= np.diff(batch.time) != 1
        rows = np.flatnonzero(begins)
        sizes = np.array([shape.half_size for shape in self._scene.shapes], np.float32).reshape(-1, 2)
        each = np.broadcast_to(sizes, (len(rows), *sizes.shape))
        self.send("grid/things", batch.times(rows), instances(rr.Boxes2D, len(rows), half_sizes=each))

    def _things(self, batch: Batch) -> list[Any]:
        """Return the columns of what moves, its trail and its arrows."""
        scene, records, n = self._scene, batch.records, len(batch.records)
        state, movers = records["state"].astype(np.int64), len(scene.movers)
        points = scene.points[state]
        vectors = scene.arrows(
            state, records["action"].astype(np.int64), records["next_state"].astype(np.int64)
        )
        labels = points + self._label_offsets
        positions = np.concatenate((labels, self._fact_points(n)), axis=1)
        return [
            *instances(rr.Points2D, n, positions=positions, class_ids=self._classes(records, state)),
            *instances(rr.Boxes2D, n, centers=scene.shape_centres[state]),
            *instances(rr.Arrows2D, n, vectors=vectors, origins=points[:, :movers]),
            *strips(trails(scene, batch)),
        ]

    def _fact_points(self, n: int) -> NDArray[np.float32]:
        """Return where `t` and the rewards are written: below the grid, the rewards one below the other."""
        rewards = len(self._words.rewards)
        x = np.array([0.25] + [0.65] * rewards) * self._scene.columns
        y = self._scene.rows + FACTS_BELOW + LINE * np.array([0, *range(rewards)])
        points = np.stack((x, y), axis=1).astype(np.float32)
        return np.broadcast_to(points, (n, 1 + rewards, 2))

    def _classes(self, records: NDArray[np.void], state: NDArray[np.int64]) -> NDArray[np.uint16]:
        """Return the label of each point of each step, by number."""
        scene, words = self._scene, self._words
        events = events_of(scene.mdp, records)
        waits = np.arange(len(scene.passengers)) + words.passenger
        parts = [
            self._marks.of(scene.carried[state], events) + np.uint16(words.mark),
            np.where(scene.rides[state], words.riding, waits).astype(np.uint16),
            words.of_t(records["t"])[:, None],
        ]
        if words.rewards:
            parts.append(words.of_rewards(records["rewards"]))
        return np.concatenate(parts, axis=1)

    def _episodes(self, batch: Batch, rows: NDArray[np.int64], phase: str) -> None:
        """Send what changes with the episode: its title and the goals."""
        scene, records, n = self._scene, batch.records[rows], len(rows)
        numbers = zip(batch.episode[rows].tolist(), batch.number(rows).tolist(), strict=True)
        titles = texts([_title(phase, trained, own) for trained, own in numbers])
        points = place(n, scene.columns / 2, TITLE_Y)
        columns = instances(rr.Points2D, n, positions=points, labels=titles, colors=ink(n))
        self.send("grid/title", batch.times(rows), columns)
        goals = len(scene.goals)
        if not goals:
            return
        names = np.array([scene.description["things"][thing]["label"] for thing in scene.goals])
        self.send(
            "grid/goal",
            batch.times(rows),
            instances(
                rr.Boxes2D,
                n,
                centers=scene.goal_points[records["state"]],
                half_sizes=np.full((n, goals, 2), 0.44, np.float32),
                labels=np.broadcast_to(names, (n, goals)),
            ),
        )


def trails(scene: Scene, batch: Batch) -> NDArray[np.float32]:
    """Return the way each mover came, [n, movers, 6, 2]: the last five steps of the episode, to here."""
    states = np.concatenate((batch.before["state"], batch.records["state"]))
    was = scene.points[states, : len(scene.movers)]
    here = np.arange(len(batch.before), len(states))
    steps = np.minimum(batch.records["t"], here)  # of the way that is known
    lines = np.empty((len(here), len(scene.movers), TRAIL_STEPS + 1, 2), np.float32)
    for back in range(TRAIL_STEPS + 1):
        lines[:, :, TRAIL_STEPS - back] = was[here - np.minimum(back, steps)]
    return lines


def _title(phase: str, trained: int, own: int) -> str:
    if phase == "train":
        return f"TRAINING, episode {trained:,}"
    return f"EVALUATION after {trained:,} episodes, trial {own:,}"
