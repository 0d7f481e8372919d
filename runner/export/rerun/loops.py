"""A loop recorded with `record` in Rerun: episodes, logged values, frames, arrays, and the selected steps.

Entities of a vector environment are below `train/env_3`, those of a game's agent below `train/agent_0`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import islice
from typing import Any, Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from runner.export.rerun.columns import MAX_ROWS, Batch, Sender, scalars
from runner.export.rerun.frames import FrameSender
from runner.export.rerun.labels import Labels
from runner.export.rerun.layout import RunView, time_axis
from runner.export.rerun.members import Member, entity_name, members_of, numbers_in
from runner.export.rerun.metrics import line_colours, phase_colours, series_lines
from runner.export.rerun.runs import Source
from runner.export.rerun.scene import scene_of
from runner.export.rerun.selection import MAX_MEMBERS, Selection
from runner.export.rerun.steps import StepWriter
from runner.export.values import FEW
from runner.recording import schema
from runner.recording.spaces import least_number
from runner.replay.steps import check_steps
from runner.util.arrays import Array, MaskedArray

MAX_BARS: Final = 16
"""Extras of more numbers are drawn as bars."""
MAX_ARRAYS: Final = 2
MAX_LOGGED: Final = 6
"""Views of logged arrays, and of logged scalars, in the blueprint; all are sent."""
_BATCH_BYTES: Final = 64 << 20
_OVERVIEW: Final = "Overview"
_BY_EPISODE: Final = ("return", "length")
"""Titles of views of whole episodes, whose time axis is that of the run."""


class LoopExporter:
    """Sends one loop to a stream."""

    def __init__(self, stream: rr.RecordingStream, source: Source, selection: Selection) -> None:
        recording, root = source.recording, source.root
        self._stream = stream
        self._recording = recording
        self._selection = selection
        self._root, self._title = root, source.title
        scene = scene_of(recording.mdp) if recording.tabular else None
        self._grid: tuple[RunView, Labels] | None = None
        """The view of its grid, and the labels there; None where the states have no scene."""
        if scene is not None:
            view = RunView(root, source.title, recording.mdp, scene, recording.agents)
            self._grid = view, Labels(recording.mdp, scene, recording.agents)
        self._is_game = len(recording.agents) > 1
        self._members = members_of(recording, scene is not None)
        self._plots: dict[str, dict[str, list[str]]] = {_OVERVIEW: {}}
        """The entities that views show as lines, by tab and title."""
        self._drawn: set[str] = set()
        """All entities that are lines."""
        self._logged: dict[str, None] = {}
        """Names of logged scalars; a dictionary keeps them in order."""
        self._bars: dict[str, str] = {}
        """Titles of extras that are drawn as bars, by entity."""
        names = [""] if self._is_game else [member.name for member in self._members]
        self._frames = FrameSender(stream, root, recording, names)
        self._arrays: dict[str, None] = {}
        self._has_log = False
        self._last = 0
        """The last step for which anything was sent."""

    def view(self) -> rrb.Container:
        """Return the arrangement of what `export` has sent."""
        root, title = self._root, self._title
        left: list[tuple[rrb.View | rrb.Container, int]] = []  # views and their shares of the height
        if self._grid is not None:
            left.append((self._grid[0].grid_view(), 4))
        left += [(view, 3) for view in self._frames.views()]
        left += [
            (rrb.TensorView(origin=f"{root}/array/{name}", name=name), 2)
            for name in islice(self._arrays, MAX_ARRAYS)
        ]
        if self._has_log:
            left.append((rrb.TextLogView(origin=f"{root}/log", name="Log"), 1))
        tabs = []
        for tab, plots in self._plots.items():
            views = [
                self._plot(title, entities, None if title in _BY_EPISODE else self._selection.focus)
                for title, entities in plots.items()
            ]
            if tab == _OVERVIEW:
                views += [
                    rrb.BarChartView(origin=f"{root}/{entity}", name=name)
                    for entity, name in islice(self._bars.items(), MAX_ARRAYS)
                ]
                views += [self._plot(name, [f"logged/{name}"]) for name in islice(self._logged, MAX_LOGGED)]
            tabs.append(rrb.Grid(*views, grid_columns=2, name=tab))
        right = tabs[0] if len(tabs) == 1 else rrb.Tabs(*tabs, active_tab=0)
        if not left:
            return rrb.Vertical(right, name=title)
        shown, shares = zip(*left, strict=True)
        column = rrb.Vertical(*shown, row_shares=shares)
        share = 3 if len(self._members) > 1 else 2
        return rrb.Horizontal(column, right, column_shares=[share, 3], name=title)

    def export(self) -> None:
        """Send everything that is selected."""
        for phase in schema.PHASES:
            self._send_episodes(phase)
            self._frames.send_recorded(phase)
        self._frames.send_logged()
        self._send_logged()
        self._send_texts()
        self._send_arrays()
        if self._grid is not None:
            view, labels = self._grid
            labels.log(self._stream, self._root)
            view.draw_background(self._stream)
        for phase, spans in self._selection.by_phase.items():
            self._send_steps(phase, spans)

    def draw_frames(self, trust: bool, stage: Callable[[str], None]) -> None:
        """Send pictures of the chosen episodes that the environment draws; report what is missing."""
        for phase, episodes in self._selection.drawn.items():
            for note in self._frames.draw(phase, episodes, trust, stage):
                self._selection.warnings.append(note)
                self._has_log = True
                self._log(self._last * schema.STEP_NANOSECONDS, "log", rr.TextLog(note, level="WARN"))

    def _send_episodes(self, phase: str) -> None:
        """Send returns and lengths: of a game one length, and the return of each agent."""
        for block in self._recording.blocks(schema.PHASES[phase][1]):
            for member in self._members:
                own = block if self._is_game else block[self._is_of(block["last_step"], member)]
                if not len(own):
                    continue
                times = self._times(own["log_time"], own["episode"])
                self._send_lines(phase, member, "return", times, own["returns"][:, [member.column]])
                if member.column == 0:
                    length = own["length"].astype(np.float64)[:, np.newaxis]
                    one = member._replace(name="") if self._is_game else member
                    self._send_lines(phase, one, "length", times, length)

    def _send_logged(self) -> None:
        """Send the logged scalars, a batch of each name at a time."""
        sender = self._sender("logged")
        waiting: dict[str, list[tuple[int, int, float]]] = {}

        def send(name: str) -> None:
            times, episodes, values = (np.array(column) for column in zip(*waiting.pop(name), strict=True))
            columns = scalars(values.astype(np.float64)[:, np.newaxis])
            sender.send(name, self._times(times, episodes), columns)

        for scalar in self._recording.decoded(schema.SCALAR_TOPIC):
            name = entity_name(scalar["name"])
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
            name = entity_name(array.name)
            self._arrays[name] = None
            self._log(time, f"array/{name}", rr.Tensor(np.atleast_1d(array.values)))

    def _send_steps(self, phase: str, spans: Sequence[range]) -> None:
        """Send steps of every environment and agent, in all their views."""
        recording = self._recording
        grid: StepWriter | None = None
        training_ends = self._training_ends() if self._grid is not None and phase == "eval" else None
        for steps in self._batches(f"/{phase}/step", spans):
            extras = recording.extras(phase).at(steps["step"])
            for member in self._members:
                is_own = (
                    (steps["acted"] >> member.number & 1).astype(np.bool_)
                    if self._is_game
                    else self._is_of(steps["step"], member)
                )
                if not is_own.any():
                    continue
                own = steps[is_own]
                times = self._times(own["log_time"], own["episode"])
                times.append(rr.TimeColumn("t", sequence=own["t"].astype(np.int64)))
                self._send_lines(phase, member, "reward", times, own["rewards"][:, [member.column]])
                for quantity, parts in member.parts.items():
                    numbers = [numbers_in(own, path) + start for path, start, _ in parts]
                    names = [name for _, _, each in parts for name in each]
                    self._send_lines(phase, member, quantity, times, np.concatenate(numbers, axis=1), names)
                values = {name: each[is_own] for name, each in extras.items()}
                self._send_extras(phase, member, values, own["log_time"], times)
            if self._grid is not None:
                view, labels = self._grid
                grid = grid or StepWriter(self._stream, view, phase, labels)
                episode = steps["episode"].astype(np.int64)
                if training_ends is not None:  # evaluation is shown by the training episodes before it
                    episode = np.searchsorted(training_ends, steps["log_time"])
                grid.write(Batch.of(steps, episode))
        if grid is not None:
            grid.clear_gaps(["grid"], grid.covered[-1][1])

    def _is_of(self, steps: Array, member: Member) -> NDArray[np.bool_]:
        """Return which steps, given by number, were taken in an environment."""
        return np.asarray(steps % self._recording.environments == member.number)

    def _training_ends(self) -> NDArray[np.uint64]:
        """Return the times at which training episodes ended."""
        ends = [block["log_time"] for block in self._recording.blocks(schema.TRAIN_EPISODE)]
        return np.concatenate([np.empty(0, np.uint64), *ends])

    def _send_extras(
        self,
        phase: str,
        member: Member,
        extras: Mapping[str, MaskedArray],
        log_times: Array,
        times: list[rr.TimeColumn],
    ) -> None:
        """Send the values that the loop recorded with these steps: as lines, or as bars if they are many."""
        for name, values in extras.items():
            own = name
            if self._is_game:
                agent, _, own = name.partition("/")
                if entity_name(agent) != member.name:
                    continue
            given = ~np.ma.getmaskarray(values).reshape(len(values), -1)[:, 0]
            numbers = values.data.reshape(len(values), -1).astype(np.float64)
            quantity = f"extra/{entity_name(own)}"
            if numbers.shape[1] > MAX_BARS:
                entity = _join(phase, member.name, quantity)
                self._bars.setdefault(entity, _spaced(member.name, own))
                for time, row in zip(log_times[given].tolist(), numbers[given], strict=True):
                    self._log(time, entity, rr.BarChart(row))
                continue
            # A gap in the line where the value was not recorded
            numbers = np.where(given[:, np.newaxis], numbers, np.nan)
            names = [f"{own}[{i}]" for i in range(numbers.shape[1])]
            self._send_lines(phase, member, quantity, times, numbers, names)

    def _batches(self, name: str, spans: Sequence[range]) -> Iterator[NDArray[np.void]]:
        """Yield the steps of all environments, at most a batch of each at a time."""
        recording, topic = self._recording, self._recording.topic(name)
        if topic not in recording.dtypes:  # they vary in size, so they are read from the first on
            for span in spans:
                for block in recording.rows(name):
                    if block["step"][0] >= span.stop:
                        break
                    if len(own := block[(block["step"] >= span.start) & (block["step"] < span.stop)]):
                        yield own
            return
        size = recording.dtypes[topic].itemsize
        limit = max(1, min(MAX_ROWS * recording.environments, _BATCH_BYTES // size))
        for span in spans:
            for start in range(span.start, span.stop, limit):
                steps = np.concatenate(
                    [
                        np.empty(0, recording.dtypes[topic]),
                        *recording.blocks(topic, start, min(start + limit, span.stop)),
                    ]
                )
                steps = steps[steps["t"] != schema.RESET_ONLY]
                if not len(steps):
                    continue
                if self._grid is not None:
                    check_steps(steps, recording.mdp, str(recording.path), "recorded")
                yield steps

    def _send_lines(
        self,
        phase: str,
        member: Member,
        quantity: str,
        times: list[rr.TimeColumn],
        values: NDArray[np.float64],
        names: Sequence[str] = ("",),
    ) -> None:
        """Send series, [rows, names]; at first also how they are drawn, and in which view.

        A view shows a quantity of all environments; one of several numbers those of one environment.
        """
        entity = _join(phase, member.name, quantity)
        if entity not in self._drawn:
            self._drawn.add(entity)
            colours = phase_colours(phase, len(names))
            if member.name and len(names) == 1:
                shown = line_colours(min(len(self._members), MAX_MEMBERS))
                colours = [shown[member.number % len(shown)]]
            lines = names if len(names) > 1 else [_spaced(phase, member.name)]
            style: Any = series_lines(lines, colours)
            if names == ["action"]:  # of a Discrete space: lines between such numbers mean nothing
                style = rr.SeriesPoints(names=lines, colors=colours, marker_sizes=[1.5])
            self._sender("").send_static(entity, style)
            tab, title = _OVERVIEW, quantity.removeprefix("extra/")
            agent = self._recording.agents[member.number] if self._is_game else ""
            actions = self._recording.action_names(phase, agent)
            if quantity == "action" and 0 < len(actions) <= FEW:
                space = self._recording.spaces["action"]
                least = least_number(space["spaces"][agent] if agent else space)
                title = f"action: {', '.join(f'{i} {name}' for i, name in enumerate(actions, least))}"
            if member.name and len(names) > 1:
                tab, title = title.capitalize(), _spaced(member.name, title)
            if member.number < MAX_MEMBERS:
                self._plots.setdefault(tab, {}).setdefault(title, []).append(entity)
        self._sender("").send(entity, times, scalars(values))

    def _sender(self, part: str) -> Sender:
        return Sender(self._stream, f"{self._root}/{part}" if part else self._root)

    def _plot(self, name: str, entities: Sequence[str], focus: tuple[int, int] | None = None) -> rrb.View:
        contents = [f"{self._root}/{entity}" for entity in entities]
        return rrb.TimeSeriesView(
            origin=f"{self._root}/",
            contents=contents,
            name=name.replace("_", " "),
            axis_x=time_axis(self._last, focus),
        )

    def _log(self, log_time: int, entity: str, archetype: rr.AsComponents) -> None:
        step = log_time // schema.STEP_NANOSECONDS
        self._last = max(self._last, step)
        self._stream.set_time("step", sequence=step)
        self._stream.log(f"{self._root}/{entity}", archetype)

    def _times(self, log_time: Array, episode: Array) -> list[rr.TimeColumn]:
        steps = log_time.astype(np.int64) // schema.STEP_NANOSECONDS
        self._last = max(self._last, int(steps.max(initial=0)))
        return [
            rr.TimeColumn("step", sequence=steps),
            rr.TimeColumn("episode", sequence=episode.astype(np.int64)),
        ]


def _join(*parts: str) -> str:
    return "/".join(filter(None, parts))


def _spaced(*parts: str) -> str:
    return " ".join(filter(None, parts))
