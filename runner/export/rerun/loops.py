"""A loop recorded with `record` in Rerun: episodes, logged values, frames, arrays, and the selected steps."""

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

from runner.export.rerun.columns import MAX_ROWS, Batch, Sender, scalars
from runner.export.rerun.labels import Labels
from runner.export.rerun.layout import draw_scene, grid_bounds, whole_axis
from runner.export.rerun.metrics import phase_colours, series_lines
from runner.export.rerun.scene import scene_of
from runner.export.rerun.selection import Selection, Span
from runner.export.rerun.steps import StepWriter
from runner.recording import schema
from runner.recording.reader import Recording
from runner.recording.spaces import leaves_of
from runner.replay.steps import check_steps

MAX_LINES: Final = 16
"""Observations or actions of more numbers are not drawn as lines."""
MAX_ARRAYS: Final = 2
MAX_LOGGED: Final = 6
"""Views of logged arrays and of logged scalars in the blueprint, and of extras; all are sent."""
_FRAMES: Final = {"train": schema.TRAIN_FRAME, "eval": schema.EVAL_FRAME}
Leaf = tuple[str, tuple[str, ...]]
"""A name, and the path of fields in the record of a step."""


class LoopExporter:
    """Sends one loop to a stream."""

    def __init__(self, stream: rr.RecordingStream, recording: Recording, selection: Selection, root: str):
        self._stream = stream
        self._recording = recording
        self._selection = selection
        self._root = root
        self._learners = recording.agents
        self._scene = scene_of(recording.mdp) if recording.tabular else None
        self._drawn: dict[str, None] = {}
        """The parts of both phases that are drawn as lines; a dictionary keeps them in order."""
        self._logged: dict[str, None] = {}
        self._extras: dict[tuple[str, str], str] = {}
        """Phase and name to the entity, of extras that are drawn as lines; `_bars` is entity to name."""
        self._bars: dict[str, str] = {}
        self._frames: list[str] = []
        self._arrays: dict[str, None] = {}
        self._has_log = False
        self._last = 0
        """The last step for which anything was sent."""

    def blueprint(self, title: str) -> Any:
        """Return the arrangement of what `export` has sent."""
        root = self._root
        left: list[tuple[Any, int]] = []  # views and their shares of the height
        if self._scene is not None:
            contents = [f"{root}/scene/**", *(f"{root}/{phase}/grid/**" for phase in schema.PHASES)]
            bounds = grid_bounds(self._scene)
            grid = rrb.Spatial2DView(origin=f"{root}/", contents=contents, visual_bounds=bounds, name=title)
            left.append((grid, 4))
        left += [
            (rrb.Spatial2DView(origin=f"{root}/{phase}/frame", name=f"Frames ({phase})"), 3)
            for phase in self._frames
        ]
        left += [
            (rrb.TensorView(origin=f"{root}/array/{name}", name=name), 2)
            for name in islice(self._arrays, MAX_ARRAYS)
        ]
        if self._has_log:
            left.append((rrb.TextLogView(origin=f"{root}/log", name="Log"), 1))
        plots = [self._plot(name, [f"{phase}/{name}" for phase in schema.PHASES]) for name in self._drawn]
        extras = {name: entity for (_, name), entity in self._extras.items()}
        plots += [
            self._plot(name, [f"{phase}/{entity}" for phase in schema.PHASES])
            for name, entity in islice(extras.items(), MAX_LOGGED)
        ]
        plots += [
            rrb.BarChartView(origin=f"{root}/{entity}", name=name)
            for entity, name in islice(self._bars.items(), MAX_ARRAYS)
        ]
        plots += [self._plot(name, [f"logged/{name}"]) for name in islice(self._logged, MAX_LOGGED)]
        if not left:
            return rrb.Grid(*plots, grid_columns=2, name=title)
        views, shares = zip(*left, strict=True)
        return rrb.Horizontal(
            rrb.Vertical(*views, row_shares=shares),
            rrb.Grid(*plots, grid_columns=2),
            column_shares=[2, 3],
            name=title,
        )

    def export(self) -> None:
        """Send everything that is selected."""
        recording = self._recording
        for phase in schema.PHASES:
            self._send_episodes(phase)
            self._send_frames(phase)
        self._send_logged()
        self._send_texts()
        self._send_arrays()
        if self._scene is not None:
            labels = Labels(recording.mdp, self._scene, self._learners)
            labels.log(self._stream, self._root)
            draw_scene(self._stream, self._root, self._scene)
        else:
            labels = None
        spans = {"train": self._selection.train, "eval": [span for _, span in self._selection.evaluations]}
        for phase in schema.PHASES:
            if recording.kind == "variable":
                self._send_rewards(phase, spans[phase])
            else:
                self._send_steps(phase, spans[phase], labels)

    def _send_episodes(self, phase: str) -> None:
        sender = self._sender(phase)
        for k, block in enumerate(self._recording.blocks(schema.PHASES[phase][1])):
            if not k:
                self._draw_lines(sender, "return", self._reward_lines(phase))
                self._draw_lines(sender, "length", [phase])
            times = self._times(block["log_time"], block["episode"])
            sender.send("return", times, scalars(block["returns"]))
            sender.send("length", times, scalars(block["length"].astype(np.float64)[:, np.newaxis]))

    def _send_frames(self, phase: str) -> None:
        for frame in self._recording.decoded(_FRAMES[phase]):
            if phase not in self._frames:
                self._frames.append(phase)
            image = rr.EncodedImage(contents=frame["data"], media_type=f"image/{frame['format']}")
            self._log(frame["log_time"], f"{phase}/frame", image)

    def _send_logged(self) -> None:
        """Send the logged scalars, a batch of each name at a time."""
        sender = self._sender("logged")
        waiting: dict[str, list[tuple[int, int, float]]] = {}

        def send(name: str) -> None:
            times, episodes, values = (np.array(column) for column in zip(*waiting.pop(name), strict=True))
            columns = scalars(values.astype(np.float64)[:, np.newaxis])
            sender.send(name, self._times(times, episodes), columns)

        for scalar in self._recording.decoded(schema.SCALAR_TOPIC):
            name = _entity(scalar["name"])
            if name not in self._logged:
                self._logged[name] = None
                sender.send_static(name, series_lines([name]))
            rows = waiting.setdefault(name, [])
            rows.append((scalar["log_time"], scalar["episode"], scalar["value"]))
            if len(rows) == MAX_ROWS:
                send(name)
        for name in list(waiting):
            send(name)

    def _send_texts(self) -> None:
        for text in self._recording.decoded(schema.LOG_TOPIC):
            self._has_log = True
            line = rr.TextLog(f"{text['name']}: {text['message']}", level="INFO")
            self._log(text["log_time"], "log", line)

    def _send_arrays(self) -> None:
        times = (time for time, _ in self._recording.messages(schema.ARRAY_TOPIC))
        for time, array in zip(times, self._recording.arrays(), strict=True):
            name = _entity(array.name)
            self._arrays[name] = None
            self._log(time, f"array/{name}", rr.Tensor(np.atleast_1d(array.values)))

    def _send_steps(self, phase: str, spans: Sequence[Span], labels: Labels | None) -> None:
        """Send steps of the first environment, in all their views."""
        recording, sender, leaves = self._recording, self._sender(phase), self._leaves()
        grid: StepWriter | None = None
        training_ends = self._training_ends() if labels is not None and phase == "eval" else None
        for number, steps in enumerate(self._batches(recording.topic(f"/{phase}/step"), spans)):
            if number == 0:
                self._draw_lines(sender, "reward", self._reward_lines(phase))
                for part, paths in leaves.items():
                    self._draw_lines(sender, part, list(_line_names(steps, paths)))
                if labels is not None:
                    grid = StepWriter(self._stream, self._root, phase, recording.mdp, self._scene, labels)
            times = self._times(steps["log_time"], steps["episode"])
            times.append(rr.TimeColumn("t", sequence=steps["t"].astype(np.int64)))
            sender.send("reward", times, scalars(steps["rewards"]))
            for part, paths in leaves.items():
                numbers = np.concatenate([_numbers(steps, path) for _, path in paths], axis=1)
                sender.send(part, times, scalars(numbers))
            self._send_extras(phase, steps["step"], steps["log_time"], times)
            if grid is not None:
                episode = steps["episode"].astype(np.int64)
                if training_ends is not None:  # evaluation is shown by the training episodes before it
                    episode = np.searchsorted(training_ends, steps["log_time"])
                time = steps["log_time"].astype(np.int64) // schema.STEP_NANOSECONDS
                grid.write(Batch(steps, episode, time))
        if grid is not None:
            grid.clear_gaps(["grid"], grid.covered[-1][1])

    def _training_ends(self) -> NDArray[np.uint64]:
        """Return the times at which training episodes ended."""
        ends = [block["log_time"] for block in self._recording.blocks(schema.TRAIN_EPISODE)]
        return np.concatenate([np.empty(0, np.uint64), *ends])

    def _send_rewards(self, phase: str, spans: Sequence[Span]) -> None:
        """Send the rewards of a loop whose steps vary in size."""
        sender = self._sender(phase)
        if spans:
            self._draw_lines(sender, "reward", self._reward_lines(phase))
        for span in spans:
            steps = islice(self._recording.transitions(phase), span.start, span.stop)
            while batch := list(islice(steps, MAX_ROWS)):
                times, episodes = (np.array([step[key] for step in batch]) for key in ("log_time", "episode"))
                rewards = np.array([step["rewards"] for step in batch])
                columns = self._times(times, episodes)
                sender.send("reward", columns, scalars(rewards))
                self._send_extras(phase, np.array([step["step"] for step in batch]), times, columns)

    def _send_extras(
        self, phase: str, steps: NDArray[Any], log_times: NDArray[Any], times: list[rr.TimeColumn]
    ) -> None:
        """Send the values that the loop recorded with these steps: as lines, or as bars if they are many."""
        sender = self._sender(phase)
        for name, values in self._recording.extras(phase).at(steps).items():
            given = ~np.ma.getmaskarray(values).reshape(len(steps), -1)[:, 0]
            numbers = values.data.reshape(len(steps), -1).astype(np.float64)
            entity = f"extra/{_entity(name)}"
            if numbers.shape[1] > MAX_LINES:
                self._bars.setdefault(f"{phase}/{entity}", name)
                for time, row in zip(log_times[given].tolist(), numbers[given], strict=True):
                    self._log(time, f"{phase}/{entity}", rr.BarChart(row))
                continue
            if (phase, name) not in self._extras:
                count = numbers.shape[1]
                lines = [f"{phase} {name}"] if count == 1 else [f"{phase} {name}[{i}]" for i in range(count)]
                sender.send_static(entity, series_lines(lines, phase_colours(phase, count)))
                self._extras[phase, name] = entity
            # A gap in the line where the value was not recorded
            sender.send(entity, times, scalars(np.where(given[:, np.newaxis], numbers, np.nan)))

    def _batches(self, topic: schema.Topic, spans: Sequence[Span]) -> Iterator[NDArray[np.void]]:
        """Yield the steps of the first environment, at most a batch at a time."""
        recording = self._recording
        for span in spans:
            for block in recording.blocks(topic, span.start, span.stop):
                for start in range(0, len(block), MAX_ROWS):
                    steps = block[start : start + MAX_ROWS]
                    is_shown = (steps["step"] % recording.environments == 0) & (
                        steps["t"] != schema.RESET_ONLY
                    )
                    steps = steps[is_shown]
                    if not len(steps):
                        continue
                    if self._scene is not None:
                        check_steps(steps, recording.mdp, str(recording.path), "recorded")
                    yield steps

    def _leaves(self) -> dict[str, list[Leaf]]:
        """Return the numbers of a step that are drawn as lines, if there are not too many."""
        kind, spaces = self._recording.kind, self._recording.spaces
        if kind == "step" and self._scene is None:
            return {"observation": [("state", ("state",))], "action": [("action", ("action",))]}
        leaves: dict[str, list[Leaf]] = {}
        if kind in ("step", "variable"):
            return leaves
        for part, field in (("observation", "next_observation"), ("action", "action")):
            found = leaves_of(spaces[part], f"the {part} space")
            sizes = [math.prod(leaf.dtype.shape) for leaf in found if leaf.dtype is not None]
            if 0 < sum(sizes) <= MAX_LINES:
                leaves[part] = [(".".join(leaf.path) or part, (field, *leaf.path)) for leaf in found]
        return leaves

    def _sender(self, part: str) -> Sender:
        return Sender(self._stream, f"{self._root}/{part}")

    def _draw_lines(self, sender: Sender, part: str, names: Sequence[str]) -> None:
        phase = sender.path.rpartition("/")[2]
        self._drawn[part] = None
        sender.send_static(part, series_lines(names, phase_colours(phase, len(names))))

    def _reward_lines(self, phase: str) -> list[str]:
        return [f"{phase} {agent}" for agent in self._learners] if len(self._learners) > 1 else [phase]

    def _plot(self, name: str, entities: Sequence[str]) -> Any:
        contents = [f"{self._root}/{entity}" for entity in entities]
        return rrb.TimeSeriesView(
            origin=f"{self._root}/",
            contents=contents,
            name=name.replace("_", " "),
            axis_x=whole_axis(self._last),
        )

    def _log(self, log_time: int, entity: str, archetype: Any) -> None:
        step = log_time // schema.STEP_NANOSECONDS
        self._last = max(self._last, step)
        self._stream.set_time("step", sequence=step)
        self._stream.log(f"{self._root}/{entity}", archetype)

    def _times(self, log_time: NDArray[Any], episode: NDArray[Any]) -> list[rr.TimeColumn]:
        steps = log_time.astype(np.int64) // schema.STEP_NANOSECONDS
        self._last = max(self._last, int(steps.max(initial=0)))
        return [
            rr.TimeColumn("step", sequence=steps),
            rr.TimeColumn("episode", sequence=episode.astype(np.int64)),
        ]


def _numbers(steps: NDArray[np.void], path: tuple[str, ...]) -> NDArray[np.float64]:
    """Return the numbers of a leaf, [n, numbers]."""
    column: NDArray[Any] = steps
    for name in path:
        column = column[name]
    return column.reshape(len(steps), -1).astype(np.float64)


def _line_names(steps: NDArray[np.void], leaves: Sequence[Leaf]) -> Iterator[str]:
    """Yield a name for each number of the leaves."""
    for name, path in leaves:
        count = _numbers(steps[:1], path).shape[1]
        yield from (f"{name}[{i}]" for i in range(count)) if count > 1 else (name,)


def _entity(name: str) -> str:
    """Return a user's name as a part of an entity's path."""
    return re.sub(r"[^\w.-]+", "_", name)[:80] or "_"
