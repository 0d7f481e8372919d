"""Somebody's own loop in Rerun: its episodes, what it logged, its frames, and the steps that are chosen."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Any, Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from runner.export.rerun.classes import vocabulary_of
from runner.export.rerun.columns import Batch, Sender, scalars
from runner.export.rerun.events import EventWriter
from runner.export.rerun.grid import GridWriter
from runner.export.rerun.layout import Shown, draw_background, whole_axis
from runner.export.rerun.lines import phase_colours, series_lines
from runner.export.rerun.scene import TRAIL_STEPS, marks_of, scene_of
from runner.export.rerun.selection import (
    Selection,
    Span,
)
from runner.recording import schema
from runner.recording.reader import Recording
from runner.recording.spaces import leaves_of
from runner.replay.checks import check_steps

BATCH: Final = 8_192
MOST_LINES: Final = 16
"""Numbers of an observation or action that are drawn as lines."""
PHASES: Final = ("train", "eval")


class LoopExporter:
    """Sends one loop to a stream."""

    def __init__(self, stream: rr.RecordingStream, recording: Recording, selection: Selection, root: str):
        self._stream = stream
        self._recording = recording
        self._selection = selection
        self._root = root
        self._learners = recording.agents
        self._scene = scene_of(recording.mdp) if recording.tabular else None
        self._logged: list[str] = []
        self._frames = [phase for phase in PHASES if any(True for _ in recording.messages(_frame(phase)))]
        self._arrays: list[str] = []
        self._last = 0
        """The last step on the timeline at which anything was sent."""

    def blueprint(self, title: str) -> Any:
        """Return the arrangement of what there is; call it after `export`."""
        root = self._root
        left: list[Any] = []
        if self._scene is not None:
            contents = [f"{root}/scene/**", *(f"{root}/{phase}/grid/**" for phase in PHASES)]
            bounds = rrb.VisualBounds2D(
                x_range=(-0.8, self._scene.columns + 0.8), y_range=(-0.9, self._scene.rows + 0.9)
            )
            left.append(
                rrb.Spatial2DView(origin=f"{root}/", contents=contents, visual_bounds=bounds, name=title)
            )
        left += [
            rrb.Spatial2DView(origin=f"{root}/{phase}/frame", name=f"Frames ({phase})")
            for phase in self._frames
        ]
        left += [rrb.TensorView(origin=f"{root}/array/{name}", name=name) for name in self._arrays[:2]]
        told = any(True for _ in self._recording.messages(schema.LOG_TOPIC))
        if told:
            left.append(rrb.TextLogView(origin=f"{root}/log", name="Log"))
        episodes = any(self._recording.count(schema.PHASES[phase][1]) for phase in PHASES)
        drawn = [*(("return", "length") if episodes else ()), "reward", *self._lines()]
        axis = whole_axis(self._last)
        plots = [_series(root, name, [f"{phase}/{name}" for phase in PHASES], axis) for name in drawn]
        plots += [_series(root, name, [f"logged/{name}"], axis) for name in self._logged[:6]]
        shares = [
            *([4] if self._scene else []),
            *([3] * len(self._frames)),
            *([2] * len(self._arrays[:2])),
            *([1] if told else []),
        ]
        if not left:
            return rrb.Grid(*plots, grid_columns=2, name=title)
        return rrb.Horizontal(
            rrb.Vertical(*left, row_shares=shares),
            rrb.Grid(*plots, grid_columns=2),
            column_shares=[2, 3],
            name=title,
        )

    def export(self) -> None:
        """Send everything that is chosen."""
        for phase in PHASES:
            self._send_episodes(phase)
            self._send_frames(phase)
        if self._scene is not None:
            shown = Shown(
                self._root, "", self._recording.mdp, self._scene, self._learners, True, 0, None, False
            )
            draw_background(self._stream, shown)
        self._send_logged()
        self._send_texts()
        self._send_arrays()
        spans = {"train": self._selection.train, "eval": [span for _, span in self._selection.evaluations]}
        for phase in PHASES:
            if self._recording.kind == "variable":
                self._send_rewards_one_by_one(phase, spans[phase])
            else:
                self._send_steps(phase, spans[phase])

    def _send_episodes(self, phase: str) -> None:
        topic = schema.PHASES[phase][1]
        sender = Sender(self._stream, f"{self._root}/{phase}")
        names = self._names(phase)
        for k, block in enumerate(self._recording.blocks(topic)):
            if not k:
                sender.static("return", _dress(phase, names))
                sender.static("length", _dress(phase, [phase]))
            times = self._times(block["log_time"], block["episode"])
            sender.send("return", times, scalars(block["returns"]))
            sender.send("length", times, scalars(block["length"].astype(np.float64)[:, np.newaxis]))

    def _names(self, phase: str) -> list[str]:
        """Return the name of each learner's series in a phase."""
        return [f"{phase} {agent}" for agent in self._learners] if len(self._learners) > 1 else [phase]

    def _send_logged(self) -> None:
        """Send the scalars, some thousands of a name at a time."""
        waiting: dict[str, list[tuple[int, int, float]]] = {}
        for scalar in self._recording.decoded(schema.SCALAR_TOPIC):
            name = _entity(scalar["name"])
            rows = waiting.setdefault(name, [])
            rows.append((scalar["log_time"], scalar["episode"], scalar["value"]))
            if len(rows) == BATCH:
                self._send_rows(name, rows)
                waiting[name] = []
        self._logged = list(waiting)
        logged = Sender(self._stream, f"{self._root}/logged")
        for name in waiting:
            logged.static(name, series_lines([name]))
        for name, rows in waiting.items():
            if rows:
                self._send_rows(name, rows)

    def _send_rows(self, name: str, rows: Sequence[tuple[int, int, float]]) -> None:
        times, episodes, values = (np.array(column) for column in zip(*rows, strict=True))
        sender = Sender(self._stream, f"{self._root}/logged")
        columns = scalars(values.astype(np.float64)[:, np.newaxis])
        sender.send(name, self._times(times, episodes), columns)

    def _send_texts(self) -> None:
        for text in self._recording.decoded(schema.LOG_TOPIC):
            self._at(text["log_time"])
            line = rr.TextLog(f"{text['name']}: {text['message']}", level="INFO")
            self._stream.log(f"{self._root}/log", line)

    def _send_frames(self, phase: str) -> None:
        for frame in self._recording.decoded(_frame(phase)):
            self._at(frame["log_time"])
            image = rr.EncodedImage(contents=frame["data"], media_type=f"image/{frame['format']}")
            self._stream.log(f"{self._root}/{phase}/frame", image)

    def _send_arrays(self) -> None:
        for time, array in self._timed_arrays():
            self._at(time)
            name = _entity(array.name)
            if name not in self._arrays:
                self._arrays.append(name)
            self._stream.log(f"{self._root}/array/{name}", rr.Tensor(np.atleast_1d(array.values)))

    def _timed_arrays(self) -> Iterator[tuple[int, Any]]:
        times = (time for time, _ in self._recording.messages(schema.ARRAY_TOPIC))
        yield from zip(times, self._recording.arrays(), strict=True)

    def _send_steps(self, phase: str, spans: Sequence[Span]) -> None:
        """Send steps of the first environment, in all their views."""
        recording, sender = self._recording, Sender(self._stream, f"{self._root}/{phase}")
        lines, grid = self._lines(), self._grid(phase)
        dressed = False
        for steps in self._batches(recording.topic(f"/{phase}/step"), spans):
            if not dressed:
                sender.static("reward", _dress(phase, self._names(phase)))
                for part, columns in lines.items():
                    told = [
                        f"{name}[{i}]" if count > 1 else name
                        for name, path in columns
                        for count in [_column(steps[:1], path).shape[1]]
                        for i in range(count)
                    ]
                    sender.static(part, _dress(phase, told))
                dressed = True
            times = self._times(steps["log_time"], steps["episode"])
            times.append(rr.TimeColumn("t", sequence=steps["t"].astype(np.int64)))
            sender.send("reward", times, scalars(steps["rewards"]))
            for part, columns in lines.items():
                values = [_column(steps, path) for _, path in columns]
                sender.send(part, times, scalars(np.concatenate(values, axis=1)))
            if grid is not None:
                grid.send(steps)
        if grid is not None:
            grid.end()

    def _batches(self, topic: schema.Topic, spans: Sequence[Span]) -> Iterator[NDArray[np.void]]:
        for span in spans:
            for block in self._recording.blocks(topic, span.start, span.stop):
                for start in range(0, len(block), BATCH):
                    steps = block[start : start + BATCH]
                    steps = steps[
                        (steps["step"] % self._recording.environments == 0) & (steps["t"] != schema.NEVER)
                    ]
                    if not len(steps):
                        continue
                    if self._scene is not None:
                        check_steps(steps, self._recording.mdp, str(self._recording.path), "recorded")
                    yield steps

    def _lines(self) -> dict[str, list[tuple[str, tuple[str, ...]]]]:
        """Return what of a step is drawn as lines: part, and for each leaf its name and where it stands.

        A value of too many numbers is not drawn; the frames may show it.
        """
        if self._recording.kind == "variable":
            return {}
        if self._recording.kind == "step":
            return (
                {}
                if self._scene
                else {"observation": [("state", ("state",))], "action": [("action", ("action",))]}
            )
        lines = {}
        for part, field in (("observation", "next_observation"), ("action", "action")):
            leaves = leaves_of(self._recording.spaces[part], f"the {part} space")
            sizes = [math.prod(leaf.dtype.shape) for leaf in leaves if leaf.dtype is not None]
            if 0 < sum(sizes) <= MOST_LINES:
                lines[part] = [(".".join(leaf.path) or part, (field, *leaf.path)) for leaf in leaves]
        return lines

    def _grid(self, phase: str) -> _Grid | None:
        if self._scene is None:
            return None
        return _Grid(self._stream, self._recording, f"{self._root}/{phase}", phase, self._learners)

    def _send_rewards_one_by_one(self, phase: str, spans: Sequence[Span]) -> None:
        """Send the rewards of a loop whose steps vary in size."""
        sender = Sender(self._stream, f"{self._root}/{phase}")
        if spans:
            sender.static("reward", _dress(phase, self._names(phase)))
        for span in spans:
            steps = islice(self._recording.transitions(phase), span.start, span.stop)
            while batch := list(islice(steps, BATCH)):
                times, episodes = (np.array([step[key] for step in batch]) for key in ("log_time", "episode"))
                paid = np.array([step["rewards"] for step in batch])
                sender.send("reward", self._times(times, episodes), scalars(paid))

    def _at(self, log_time: int) -> None:
        step = log_time // schema.STEP_NANOSECONDS
        self._last = max(self._last, step)
        self._stream.set_time("step", sequence=step)

    def _times(self, log_time: NDArray[Any], episode: NDArray[Any]) -> list[rr.TimeColumn]:
        steps = log_time.astype(np.int64) // schema.STEP_NANOSECONDS
        self._last = max(self._last, int(steps.max(initial=0)))
        return [
            rr.TimeColumn("step", sequence=steps),
            rr.TimeColumn("episode", sequence=episode.astype(np.int64)),
        ]


class _Grid:
    """The grid of a tabular environment, for the steps of one phase."""

    def __init__(
        self,
        stream: rr.RecordingStream,
        recording: Recording,
        path: str,
        phase: str,
        learners: tuple[str, ...],
    ) -> None:
        mdp = recording.mdp
        scene = scene_of(mdp)
        marks = marks_of(scene) if scene else None
        assert scene is not None
        assert marks is not None
        words = vocabulary_of(mdp, scene, marks, learners, (0.0, 0.0))
        root = path.removesuffix(f"/{phase}")
        stream.log(f"{root}/", rr.AnnotationContext(words.classes.context()), static=True)
        self._sender = Sender(stream, path)
        self._writer = GridWriter(stream, path, scene, marks, words)
        self._events = EventWriter(stream, path, phase, mdp)
        self._writer.dress()
        self._phase = phase
        self._trained = np.concatenate(
            [np.empty(0, np.uint64), *(b["log_time"] for b in recording.blocks(schema.TRAIN_EPISODE))]
        )
        """When each training episode ended."""
        self._before: NDArray[np.void] | None = None
        self._last = -1

    def send(self, steps: NDArray[np.void]) -> None:
        """Send a batch; where steps are missing in between, nothing is shown."""
        time = steps["log_time"].astype(np.int64) // schema.STEP_NANOSECONDS
        gaps = [int(one) + 1 for one in time[:-1][np.diff(time) != 1]]
        if self._last >= 0 and time[0] != self._last + 1:
            gaps.insert(0, self._last + 1)
        before = steps[:0] if self._before is None else self._before
        episode = steps["episode"].astype(np.int64)
        if self._phase == "eval":
            episode = np.searchsorted(self._trained, steps["log_time"])
        batch = Batch(steps, None, episode, before, time)
        self._writer.write(batch, self._phase)
        self._events.write(batch)
        if gaps:
            self._sender.clear("grid", gaps)
        self._before, self._last = steps[-TRAIL_STEPS:], int(time[-1])

    def end(self) -> None:
        """Say that behind the last step nothing is known."""
        if self._last >= 0:
            self._sender.clear("grid", [self._last + 1])


def _frame(phase: str) -> schema.Topic:
    return schema.TRAIN_FRAME if phase == "train" else schema.EVAL_FRAME


def _column(steps: NDArray[np.void], path: tuple[str, ...]) -> NDArray[np.float64]:
    """Return the numbers of a leaf, [n, numbers]."""
    column: NDArray[Any] = steps
    for name in path:
        column = column[name]
    return column.reshape(len(steps), -1).astype(np.float64)


def _entity(name: str) -> str:
    """Return a user's name as a part of an entity's path."""
    return re.sub(r"[^\w.-]+", "_", name)[:80] or "_"


def _series(root: str, name: str, parts: Sequence[str], axis: rrb.TimeAxis) -> Any:
    contents = [f"{root}/{part}" for part in parts]
    return rrb.TimeSeriesView(origin=f"{root}/", contents=contents, name=name.replace("_", " "), axis_x=axis)


def _dress(phase: str, names: Sequence[str]) -> rr.SeriesLines:
    """Return how the lines of a phase look; a view has those of both phases."""
    return series_lines(names, phase_colours(phase, len(names)))
