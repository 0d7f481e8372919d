"""The steps of one phase: rewards, the grid, and a log of events.

A frame is one step: the state it was taken in and the move that was made from there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import rerun as rr
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from runner.drawing import palette
from runner.environments.mdp import Mdp, events_of
from runner.environments.naming import events_in_words, spoken, states_in_words
from runner.export.rerun.columns import Batch, Sender, instances, repeated_point, rgba, scalars, strips, texts
from runner.export.rerun.labels import Labels
from runner.export.rerun.layout import RunView
from runner.export.rerun.metrics import phase_colours, series_lines
from runner.export.rerun.scene import Scene

TRAIL_STEPS: Final = 5
TITLE_Y: Final = -0.62
STATUS_Y: Final = 0.35
"""From the grid to `t` and the rewards below it."""
STATUS_LINE: Final = 0.3
MOVER_LABEL_Y: Final = -0.5
"""From a mover to the top of its label: above what is drawn."""
PASSENGER_LABEL_Y: Final = 0.12


class StepWriter(Sender):
    """Sends a phase of a tabular run: the grid, or without a scene states and actions as lines."""

    def __init__(
        self,
        stream: rr.RecordingStream,
        view: RunView,
        phase: str,
        labels: Labels,
        with_rewards: bool = False,
    ) -> None:
        super().__init__(stream, f"{view.root}/{phase}")
        self._phase = phase
        self._mdp = view.mdp
        self._with_rewards = with_rewards
        self._events = _EventLog(view.mdp, phase)
        self._grid = _Grid(stream, self.path, phase, view.scene, labels) if view.scene else None
        self.covered: list[tuple[int, int]] = []
        """The stretches of time whose steps were sent: the first, and the one after the last."""
        if with_rewards:
            names = [f"reward {spoken(learner)}" for learner in view.learners]
            self.send_static("reward", series_lines(names, phase_colours(phase, len(names))))
        if not view.scene:
            for name, colour in zip(("state", "action"), phase_colours(phase, 2), strict=True):
                self.send_static(name, series_lines([f"{name} ({phase})"], [colour]))

    def write(self, batch: Batch) -> None:
        """Send a batch of steps."""
        records = batch.records
        if self._with_rewards:
            self.send("reward", batch.times, scalars(records["rewards"]))
        events = events_of(self._mdp, records)
        rows, columns = self._events.columns(batch, events)
        if len(rows):
            self.send("events", batch.times_at(rows), columns)
        if self._grid:
            self._grid.write(batch, events)
        else:
            for name in ("state", "action"):
                self.send(name, batch.times, scalars(records[name].astype(np.float64)[:, None]))
        breaks = np.flatnonzero(np.diff(batch.time) != 1) + 1
        for stretch in np.split(batch.time, breaks):
            start, stop = int(stretch[0]), int(stretch[-1]) + 1
            if self.covered and self.covered[-1][1] == start:
                start = self.covered.pop()[0]
            self.covered.append((start, stop))

    def clear_gaps(self, parts: Sequence[str], last: int) -> None:
        """Clear parts after each stretch of steps that ends before the time `last`."""
        if ends := [stop for _, stop in self.covered if stop <= last]:
            for part in parts:
                self.clear(part, ends)


class _Grid(Sender):
    """The grid: movers, passengers, goals, trails and moves.

    The movers, passengers and texts of a step are points of one entity, with their arrows and trails, because
    a row costs more than its content.
    """

    def __init__(
        self, stream: rr.RecordingStream, path: str, phase: str, scene: Scene, labels: Labels
    ) -> None:
        super().__init__(stream, path)
        self._phase = phase
        self._scene = scene
        self._labels = labels
        self._label_points = self._place_labels()
        self._before: NDArray[np.int64] | None = None
        """The last states of the batch before, as many as a trail may show."""
        shapes = [shape for _, shape in scene.shapes]
        self._half_sizes = np.array([shape.half_size for shape in shapes], np.float32).reshape(-1, 2)
        colours = [palette.agent(i) for i in range(len(scene.movers))]
        self.send_static(
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
        text = rr.Points2D.from_fields(radii=0.0, show_labels=True, colors=[rgba(palette.MIDTONE)])
        self.send_static("grid/title", text)
        goal = rr.Boxes2D.from_fields(colors=[rgba(palette.GOAL)], radii=0.04, show_labels=True)
        self.send_static("grid/goal", goal)

    def write(self, batch: Batch, events: NDArray[np.uint32]) -> None:
        """Send the grid of each step of a batch."""
        scene, records, labels = self._scene, batch.records, self._labels
        state = records["state"].astype(np.int64)
        vectors = scene.arrows(
            state, records["action"].astype(np.int64), records["next_state"].astype(np.int64)
        )
        origins = scene.mover_points.take(state, axis=0)
        waiting = np.arange(len(scene.passengers)) + labels.waiting
        numbers = [
            labels.of_movers(scene.is_carrying[state], events),
            np.where(scene.is_carried[state], labels.riding, waiting).astype(np.uint16),
            labels.of_t(records["t"])[:, None],
            labels.of_rewards(records["rewards"]),
        ]
        columns = [
            *instances(
                rr.Points2D,
                positions=self._label_points.take(state, axis=0),
                class_ids=np.concatenate(numbers, axis=1),
            ),
            *instances(rr.Boxes2D, centers=scene.shape_centres.take(state, axis=0)),
            *instances(rr.Arrows2D, vectors=vectors, origins=origins),
            *strips(self._trails(state, records["t"])),
        ]
        self.send("grid/things", batch.times, columns)
        self._send_sizes(batch)
        rows = np.flatnonzero(records["t"] == 0)
        if len(rows):
            self._begin_episodes(batch, rows)

    def _place_labels(self) -> NDArray[np.float32]:
        """Return the points of all texts in each state, [S, texts, 2]: `t` and the rewards below the grid."""
        scene, rewards = self._scene, len(self._labels.rewards)
        offsets = [[0.0, MOVER_LABEL_Y]] * len(scene.movers) + [[0.0, PASSENGER_LABEL_Y]] * len(
            scene.passengers
        )
        points = scene.points + np.array(offsets, np.float32).reshape(-1, 2)
        x = np.array([0.25] + [0.65] * rewards) * scene.columns
        y = scene.rows + STATUS_Y + STATUS_LINE * np.array([0, *range(rewards)])
        status = np.stack((x, y), axis=1).astype(np.float32)
        return np.concatenate((points, np.broadcast_to(status, (len(points), *status.shape))), axis=1)

    def _trails(self, state: NDArray[np.int64], t: NDArray[np.integer]) -> NDArray[np.float32]:
        """Return each mover's path over the last steps of the episode, [n, movers, TRAIL_STEPS + 1, 2]."""
        before = np.repeat(state[:1], TRAIL_STEPS) if self._before is None else self._before
        states = np.concatenate((before, state))
        self._before = states[-TRAIL_STEPS:]
        # A point as one number of eight bytes: fewer and larger values to copy.
        points = self._scene.mover_points.take(states, axis=0).view(np.int64)[..., 0]
        lines = np.ascontiguousarray(sliding_window_view(points, TRAIL_STEPS + 1, axis=0))
        early = np.flatnonzero(t < TRAIL_STEPS)
        back = np.minimum(np.arange(TRAIL_STEPS, -1, -1), t[early, None])
        lines[early] = points[early[:, None] + TRAIL_STEPS - back].swapaxes(1, 2)
        return lines[..., None].view(np.float32)

    def _send_sizes(self, batch: Batch) -> None:
        """Send the sizes of boxes wherever the grid may have been cleared; static ones would stay visible."""
        begins = batch.records["t"] == 0
        begins[0] = True
        begins[1:] |= np.diff(batch.time) != 1
        rows = np.flatnonzero(begins)
        sizes = np.broadcast_to(self._half_sizes, (len(rows), *self._half_sizes.shape))
        self.send("grid/things", batch.times_at(rows), instances(rr.Boxes2D, half_sizes=sizes))

    def _begin_episodes(self, batch: Batch, rows: NDArray[np.int64]) -> None:
        """Send what changes with the episode: its title and the goals."""
        scene, times, n = self._scene, batch.times_at(rows), len(rows)
        numbers = zip(batch.episode[rows].tolist(), batch.number(rows).tolist(), strict=True)
        is_training = self._phase == "train"
        titles = [
            f"TRAINING, episode {trained:,}"
            if is_training
            else f"EVALUATION after {trained:,} episodes, trial {trial:,}"
            for trained, trial in numbers
        ]
        points = repeated_point(n, scene.columns / 2, TITLE_Y)
        self.send("grid/title", times, instances(rr.Points2D, positions=points, labels=texts(titles)))
        if not scene.goals:
            return
        names = np.array([scene.label(goal) for goal in scene.goals])
        columns = instances(
            rr.Boxes2D,
            centers=scene.goal_points[batch.records["state"][rows]],
            half_sizes=np.full((n, len(names), 2), 0.44, np.float32),
            labels=np.broadcast_to(names, (n, len(names))),
        )
        self.send("grid/goal", times, columns)


class _EventLog:
    """The text log: beginnings and ends of episodes, pickups, collisions; not the many illegal actions."""

    def __init__(self, mdp: Mdp, phase: str) -> None:
        self._mdp = mdp
        self._kind = "episode" if phase == "train" else "trial"
        self._states = states_in_words(mdp)
        self._mask = np.uint32(
            sum(1 << bit for bit, name in enumerate(mdp.event_names) if ".illegal" not in name)
        )
        self._entries: dict[tuple[int, int], tuple[str, str]] = {}
        """Text and level by events and ending."""

    def columns(self, batch: Batch, events: NDArray[np.uint32]) -> tuple[NDArray[np.int64], list[Any]]:
        """Return the rows of a batch with an entry in the log, ascending, and the entries as columns."""
        records = batch.records
        masks = events & self._mask
        endings = np.where(records["terminated"], 1, np.where(records["truncated"], 2, 0))
        begins, happens = np.flatnonzero(records["t"] == 0), np.flatnonzero((masks != 0) | (endings != 0))
        beginnings = zip(batch.number(begins).tolist(), records["state"][begins].tolist(), strict=True)
        entries = [
            (f"{self._kind} {number:,} begins: {self._states[state]}", "INFO") for number, state in beginnings
        ]
        happenings = zip(
            *(part[happens].tolist() for part in (masks, endings, records["t"] + 1)), strict=True
        )
        entries += [self._entry(*happening) for happening in happenings]
        rows = np.concatenate((begins, happens))
        order = np.argsort(rows, kind="stable")
        lines = [[entries[i][part] for i in order] for part in (0, 1)]
        return rows[order], instances(rr.TextLog, text=texts(lines[0]), level=texts(lines[1]))

    def _entry(self, mask: int, ending: int, length: int) -> tuple[str, str]:
        """Return text and level for a mask of events and an ending (0: none, 1: terminal, 2: time-out)."""
        if (mask, ending) not in self._entries:
            text = events_in_words(self._mdp, mask)
            is_bad = "collision" in text and not mask & self._mdp.success_mask
            end = ("", "episode over", "time-out")[ending]
            self._entries[mask, ending] = ", ".join(filter(None, (text, end))), "WARN" if is_bad else "INFO"
        text, level = self._entries[mask, ending]
        return (f"{text} after {length} steps" if ending else text), level
