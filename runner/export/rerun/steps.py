"""Steps as Rerun columns: the grid, what the learners thought, and the map of values.

A frame is one step: the state it was taken in, the values that the learners saw there, and the move that
was made from there. Rows are sent some thousands at a time, all parts of a view in one entity: a row
costs more than what is in it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from runner.export.rerun.classes import Vocabulary
from runner.export.rerun.scene import (
    BAD_COLOUR,
    GOAL_COLOUR,
    INK,
    MOVER_COLOURS,
    TRAIL_STEPS,
    Marks,
    Scene,
    action_labels,
    agent_label,
    events_of_steps,
    own_actions,
)
from runner.export.rerun.thoughts import Thoughts
from runner.mdp import Mdp

BAR_LEFT, BAR_LENGTH, NUMBER_X, GREEDY_X, CHOSEN_X = 2.4, 5.6, 9.6, 11.7, 13.9
"""Columns of the table of values, in rows of height 1."""
LABEL_RISE: Final = 0.5
"""How much higher a point must be for its label, which is written below it, to stand in its row."""
_FINENESS: Final = 64


@dataclass(frozen=True, eq=False)
class Batch:
    """Steps of one phase, with what goes with them."""

    records: NDArray[np.void]
    thoughts: Thoughts
    episode: NDArray[np.int64]
    """[n]: training episodes; for evaluation those before it."""
    before: NDArray[np.void]
    """The steps before the first, at least as many as its trail shows."""
    time: NDArray[np.int64]
    """[n]: steps executed, this one included."""


class StepWriter:
    """Sends the steps of one phase of a run."""

    def __init__(
        self,
        stream: rr.RecordingStream,
        root: str,
        phase: str,
        mdp: Mdp,
        scene: Scene | None,
        marks: Marks | None,
        words: Vocabulary,
        learners: tuple[str, ...],
    ) -> None:
        self._stream = stream
        self.path = f"{root}/{phase}"
        self._phase = phase
        self._mdp = mdp
        self._scene = scene
        self._marks = marks
        self._words = words
        self._learners = learners
        self._own = own_actions(mdp)
        self._rows = bar_rows(mdp)

    def dress(self) -> None:
        """Log what never changes: sizes, colours, names."""
        counts = self._mdp.action_counts
        colours = [MOVER_COLOURS[i % len(MOVER_COLOURS)] for i in range(len(counts))]
        bars = [colour for colour, count in zip(colours, counts, strict=True) for _ in range(count)]
        series = [
            f"{agent_label(agent)} {name}"
            for agent, names in zip(self._mdp.agents, action_labels(self._mdp), strict=True)
            for name in names
        ]
        self._static(
            "q",
            rr.LineStrips2D.from_fields(colors=[_rgba(c) for c in bars], radii=0.22),
            rr.Points2D.from_fields(
                radii=[0.0] * sum(counts) + [0.22] * len(counts) * 2, show_labels=True, draw_order=40.0
            ),
            rr.SeriesLines(names=series),
        )
        self._static("reward", rr.SeriesLines(names=[f"reward {agent_label(a)}" for a in self._learners]))
        if self._scene is not None:
            self._dress_scene(self._scene)

    def _dress_scene(self, scene: Scene) -> None:
        movers = len(scene.movers)
        colours = [MOVER_COLOURS[i % len(MOVER_COLOURS)] for i in range(movers)]
        radii = [0.15] * movers + [0.08] * len(scene.passengers) + [0.0] * (1 + len(self._words.rewards))
        self._static(
            "grid/things",
            rr.Points2D.from_fields(radii=radii, show_labels=True, draw_order=40.0),
            rr.Arrows2D.from_fields(colors=[_rgba(c) for c in colours], radii=0.035, draw_order=45.0),
            rr.LineStrips2D.from_fields(colors=[_rgba(c, 120) for c in colours], radii=0.05, draw_order=30.0),
        )
        self._static(
            "grid/goal", rr.Boxes2D.from_fields(colors=[_rgba(GOAL_COLOUR)], radii=0.04, show_labels=True)
        )
        if scene.placements is None:
            return
        for i, learner in enumerate(self._learners):
            shown = self._shown_agents(i)
            pictures = scene.placements
            centres = _centres(pictures.height, pictures.width)
            aside = np.array([[0.22, 0.0]], np.float32)
            origins = np.concatenate(
                [centres + (k - (len(shown) - 1) / 2) * 2 * aside for k in range(len(shown))]
            )
            self._static(
                f"map/{learner}",
                rr.DepthImage.from_fields(
                    format=rr.components.ImageFormat(
                        width=pictures.width,
                        height=pictures.height,
                        channel_datatype=rr.ChannelDatatype.F32,
                        color_model=rr.ColorModel.L,
                    ),
                    colormap=rr.components.Colormap.Viridis,
                ),
            )
            tints = [_rgba(MOVER_COLOURS[k % len(MOVER_COLOURS)]) for k in shown for _ in range(len(centres))]
            self._static(
                f"map/{learner}/moves",
                rr.Arrows2D.from_fields(origins=origins, colors=tints, radii=0.05, draw_order=40.0),
            )
            self._static(
                f"map/{learner}/here",
                rr.Boxes2D.from_fields(colors=[_rgba(BAD_COLOUR)], radii=0.08, draw_order=50.0),
            )

    def send(self, batch: Batch) -> None:
        """Send a batch of steps."""
        records = batch.records
        times = self._times(batch)
        self._send("reward", times, rr.Scalars.columns(scalars=_rows(records["rewards"])))
        self._send("q", times, self._thoughts(batch))
        if self._scene is None:
            self._send("state", times, rr.Scalars.columns(scalars=records["state"].astype(np.float64)))
            self._send("action", times, rr.Scalars.columns(scalars=records["action"].astype(np.float64)))
            return
        self._send("grid/things", times, self._things(self._scene, batch))
        self._send_episodes(self._scene, batch)
        self._send_maps(self._scene, batch)

    def clear(self, ends: Iterable[int]) -> None:
        """Say that after these times nothing is known until the next step that was exported."""
        ends = list(ends)
        for part in ("grid", "q", "map"):
            self._stream.send_columns(
                f"{self.path}/{part}",
                [rr.TimeColumn("step", sequence=ends)],
                rr.Clear.columns(is_recursive=[True] * len(ends)),
            )

    # --- the grid ----------------------------------------------------------------------------------

    def _things(self, scene: Scene, batch: Batch) -> list[Any]:
        """Return the columns of what moves, its trail and its arrows."""
        records = batch.records
        n, movers = len(records), len(scene.movers)
        state = records["state"].astype(np.int64)
        points = scene.points[state]
        facts = self._fact_points(n)
        vectors = scene.arrows(
            state, records["action"].astype(np.int64), records["next_state"].astype(np.int64)
        )
        positions = np.concatenate((points, facts), axis=1)
        trail = _trail(scene, batch)
        return [
            *_columns(rr.Points2D, n, positions=positions, class_ids=self._thing_classes(scene, records)),
            *_columns(rr.Arrows2D, n, vectors=vectors, origins=points[:, :movers]),
            *rr.LineStrips2D.columns(strips=trail).partition([movers] * n),
        ]

    def _fact_points(self, n: int) -> NDArray[np.float32]:
        """Return where `t` and the rewards are written: below the grid."""
        assert self._scene is not None
        count = 1 + len(self._words.rewards)
        x = (np.arange(count) + 0.5) * self._scene.columns / count
        place = np.stack((x, np.full(count, self._scene.rows + 0.15)), axis=1).astype(np.float32)
        return np.broadcast_to(place, (n, count, 2))

    def _thing_classes(self, scene: Scene, records: NDArray[np.void]) -> NDArray[np.uint16]:
        assert self._marks is not None
        events = events_of_steps(self._mdp, records)
        marks = self._marks.of(scene.carried[records["state"]], events) + np.uint16(self._words.mark)
        waits = np.arange(len(scene.passengers)) + self._words.passenger
        passengers = np.where(scene.rides[records["state"]], self._words.riding, waits)
        parts = [
            marks,
            passengers,
            self._words.of_t(records["t"])[:, None],
        ]
        if self._words.rewards:
            parts.append(self._words.of_rewards(records["rewards"]))
        return np.concatenate(parts, axis=1).astype(np.uint16)

    def _send_episodes(self, scene: Scene, batch: Batch) -> None:
        """Send what changes with the episode: its title and the goals."""
        rows = np.flatnonzero(batch.records["t"] == 0)
        if not len(rows):
            return
        times = self._times(batch, rows)
        n, records = len(rows), batch.records[rows]
        title = [
            self._title(int(e), int(r)) for e, r in zip(batch.episode[rows], records["episode"], strict=True)
        ]
        place = np.broadcast_to(np.array([[scene.columns / 2, -0.55]], np.float32), (n, 1, 2))
        self._send(
            "grid/title",
            times,
            _columns(rr.Points2D, n, positions=place, labels=np.array(title)[:, None], colors=_ink(n)),
        )
        goals = len(scene.goals)
        if goals:
            names = [scene.description["things"][thing]["label"] for thing in scene.goals]
            self._send(
                "grid/goal",
                times,
                _columns(
                    rr.Boxes2D,
                    n,
                    centers=scene.goal_points[records["state"]],
                    half_sizes=np.full((n, goals, 2), 0.44, np.float32),
                    labels=np.broadcast_to(np.array(names), (n, goals)),
                ),
            )

    def _title(self, episode: int, recorded: int) -> str:
        if self._phase == "train":
            return f"TRAINING, episode {episode:,}"
        return f"EVALUATION after {episode:,} episodes, trial {recorded:,}"

    # --- thoughts ----------------------------------------------------------------------------------

    def _thoughts(self, batch: Batch) -> list[Any]:
        """Return the columns of the table of values: numbers, bars, greedy and chosen actions."""
        values, greedy = batch.thoughts.values, batch.thoughts.greedy
        records, n = batch.records, len(batch.records)
        agents = greedy.shape[1]
        chosen = self._own[records["action"]]
        learners = len(self._learners)
        bits = np.arange(agents) if learners == agents else np.zeros(agents, np.int64)
        explored = records["explored"][:, None] >> bits & 1
        first = np.array([row[0] for row in self._rows])
        marks = np.empty((n, 2 * agents, 2), np.float32)
        marks[:, :agents, 0], marks[:, agents:, 0] = GREEDY_X, CHOSEN_X
        marks[:, :agents, 1], marks[:, agents:, 1] = first + greedy, first + chosen
        numbers = np.concatenate(
            [np.stack((np.full(len(r), NUMBER_X), r - LABEL_RISE), axis=1) for r in self._rows]
        )
        positions = np.concatenate((np.broadcast_to(numbers, (n, *numbers.shape)), marks), axis=1)
        classes = np.concatenate(
            (
                self._words.values.of(values),
                np.full((n, agents), self._words.greedy),
                self._words.chosen + explored,
            ),
            axis=1,
        )
        return [
            *rr.Scalars.columns(scalars=values),
            *_columns(
                rr.Points2D, n, positions=positions.astype(np.float32), class_ids=classes.astype(np.uint16)
            ),
            *rr.LineStrips2D.columns(strips=self._bars(values)).partition([values.shape[1]] * n),
        ]

    def _bars(self, values: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return a bar a value, [n * values, 2 points, 2]: from the agent's lowest there to its highest."""
        n, at = len(values), 0
        bars = np.empty((n, values.shape[1], 2, 2), np.float32)
        bars[:, :, 0, 0] = BAR_LEFT
        for rows in self._rows:
            own = values[:, at : at + len(rows)]
            low = own.min(axis=1, keepdims=True)
            spread = own.max(axis=1, keepdims=True) - low
            share = (own - low) / np.where(spread > 0, spread, 1.0)
            length = np.ceil(share * BAR_LENGTH * _FINENESS) / _FINENESS + 2 / _FINENESS
            bars[:, at : at + len(rows), 1, 0] = BAR_LEFT + length
            bars[:, at : at + len(rows), :, 1] = rows[:, None]
            at += len(rows)
        return bars.reshape(-1, 2, 2)

    # --- maps --------------------------------------------------------------------------------------

    def _send_maps(self, scene: Scene, batch: Batch) -> None:
        pictures = scene.placements
        if pictures is None:
            return
        thoughts, records = batch.thoughts, batch.records
        centres = _centres(pictures.height, pictures.width)
        here = centres[pictures.pixel[records["state"]]][:, None]
        half = np.full_like(here, 0.5)
        rows = thoughts.renewed
        state = records["state"][rows]
        for i, learner in enumerate(self._learners):
            part = f"map/{learner}"
            self._send(
                f"{part}/here",
                self._times(batch),
                _columns(rr.Boxes2D, len(records), centers=here, half_sizes=half),
            )
            if not len(rows):
                continue
            times = self._times(batch, rows)
            self._send(part, times, _images(thoughts.value_maps[:, i]))
            vectors = self._map_vectors(i, thoughts.greedy_maps[:, i])
            self._send(f"{part}/moves", times, _columns(rr.Arrows2D, len(rows), vectors=vectors))
            labels = [
                f"greedy at step {time:,}: {pictures.names[context]}"
                for time, context in zip(
                    batch.time[rows].tolist(), pictures.context[state].tolist(), strict=True
                )
            ]
            place = np.broadcast_to(np.array([[pictures.width / 2, -0.9]], np.float32), (len(rows), 1, 2))
            self._send(
                f"{part}/label",
                times,
                _columns(
                    rr.Points2D,
                    len(rows),
                    positions=place,
                    labels=np.array(labels)[:, None],
                    colors=_ink(len(rows)),
                ),
            )

    def _shown_agents(self, learner: int) -> list[int]:
        """Return the agents whose moves a learner's table decides."""
        agents = range(len(self._mdp.agents))
        return [learner] if len(self._learners) == len(agents) else list(agents)

    def _map_vectors(self, learner: int, greedy: NDArray[np.int32]) -> NDArray[np.float32]:
        """Return the arrows of a learner's greedy actions, [k, agents * pixels, 2]."""
        assert self._scene is not None
        own_table = len(self._learners) == len(self._mdp.agents) > 1
        arrows = []
        for mover in self._scene.movers[:2]:
            agent = self._mdp.agents.index(self._scene.description["things"][mover]["agent"])
            if agent not in self._shown_agents(learner):
                continue
            moves = _own_moves(self._mdp, self._scene, agent)
            own = greedy if own_table else self._own[greedy, agent]
            arrows.append(np.where((greedy >= 0)[..., None], moves[own], 0))
        return np.concatenate(arrows, axis=1).astype(np.float32)

    # --- sending -----------------------------------------------------------------------------------

    def _times(self, batch: Batch, rows: Any = slice(None)) -> list[rr.TimeColumn]:
        return [
            rr.TimeColumn("step", sequence=batch.time[rows]),
            rr.TimeColumn("episode", sequence=batch.episode[rows]),
            rr.TimeColumn("t", sequence=batch.records["t"][rows].astype(np.int64)),
        ]

    def _send(self, part: str, times: list[rr.TimeColumn], columns: Iterable[Any]) -> None:
        self._stream.send_columns(f"{self.path}/{part}", times, columns)

    def _static(self, part: str, *archetypes: Any) -> None:
        for archetype in archetypes:
            self._stream.log(f"{self.path}/{part}", archetype, static=True)


def bar_rows(mdp: Mdp) -> list[NDArray[np.float64]]:
    """Return the height of each agent's rows in the table of values, from top to bottom."""
    rows: list[NDArray[np.float64]] = []
    top = 1.0
    for count in mdp.action_counts:
        rows.append(np.arange(count, dtype=np.float64) + top)
        top += count + 1.6
    return rows


def _own_moves(mdp: Mdp, scene: Scene, agent: int) -> NDArray[np.float32]:
    """Return the arrow of each own action of an agent in a map, [actions, 2]."""
    mover = next(
        k for k, m in enumerate(scene.movers) if scene.description["things"][m]["agent"] == mdp.agents[agent]
    )
    own = own_actions(mdp)[:, agent]
    first = [int(np.argmax(own == action)) for action in range(mdp.action_counts[agent])]
    return scene.moves[first, mover] * np.float32(1.2)


def _trail(scene: Scene, batch: Batch) -> NDArray[np.float32]:
    """Return the way each mover came, [n * movers, 6, 2]: the last five steps of the episode, to here."""
    movers, k = len(scene.movers), len(batch.before)
    states = np.concatenate((batch.before["state"], batch.records["state"])).astype(np.int64)
    back = np.minimum(np.arange(TRAIL_STEPS, -1, -1)[None, :], batch.records["t"][:, None].astype(np.int64))
    index = np.maximum(np.arange(k, k + len(batch.records))[:, None] - back, 0)
    way = scene.points[states[index], :movers]
    return np.ascontiguousarray(way.swapaxes(1, 2)).reshape(-1, TRAIL_STEPS + 1, 2)


def _centres(height: int, width: int) -> NDArray[np.float32]:
    pixel = np.arange(height * width)
    return np.stack((pixel % width + 0.5, pixel // width + 0.5), axis=1).astype(np.float32)


def _images(values: NDArray[np.float32]) -> Any:
    """Return the column of an image a row, float32."""
    return rr.DepthImage.columns(buffer=list(np.ascontiguousarray(values).view(np.uint8)))


def _rows(values: NDArray[Any]) -> NDArray[np.float64]:
    return np.ascontiguousarray(values, dtype=np.float64)


def _columns(archetype: Any, n: int, **parts: NDArray[Any]) -> list[Any]:
    """Return the columns of n rows of equally many instances; each part is [n, instances, ...]."""
    count = next(iter(parts.values())).shape[1]
    flat = {name: part.reshape(n * count, *part.shape[2:]) for name, part in parts.items()}
    return list(archetype.columns(**flat).partition([count] * n))


def _ink(n: int) -> NDArray[np.uint32]:
    red, green, blue, alpha = _rgba(INK)
    return np.full((n, 1), red << 24 | green << 16 | blue << 8 | alpha, np.uint32)


def _rgba(colour: str, alpha: int = 255) -> tuple[int, int, int, int]:
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16), alpha
