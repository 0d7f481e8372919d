"""Q-values at a step, sent as a table of values and as maps."""

from __future__ import annotations

from typing import Final

import numba
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from runner.drawing import palette
from runner.environments.naming import numbered_actions, spoken
from runner.export.rerun.columns import (
    Batch,
    Sender,
    images,
    instances,
    pixel_centres,
    ragged,
    repeated_point,
    rgba,
    scalars,
    strips,
    texts,
)
from runner.export.rerun.labels import Labels
from runner.export.rerun.layout import (
    BAR_LEFT,
    BAR_LENGTH,
    CHOSEN_X,
    GREEDY_X,
    LABEL_RISE,
    MAP_LABEL_Y,
    NUMBER_X,
    RunView,
    bar_rows,
)
from runner.export.rerun.metrics import series_lines
from runner.export.rerun.scene import Scene
from runner.export.rerun.step_values import StepValues

_BAR_FRACTION: Final = 64
"""The length of a bar is rounded to this fraction of a row's height: invisible, and smaller in the file."""
_LETTER_RISE: Final = 0.6
"""From a cell's centre up to the point of its letter, which is written below that point."""
_AGENT_OFFSET: Final = 0.21
"""From the centre of a pixel to the arrow of either of two agents."""
_ARROW_SCALE: Final = 1.2


class TableWriter(Sender):
    """Sends the table of values of one phase; its numbers as text are rounded, its scalars exact."""

    def __init__(self, stream: rr.RecordingStream, path: str, view: RunView, labels: Labels) -> None:
        super().__init__(stream, path)
        mdp = view.mdp
        self._labels = labels
        self._own = mdp.own_actions
        self._y = np.concatenate(bar_rows(mdp))
        agents, counts = len(mdp.agents), mdp.action_counts
        self._bounds = np.cumsum((0, *counts))
        """The first value of each agent, and the number of values."""
        self._explored_bit = np.arange(agents) if len(view.learners) == agents else np.zeros(agents, np.int64)
        height = self._y - LABEL_RISE
        columns = [
            np.stack((np.full_like(height, x), height), axis=1) for x in (NUMBER_X, GREEDY_X, CHOSEN_X)
        ]
        self._points = np.concatenate(columns).astype(np.float32)
        """The points of each action's number, then of its mark as greedy, then of its mark as chosen."""
        colours = [rgba(palette.agent(i)) for i, count in enumerate(counts) for _ in range(count)]
        names = zip(mdp.agents, numbered_actions(mdp), strict=True)
        series = [f"{spoken(agent)} {name}" for agent, actions in names for name in actions]
        self.send_static(
            "q",
            rr.LineStrips2D.from_fields(colors=colours, radii=0.22),
            rr.Points2D.from_fields(radii=0.0, show_labels=True, draw_order=40.0),
            series_lines(series),
        )

    def write(self, batch: Batch, values: StepValues) -> None:
        """Send the values of each step of a batch: as they were before its update."""
        q, labels = values.values, self._labels
        n, count = q.shape
        own = self._own[batch.records["action"]]
        explored = batch.records["explored"][:, None] >> self._explored_bit & 1
        classes = np.empty((n, 3 * count), np.uint16)
        bars = np.empty((n, count, 2, 2), np.float32)
        bars[:, :, 0, 0] = BAR_LEFT
        bars[..., 1] = self._y[:, None]
        ends = bars[:, :, 1, 0]
        marks = labels.value_marks
        _fill_table(q, values.greedy, own, explored, self._bounds, labels.unit, marks, classes, ends)
        columns = [*scalars(q), *instances(rr.Points2D, class_ids=classes), *strips(bars)]
        self.send("q", batch.times, columns)
        rows = values.map_rows  # the points never change, but are cleared with the rest
        points = np.broadcast_to(self._points, (len(rows), *self._points.shape))
        self.send("q", batch.times_at(rows), instances(rr.Points2D, positions=points))


class MapWriter(Sender):
    """Sends a learner's map in one phase: the greatest value and the greedy moves of every placement.

    The scene of the view has placements.
    """

    def __init__(
        self, stream: rr.RecordingStream, path: str, view: RunView, labels: Labels, learner: int
    ) -> None:
        super().__init__(stream, f"{path}/map")
        assert view.scene is not None
        assert view.scene.placements is not None
        mdp, scene, placements = view.mdp, view.scene, view.scene.placements
        self._learner = learner
        self._name = view.learners[learner]
        self._placements = placements
        is_joint = len(view.learners) != len(mdp.agents)
        agents = list(range(len(mdp.agents))) if is_joint else [learner]
        movers = [
            scene.mover_agents.index(mdp.agents[agent]) if mdp.agents[agent] in scene.mover_agents else 0
            for agent in agents
        ]
        self._order = placements.order(movers[0])
        self._pixel = np.argsort(self._order)[placements.pixel]
        """[S]: the pixel of each state."""
        self._centres = pixel_centres(placements.height, placements.width)
        x = (np.arange(len(agents)) - (len(agents) - 1) / 2) * 2 * _AGENT_OFFSET
        offsets = np.stack((x, np.zeros(len(agents))), axis=1).astype(np.float32)
        origins = self._centres[None] + offsets[:, None]
        self._letter_points = origins - np.array([0.0, _LETTER_RISE], np.float32)
        self._arrows, self._letters = _arrows_and_letters(scene, labels, agents, movers, is_joint)
        colours = [rgba(palette.agent(agent)) for agent in agents for _ in self._centres]
        text = rr.Points2D.from_fields(radii=0.0, show_labels=True, colors=[rgba(palette.MIDTONE)])
        pixels = rr.components.ImageFormat(
            width=placements.width,
            height=placements.height,
            channel_datatype=rr.ChannelDatatype.F32,
            color_model=rr.ColorModel.L,
        )
        arrows = rr.Arrows2D.from_fields(
            origins=origins.reshape(-1, 2), colors=colours, radii=0.06, draw_order=40.0
        )
        here = rr.Boxes2D.from_fields(colors=[rgba(palette.BAD)], radii=0.1, draw_order=50.0)
        letters = rr.Points2D.from_fields(radii=0.0, show_labels=True, draw_order=45.0)
        self.send_static(
            self._name, rr.DepthImage.from_fields(format=pixels, colormap=rr.components.Colormap.Viridis)
        )
        self.send_static(f"{self._name}/moves", arrows)
        self.send_static(f"{self._name}/here", here)
        self.send_static(f"{self._name}/stops", letters)
        self.send_static(f"{self._name}/label", text)

    def write(self, batch: Batch, values: StepValues) -> None:
        """Send where each step of a batch is in the map, and the maps that there are."""
        here = self._centres.take(self._pixel.take(batch.records["state"]), axis=0)[:, None]
        self.send(f"{self._name}/here", batch.times, instances(rr.Boxes2D, centers=here))
        rows = values.map_rows
        if not len(rows):
            return
        times, n, pixels = batch.times_at(rows), len(rows), len(self._centres)
        greedy = values.greedy_maps[:, self._learner][:, self._order]
        vectors = np.empty((n, len(self._arrows), pixels, 2), np.float32)
        counts = np.empty(n, np.int64)
        points = np.empty((n * vectors[0, ..., 0].size, 2), np.float32)
        classes = np.empty(len(points), np.uint16)
        total = _fill_moves(
            greedy, self._arrows, self._letters, self._letter_points, vectors, counts, points, classes
        )
        letters = ragged(rr.Points2D, counts, positions=points[:total], class_ids=classes[:total])
        contexts = self._placements.context[batch.records["state"][rows]].tolist()
        labels = [
            f"as of step {time:,}\n{self._placements.names[context]}"
            for time, context in zip(batch.time[rows].tolist(), contexts, strict=True)
        ]
        label_points = repeated_point(n, self._placements.width / 2, MAP_LABEL_Y)
        sizes = np.full((n, 1, 2), 0.5, np.float32)
        self.send(self._name, times, images(values.value_maps[:, self._learner][:, self._order]))
        self.send(f"{self._name}/here", times, instances(rr.Boxes2D, half_sizes=sizes))
        self.send(f"{self._name}/moves", times, instances(rr.Arrows2D, vectors=vectors.reshape(n, -1, 2)))
        self.send(f"{self._name}/stops", times, letters)
        self.send(
            f"{self._name}/label", times, instances(rr.Points2D, positions=label_points, labels=texts(labels))
        )


def _arrows_and_letters(
    scene: Scene, labels: Labels, agents: list[int], movers: list[int], is_joint: bool
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return the arrow, [agents, actions, 2], and the letter, [agents, actions], of each action."""
    own = scene.mdp.own_actions
    arrows, letters = [], []
    for agent, mover in zip(agents, movers, strict=True):
        count = scene.mdp.action_counts[agent]
        first = [int(np.argmax(own[:, agent] == action)) for action in range(count)]
        actions = own[:, agent] if is_joint else np.arange(count)
        arrows.append((scene.moves[first, mover] * np.float32(_ARROW_SCALE))[actions])
        letters.append(labels.stops[agent][actions])
    return np.stack(arrows), np.stack(letters)


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator,unused-ignore]
def _fill_table(
    values: NDArray[np.float64],
    greedy: NDArray[np.int64],
    own: NDArray[np.int64],
    explored: NDArray[np.int64],
    bounds: NDArray[np.int64],
    unit: float,
    marks: tuple[int, ...],
    classes: NDArray[np.uint16],
    ends: NDArray[np.float32],
) -> None:
    """Fill in the label of each value, the marks of greedy and chosen actions, and where the bars end.

    Args:
        values: [n, values].
        greedy: [n, agents], the greedy action of each agent.
        own: [n, agents], its chosen action.
        explored: [n, agents], whether that was explored.
        bounds: [agents + 1], the first value of each agent, and the number of values.
        unit: `Labels.unit`, the rounding of the labels of values.
        marks: `Labels.value_marks`.
        classes: [n, 3 * values], filled with the labels of values, greedy and chosen actions.
        ends: [n, values], filled: a bar reaches from the agent's lowest value in a step to its highest.
    """
    unmarked, is_greedy, exploited, is_explored, first_level, lowest, levels = marks
    count = values.shape[1]
    for k in range(len(values)):
        for i in range(count):
            value = 0.0 if np.isnan(values[k, i]) else values[k, i]
            level = min(max(np.rint(value / unit) - lowest, 0.0), levels - 1.0)
            classes[k, i] = first_level + int(level)
            classes[k, count + i] = classes[k, 2 * count + i] = unmarked
        for agent in range(len(bounds) - 1):
            start, stop = bounds[agent], bounds[agent + 1]
            classes[k, count + start + greedy[k, agent]] = is_greedy
            chosen = is_explored if explored[k, agent] else exploited
            classes[k, 2 * count + start + own[k, agent]] = chosen
            low, high = np.inf, -np.inf
            for i in range(start, stop):
                low, high = min(low, values[k, i]), max(high, values[k, i])
            scale = BAR_LENGTH * _BAR_FRACTION / (high - low) if high > low else 0.0
            for i in range(start, stop):
                ends[k, i] = BAR_LEFT + np.ceil((values[k, i] - low) * scale) / _BAR_FRACTION


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator,unused-ignore]
def _fill_moves(
    greedy: NDArray[np.int32],
    arrows: NDArray[np.float32],
    letters: NDArray[np.int64],
    points: NDArray[np.float32],
    vectors: NDArray[np.float32],
    counts: NDArray[np.int64],
    places: NDArray[np.float32],
    classes: NDArray[np.uint16],
) -> int:
    """Fill in the arrows of greedy actions, and the letters of those that do not move.

    Args:
        greedy: [k, pixels], greedy actions; -1 for no state.
        arrows: [agents, actions, 2], the arrow of each action.
        letters: [agents, actions], its letter; -1 for none.
        points: [agents, pixels, 2], where a letter is written.
        vectors: [k, agents, pixels, 2], filled with arrows; zero for no state.
        counts: [k], filled with the number of letters.
        places: [letters, 2], filled with their points, one map after another.
        classes: [letters], filled with the letters.

    Returns:
        The number of letters in all maps.
    """
    total = 0
    for k in range(len(greedy)):
        before = total
        for agent in range(len(arrows)):
            for pixel in range(greedy.shape[1]):
                action = greedy[k, pixel]
                vectors[k, agent, pixel, 0] = arrows[agent, action, 0] if action >= 0 else 0.0
                vectors[k, agent, pixel, 1] = arrows[agent, action, 1] if action >= 0 else 0.0
                if action >= 0 and letters[agent, action] >= 0:
                    places[total, 0] = points[agent, pixel, 0]
                    places[total, 1] = points[agent, pixel, 1]
                    classes[total] = letters[agent, action]
                    total += 1
        counts[k] = total - before
    return total
