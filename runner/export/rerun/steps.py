"""The steps of one phase of a job: rewards, the grid, a log of events, and the Q-values.

A frame is one step: the state it was taken in and the move that was made from there. Q-values are read by
replaying the tables from the recorded steps, so everything shown is exact for its step. Where a repair lost
steps, the values after them are unknown up to the next snapshot, and are left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache, partial
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from runner.drawing import palette
from runner.environments.mdp import Mdp, events_of
from runner.environments.naming import events_in_words, numbered_actions, spoken, states_in_words
from runner.export.rerun.metrics import EVENTS, log_track, phase_colours, series_lines
from runner.export.rerun.scene import GridLabels, Placements, Scene, crossing_lines
from runner.export.rerun.tracks import (
    GREY,
    Points,
    Times,
    Track,
    TrackView,
    agent_colours,
    centred,
    columns,
    labels_alone,
    pairs,
    repeated,
    scalars,
    text_track,
)
from runner.learning.kernel import StateProbe
from runner.recording.reader import Recording
from runner.replay.tables import TableReplay, are_within, known_steps
from runner.util.arrays import Flags, Floats, Ints, Ints32, Records

TRAIL_STEPS: Final = 5
TITLE_Y: Final = -0.62
GRID_MARGIN: Final = 0.8
NO_ARRAY: Final[NDArray[Any]] = np.empty(0)

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
_BAR_FRACTION: Final = 64
"""The length of a bar is rounded to this fraction of a row's height: invisible, and smaller in the file."""
_LETTER_RISE: Final = 0.6
"""From a cell's centre up to the point of its letter, which is written below that point."""
_AGENT_OFFSET: Final = 0.21
"""From the centre of a pixel to the arrow of either of two agents."""
_ARROW_SCALE: Final = 1.2


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
        back = np.minimum(np.arange(TRAIL_STEPS, -1, -1), t[:, None])
        shown = states[np.arange(len(t))[:, None] + TRAIL_STEPS - back]
        return scene.mover_points.take(shown, axis=0).swapaxes(1, 2)

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


class ValueReader:
    """Reads the Q-values at the steps of a recorded job, with maps of placements if there are any."""

    def __init__(self, recording: Recording, scene: Scene | None) -> None:
        self._recording, mdp = recording, recording.mdp
        placements = scene.placements if scene else None
        self._context = placements.context if placements else np.zeros(mdp.states, np.int64)
        self._states = placements.states if placements else np.empty((1, 0), np.int32)
        self._known = known_steps(recording)
        self._replay: TableReplay | None = None
        self._last = (-2, -1)
        """Time and context of the step before."""

    def batches(self, batch: Batch, trained: Ints, stride: int) -> Iterator[Batch]:
        """Yield a batch in parts with known or unknown values, as they were before the update of each step.

        `trained` are the training steps before each step, and `stride` the number of updates that it makes.
        """
        is_known = are_within(self._known, trained)
        edges = [0, *np.flatnonzero(np.diff(is_known)) + 1, len(trained)]
        for start, stop in pairwise(edges):
            rows = slice(start, stop)
            part = Batch(batch.records[rows], batch.at(rows), batch.number[rows])
            yield self._with_values(part, trained[rows], stride) if is_known[start] else part

    def _with_values(self, batch: Batch, trained: Ints, stride: int) -> Batch:
        """Return a batch with values, and with maps where anything but the movers changes."""
        steps = batch.records
        context = self._context[batch.records["state"]]
        is_new = batch.starts(self._last[0]) | (np.diff(context, prepend=self._last[1]) != 0)
        is_new |= steps["t"] == 0
        self._last = int(batch.times["step"][-1]), int(context[-1])
        replay = self._replay = self._replay or TableReplay(self._recording, int(trained[0]))
        tables = replay.empty_rows(len(steps))
        map_rows = np.flatnonzero(is_new)
        shape = len(map_rows), len(self._recording.agents), self._states.shape[1]
        maps = np.empty(shape, np.float32), np.empty(shape, np.int32)
        probe = StateProbe(map_rows, self._states[context[map_rows]], *maps)
        edges = [0, *np.flatnonzero(np.diff(trained) != stride) + 1, len(steps)]
        for start, stop in pairwise(edges):
            if replay.step != trained[start]:
                replay.seek(int(trained[start]))
            batch_probe = probe.between(start, stop)
            if stride:
                replay.apply(steps[start:stop], tables[start:stop], batch_probe)
            else:
                replay.read(batch_probe)
                tables[start:stop] = replay.values_in(steps["state"][start:stop])
        return Batch(*batch[:3], *self._by_agent(tables), map_rows, *maps)

    def _by_agent(self, tables: Floats) -> tuple[Floats, Ints]:
        """Return values and greedy actions by agent, of rows by learner."""
        counts = self._recording.mdp.action_counts
        if tables.shape[1] == len(counts):
            by_agent = [tables[:, i, :count] for i, count in enumerate(counts)]
            return np.concatenate(by_agent, axis=1), np.stack([q.argmax(axis=1) for q in by_agent], axis=1)
        joint = tables[:, 0].reshape(-1, *counts)
        axes = set(range(1, joint.ndim))
        best = [joint.max(axis=tuple(axes - {axis})) for axis in sorted(axes)]
        return np.concatenate(best, axis=1), self._recording.mdp.own_actions[tables[:, 0].argmax(axis=1)]


class ValueTracks:
    """Makes the table of values of one phase: its numbers as text are rounded, its scalars exact."""

    def __init__(self, phase: str, labels: GridLabels) -> None:
        self._phase, self._labels, mdp = phase, labels, labels.mdp
        agents = len(mdp.agents)
        self._own_actions = mdp.own_actions
        self._agent = np.repeat(np.arange(agents), mdp.action_counts)
        """[values]: the agent of each value."""
        self._first = np.cumsum((0, *mdp.action_counts[:-1]))
        self._explored_bit = np.arange(agents) * (len(labels.learners) == agents)
        y = self._y = 1.0 + np.arange(len(self._agent)) + _AGENT_GAP * self._agent
        """[values]: the row of each value in the table, from top to bottom."""
        self._points = pairs((x, row - LABEL_RISE) for x in (NUMBER_X, GREEDY_X, CHOSEN_X) for row in y)
        """The points of each action's number, then of its mark as greedy, then of its mark as chosen."""
        words = []
        lines = []
        colours = agent_colours(range(agents))
        for i, names in enumerate(numbered_actions(mdp)):
            agent = spoken(mdp.agents[i])
            rows = y[self._agent == i]
            words.append((NAME_X, rows[0] - 1.15, agent.upper(), colours[i]))
            words += [(NAME_X, row, name, GREY) for row, name in zip(rows, names, strict=True)]
            lines += [f"{agent} {name}" for name in names]
        middle = BAR_LEFT + BAR_LENGTH / 2
        headings = {middle: "worst to best", NUMBER_X: "Q", GREEDY_X: "greedy", CHOSEN_X: "chosen"}
        words += [(x, -0.15, heading, GREY) for x, heading in headings.items()]
        xs, ys, texts, tints = zip(*words, strict=True)
        points = np.stack((xs, np.array(ys) - LABEL_RISE), axis=1)
        bounds = rrb.VisualBounds2D(x_range=(-0.4, TABLE_WIDTH), y_range=(TABLE_TOP, float(y[-1]) + 0.9))
        name = "Q-values of this state, before the move"
        view = TrackView("values", name, rrb.Spatial2DView, {"visual_bounds": bounds})
        words_style = labels_alone(positions=points, labels=texts, colors=tints)
        style = [
            rr.LineStrips2D.from_fields(colors=agent_colours(self._agent.tolist()), radii=0.22),
            labels_alone(draw_order=40.0),
            series_lines(lines),
        ]
        self.still = [
            Track("table/words", static=[words_style], view=view),
            Track(f"{phase}/q", static=style, view=view),
        ]
        """What never changes; the words around the table for both phases."""

    def of(self, batch: Batch) -> Iterator[Track]:
        """Yield the values of each step of a batch as they were before its update."""
        q, labels, first, agent = batch.values, self._labels, self._first, self._agent
        n, count = q.shape
        actions = self._own_actions[batch.records["action"]]
        is_explored = batch.records["explored"][:, None] >> self._explored_bit & 1
        classes = np.zeros((n, 3 * count), np.uint16)
        classes[:, :count] = labels.of_values(q)
        explored, exploited = labels.number("explored", palette.BAD), labels.number("greedy", palette.GOOD)
        steps = np.arange(n)[:, None]
        classes[steps, count + first + batch.greedy] = labels.number("●")
        classes[steps, 2 * count + first + actions] = np.where(is_explored, explored, exploited)
        low, high = (bound.reduceat(q, first, axis=1) for bound in (np.minimum, np.maximum))
        span = high - low
        scale = np.divide(BAR_LENGTH * _BAR_FRACTION, span, out=np.zeros_like(span), where=span > 0)
        bars = np.empty((n, count, 2, 2), np.float32)
        bars[:, :, 0, 0] = BAR_LEFT
        bars[:, :, 1, 0] = BAR_LEFT + np.ceil((q - low[:, agent]) * scale[:, agent]) / _BAR_FRACTION
        bars[..., 1] = self._y[:, None]
        labels_and_bars = [*columns(rr.Points2D, class_ids=classes), *columns(rr.LineStrips2D, strips=bars)]
        yield Track(f"{self._phase}/q", batch.times, [*scalars(q), *labels_and_bars])
        if len(rows := batch.map_rows):  # the points never change, but are cleared with the rest
            points = repeated(self._points, len(rows))
            yield Track(f"{self._phase}/q", batch.at(rows), columns(rr.Points2D, positions=points))


class MapTracks:
    """Makes a learner's map in one phase: the greatest value and the greedy moves of every placement."""

    def __init__(self, phase: str, labels: GridLabels, placements: Placements, learner: int) -> None:
        scene = placements.scene
        mdp = labels.mdp
        name = labels.learners[learner]
        self._learner = learner
        self._path = f"{phase}/map/{name}"
        self._placements = placements
        is_joint = len(labels.learners) != len(mdp.agents)
        agents = [*range(len(mdp.agents))] if is_joint else [learner]
        movers = scene.agents
        agent_name = mdp.agents[agents[0]]
        self._order = placements.order(movers.index(agent_name) if agent_name in movers else 0)
        row, column = np.divmod(np.arange(len(self._order)), placements.width)
        centres = np.stack((column + 0.5, row + 0.5), axis=1).astype(np.float32)
        self._here = centres[self._order[placements.pixel]]  # the order is its own inverse
        """[S, 2]: the centre of each state's pixel."""
        offsets = pairs((x, 0.0) for x in centred(len(agents), 2 * _AGENT_OFFSET))
        self._origins = centres + offsets[:, None]
        """[agents, pixels, 2]."""
        actions = mdp.own_actions.T if is_joint else [np.arange(mdp.action_counts[learner])]
        # The last action stands for pixels without a state.
        padded_actions = np.pad(actions, ((0, 0), (0, 1)), constant_values=-1)
        self._arrows = scene.own_moves[padded_actions] * np.float32(_ARROW_SCALE)
        self._letters = labels.stops[np.array(agents)[:, None], padded_actions]
        height, width = placements.height, placements.width
        lines = crossing_lines(range(0, height + 1, scene.rows), range(0, width + 1, scene.columns))
        pixels = rr.components.ImageFormat(
            width=width,
            height=height,
            channel_datatype=rr.ChannelDatatype.F32,
            color_model=rr.ColorModel.L,
        )
        colours = agent_colours(np.repeat(agents, len(self._order)).tolist())
        parts = {
            "frame": rr.LineStrips2D(lines, colors=[(255, 255, 255)], radii=0.06, draw_order=30),
            self._path: rr.DepthImage.from_fields(format=pixels, colormap=rr.components.Colormap.Viridis),
            self._path + "/moves": rr.Arrows2D.from_fields(
                origins=self._origins.reshape(-1, 2), colors=colours, radii=0.06, draw_order=40.0
            ),
            self._path + "/here": rr.Boxes2D.from_fields(
                colors=[palette.rgb(palette.BAD)], radii=0.1, draw_order=50.0
            ),
            self._path + "/stops": labels_alone(draw_order=45.0),
            self._path + "/label": labels_alone(colors=[GREY]),
        }
        bounds = rrb.VisualBounds2D(x_range=(-0.5, width + 0.5), y_range=(-3.2, height + 0.5))
        title = f"{spoken(name)}: max Q, greedy moves"
        view = TrackView("values", title, rrb.Spatial2DView, {"visual_bounds": bounds})
        self.still = [Track(entity, static=[static], view=view) for entity, static in parts.items()]
        """What never changes; the frame for both phases and all learners."""

    def of(self, batch: Batch) -> Iterator[Track]:
        """Yield where each step of a batch is in the map, and the maps that there are."""
        state = batch.records["state"]
        path = self._path
        placements = self._placements
        here = self._here.take(state, axis=0)[:, None]
        boxes = columns(rr.Boxes2D, centers=here, half_sizes=np.full_like(here, 0.5))
        yield Track(f"{path}/here", batch.times, boxes)
        if not (n := len(batch.map_rows)):
            return
        times = batch.at(batch.map_rows)
        maps = (batch.value_maps, batch.greedy_maps)
        values, greedy = (agent_map[:, self._learner][:, self._order] for agent_map in maps)
        with np.errstate(all="ignore"):
            low, high = np.nanmin(values, axis=1), np.nanmax(values, axis=1)
        ranges = np.stack((low, np.where(high > low, high, low + 1)), axis=1).astype(np.float64)
        buffers = np.ascontiguousarray(values).view(np.uint8)
        image = rr.DepthImage.columns(buffer=buffers, depth_range=np.nan_to_num(ranges))
        vectors = self._arrows[:, greedy].swapaxes(0, 1).reshape(n, -1, 2)
        letters = self._letters[:, greedy].swapaxes(0, 1)
        is_letter = letters >= 0
        points = repeated(self._origins - np.array([0.0, _LETTER_RISE], np.float32), n)
        stops = rr.Points2D.columns(
            positions=points[is_letter], class_ids=letters[is_letter].astype(np.uint16)
        ).partition(is_letter.sum(axis=(1, 2)))
        contexts = placements.names[placements.context[state[batch.map_rows]]]
        labels = [
            f"as of step {time:,}\n{context}"
            for time, context in zip(times["step"].tolist(), contexts, strict=True)
        ]
        moves = columns(rr.Arrows2D, vectors=vectors)
        for part, image_or_labels in (("", image), ("/moves", moves), ("/stops", stops)):
            yield Track(path + part, times, image_or_labels)
        yield text_track(f"{path}/label", times, (placements.width / 2, MAP_LABEL_Y), labels)
