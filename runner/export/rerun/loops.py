"""A loop recorded with `record` as tracks: episodes, logged values, frames, arrays, and the selected steps.

Entities of a vector environment are below `train/env_3`, those of a game's agent below `train/agent_0`.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import reduce
from operator import getitem
from typing import Any, Final, NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from runner.errors import CannotRedo
from runner.export import pictures
from runner.export.encoded import encoded_picture
from runner.export.painting import redrawn
from runner.export.rerun.labels import Labels
from runner.export.rerun.layout import OVERVIEW
from runner.export.rerun.metrics import line_colours, phase_colours, series_lines
from runner.export.rerun.scene import background, scene_of
from runner.export.rerun.selection import MAX_MEMBERS, Selection
from runner.export.rerun.steps import Batch, StepTracks, grid_view
from runner.export.rerun.tracks import (
    MAX_ROWS,
    Row,
    Source,
    Times,
    Track,
    View,
    cleared,
    grouped,
    rows_of,
    scalars,
    times_of,
)
from runner.export.values import FEW, acted, number_names, observed
from runner.recording import schema
from runner.recording.messages import frame_place, media_type
from runner.recording.reader import Recording
from runner.recording.spaces import least_number, leaves_of
from runner.recording.turns import taken
from runner.replay.steps import check_steps, frames_every, log_times_of
from runner.util.arrays import Array, MaskedArray, Records
from runner.util.extras import require

MAX_BARS: Final = 16
"""Extras of more numbers are drawn as bars."""
MAX_LINES: Final = 24
"""Observations or actions of more numbers are not drawn as lines."""
FRAMES_SENT: Final = 64
"""Pictures sent at once."""
LOG: Final = View("log", "Log", rrb.TextLogView)
_BATCH_BYTES: Final = 64 << 20
OBSERVED: Final = {"observation": observed, "action": acted}
Part = tuple[list[tuple[str, ...]], list[str]]
"""Paths into the values of a space, and the names of all numbers there."""


class Member(NamedTuple):
    """An environment of a vector, or an agent of a game."""

    number: int
    name: str = ""
    """`env_3`, or the agent; empty if there is only one."""
    column: int = 0
    """Its column among the rewards."""
    parts: Mapping[str, Part] = {}
    """`observation` and `action`, if they are drawn as lines."""
    agent: str = ""
    """The agent's name in the recording of a game."""


class LoopReader:
    """Reads a loop as tracks: an overview, then the selected steps, and pictures that are drawn of them."""

    def __init__(
        self, source: Source, selection: Selection, trust: bool, stage: Callable[[str], None]
    ) -> None:
        recording = self._recording = source.recording
        self._source, self._root, self._selection = source, source.root, selection
        self._trust, self._stage = trust, stage
        self._scene = scene_of(recording.mdp) if recording.tabular else None
        self._is_game, n = len(recording.agents) > 1, recording.environments
        self._environments = [f"env_{i}" if n > 1 else "" for i in range(n)]
        self._alone = n == 1
        """Whether environments take no turns, or follow one another."""
        if self._is_game:
            agents = enumerate(recording.agents)
            self._members = [Member(i, entity_name(a), i, _parts(recording, a), a) for i, a in agents]
        else:
            parts = {} if self._scene else _parts(recording)
            self._members = [Member(i, name, 0, parts) for i, name in enumerate(self._environments)]
        self._described: set[str] = set()
        """Entities that are lines."""
        self._pictured: dict[tuple[str, int], int] = {}
        """The step of the last picture, by phase and environment."""
        self.last = 0
        """The last step that was read."""

    def overview(self) -> Iterator[Track]:
        """Yield everything but the steps."""
        recording, root = self._recording, self._root
        for phase in schema.PHASES:
            yield from self._episodes(phase)
            for environment, frames in grouped(self._recorded_frames(phase), FRAMES_SENT):
                yield self._frames(phase, environment, frames)
        for image in recording.table(schema.IMAGE_TOPIC).decoded():
            name, data = entity_name(image["frame_id"]), image["data"]
            if media_type(data) not in ("image/png", "image/jpeg"):
                data = _first_frame(data)
            if data:
                view = View("pictures", name, rrb.Spatial2DView)
                yield rows_of(f"{root}/picture/{name}", [(_step(image["log_time"]), _picture(data))], view)
        values = (
            (entity_name(scalar["name"]), scalar) for scalar in recording.table(schema.SCALAR_TOPIC).decoded()
        )
        for name, rows in grouped(values, MAX_ROWS):
            log_times, episodes, numbers = (
                np.array([row[field] for row in rows]) for field in ("log_time", "episode", "value")
            )
            times, view = times_of(log_times, episode=episodes), View("logged", name.replace("_", " "))
            static = [series_lines([name])]
            yield Track(f"{root}/logged/{name}", times, scalars(numbers[:, np.newaxis]), static, view)
        texts = (
            ("log", (_step(text["log_time"]), rr.TextLog(f"{text['name']}: {text['message']}", level="INFO")))
            for text in recording.table(schema.LOG_TOPIC).decoded()
        )
        for name, lines in grouped(texts, MAX_ROWS):
            yield rows_of(f"{root}/{name}", lines, LOG)
        arrays = recording.table(schema.ARRAY_TOPIC).messages()
        for (time, _), array in zip(arrays, recording.arrays(), strict=True):
            name, tensor = entity_name(array.name), rr.Tensor(np.atleast_1d(array.values))
            view = View("array", name, rrb.TensorView)
            yield rows_of(f"{root}/array/{name}", [(_step(time), tensor)], view)

    def steps(self) -> Iterator[Track]:
        """Yield the selected steps of every environment and agent, and pictures that are drawn of them."""
        recording, root, scene, title = self._recording, self._root, self._scene, self._source.title
        for phase, spans in self._selection.by_phase.items():
            grid = None
            if scene and spans:
                labels = Labels(recording.mdp, scene, recording.agents)
                grid = StepTracks(root, phase, title, labels)
                yield labels.track(root)
                yield from background(root, scene, grid_view(title, scene))
                yield from grid.still
            trained = recording.train.episodes.array()["log_time"] if scene else ()
            for steps in self._batches(phase, spans):
                yield from self._lines_of(phase, steps)
                if grid:
                    number = episode = steps["episode"].astype(np.int64)
                    if phase == "eval":  # shown by the training episodes before it
                        episode = np.searchsorted(trained, steps["log_time"])
                    yield from grid.of(Batch(steps, episode, number))
            if grid:
                yield from cleared([f"{grid.path}/grid"], [stop for _, stop in grid.covered])
        for phase, episodes in self._selection.drawn.items():
            yield from self._drawn_frames(phase, episodes)

    def _episodes(self, phase: str) -> Iterator[Track]:
        """Yield returns and lengths: of a game one length, and the return of each agent."""
        for block in self._recording.phase(phase).episodes.blocks():
            for member in self._members:
                own = block if self._alone else block[block["environment"] == member.number]
                if len(own):
                    times = self._times(own)
                    yield self._line(phase, member, "return", times, own["returns"][:, [member.column]])
                    if member.column == 0:
                        named = member._replace(name="") if member.agent else member
                        yield self._line(phase, named, "length", times, own["length"][:, np.newaxis])

    def _lines_of(self, phase: str, steps: Records) -> Iterator[Track]:
        """Yield rewards, observations, actions and extras of steps."""
        recording = self._recording
        extras = recording.phase(phase).extras.at(steps["step"])
        for member in self._members:
            is_own = np.full(len(steps), True)
            if self._is_game:
                is_own = (steps["acted"] >> member.number & 1).astype(np.bool_)
            elif not self._alone:
                is_own = steps["environment"] == member.number
            if not is_own.any():
                continue
            own = steps[is_own]
            times = self._times(own, t=own["t"])
            yield self._line(phase, member, "reward", times, own["rewards"][:, [member.column]])
            for quantity, (paths, names) in member.parts.items():
                values = OBSERVED[quantity](recording, own)
                numbers = [reduce(getitem, path, values).reshape(len(own), -1) for path in paths]
                yield self._line(phase, member, quantity, times, np.concatenate(numbers, axis=1), names)
            for name, values in extras.items():
                agent, _, own_name = name.partition("/") if self._is_game else (member.name, "", name)
                if entity_name(agent) == (member.name or "_"):
                    yield from self._extra(phase, member, own_name, values[is_own], times)

    def _extra(
        self, phase: str, member: Member, name: str, values: MaskedArray, times: Times
    ) -> Iterator[Track]:
        """Yield a value that the loop recorded with steps: as lines, or as bars if it is many numbers."""
        is_given = ~np.ma.getmaskarray(values).reshape(len(values), -1)[:, 0]
        numbers = values.data.reshape(len(values), -1).astype(np.float64)
        quantity = f"extra/{entity_name(name)}"
        if numbers.shape[1] <= MAX_BARS:
            # A gap in the line where the value was not recorded
            numbers = np.where(is_given[:, np.newaxis], numbers, np.nan)
            names = [f"{name}[{i}]" for i in range(numbers.shape[1])]
            yield self._line(phase, member, quantity, times, numbers, names)
        elif is_given.any():
            bars = zip(times["step"][is_given].tolist(), map(rr.BarChart, numbers[is_given]), strict=True)
            view = View("bars", f"{member.name} {name}".strip(), rrb.BarChartView)
            yield rows_of(self._entity(phase, member.name, quantity), list(bars), view)

    def _line(
        self,
        phase: str,
        member: Member,
        quantity: str,
        times: Times,
        values: Array,
        names: Sequence[str] = ("",),
    ) -> Track:
        """Return series, [rows, names]; the first also with how they are drawn, and in which view.

        A view shows a quantity of all environments; one of several numbers those of one environment.
        """
        entity = self._entity(phase, member.name, quantity)
        if entity in self._described:
            return Track(entity, times, scalars(values))
        self._described.add(entity)
        colours, lines = phase_colours(phase, len(names)), names
        if len(names) == 1:
            lines = [f"{phase} {member.name}".strip()]
            if member.name:
                shades = line_colours(min(len(self._members), MAX_MEMBERS))
                colours = [shades[member.number % len(shades)]]
        style: Any = series_lines(lines, colours)
        if names == ["action"]:  # of a Discrete space: lines between such numbers mean nothing
            style = rr.SeriesPoints(names=lines, colors=colours, marker_sizes=[1.5])
        tab, title = OVERVIEW, quantity.removeprefix("extra/")
        actions = self._recording.phase(phase).action_names(member.agent) if quantity == "action" else ()
        if 0 < len(actions) <= FEW:
            space = self._recording.spaces["action"]
            least = least_number(space["spaces"][member.agent] if member.agent else space)
            title = f"action: {', '.join(f'{i} {name}' for i, name in enumerate(actions, least))}"
        if member.name and len(names) > 1:
            tab, title = title.capitalize(), f"{member.name} {title}"
        view = View(tab, title.replace("_", " "), has_focus=title not in ("return", "length"))
        return Track(entity, times, scalars(values), [style], view if member.number < MAX_MEMBERS else None)

    def _recorded_frames(self, phase: str) -> Iterator[tuple[int, Row]]:
        """Yield environment and row of each recorded frame, at the step of its own environment."""
        recording, n = self._recording, len(self._environments)
        is_each_step = frames_every(recording) == 1
        for frame in recording.phase(phase).frames.decoded():
            environment, _ = frame_place(frame)
            if environment < n:
                step = max(0, _step(frame["log_time"]) - (n - 1 - environment))
                if self._is_later(phase, environment, step) or not is_each_step:
                    yield environment, (step, _picture(frame["data"]))

    def _drawn_frames(self, phase: str, episodes: Sequence[int]) -> Iterator[Track]:
        """Yield pictures of episodes that the environment draws, as far as it does what was recorded."""
        recording = self._recording
        sources = {number: pictures.source_of(recording, phase, self._trust, number) for number in episodes}
        notes = sorted({f"No {phase} pictures: {reason}" for _, reason in sources.values() if reason})
        chosen = [number for number, (source, _) in sources.items() if source is pictures.Source.REDRAWN]
        number, times, environment, rows = 0, [0], 0, []
        try:
            for number, t, pixels in redrawn(recording, phase, chosen, self._trust) if chosen else ():
                if t == 0:
                    times = [_step(time) for time in log_times_of(recording, phase, number)]
                    environment = recording.phase(phase).episode(number).place
                    self._stage(f"drawing {phase} episode {chosen.index(number) + 1:,} of {len(chosen):,}")
                step = times[t - 1] if t else times[0] - 1
                if self._is_later(phase, environment, step):
                    rows.append((step, _picture(encoded_picture(pixels))))
                if t == len(times) or len(rows) == FRAMES_SENT:
                    frames = self._frames(phase, environment, rows)
                    yield frames
                    rows = []
                    if t == len(times):  # nothing is shown until the next picture
                        end = {"step": np.array([step + len(self._environments)])}
                        yield Track(frames.entity, end, rr.Clear.columns(is_recursive=[False]))
        except CannotRedo as error:
            notes.append(f"No {phase} pictures from episode {number or chosen[0]} on: {error}")
        if rows:
            yield self._frames(phase, environment, rows)
        for note in notes:
            self._selection.warnings.append(note)
            yield rows_of(f"{self._root}/log", [(self.last, rr.TextLog(note, level="WARN"))], LOG)

    def _is_later(self, phase: str, environment: int, step: int) -> bool:
        """Return whether a picture is later than the one before.

        With a picture at each step, that of a reset must not hide that of the last step.
        """
        before = self._pictured.get((phase, environment), -1)
        self._pictured[phase, environment] = step
        return before < step

    def _frames(self, phase: str, environment: int, rows: Sequence[Row]) -> Track:
        parts = [phase, *filter(None, [self._environments[environment]]), "frame"]
        return rows_of(self._entity(*parts), rows, View(phase, " ".join(parts), rrb.Spatial2DView))

    def _entity(self, *parts: str) -> str:
        return "/".join([self._root, *filter(None, parts)])

    def _batches(self, phase: str, spans: Sequence[range]) -> Iterator[Records]:
        """Yield the steps of all environments, at most a batch of each at a time."""
        recording, table = self._recording, self._recording.phase(phase).steps
        if table.dtype is None:
            for span in spans:
                yield from map(taken, table.numbered(span))
            return
        limit = max(1, min(MAX_ROWS * len(self._environments), _BATCH_BYTES // table.dtype.itemsize))
        for span in spans:
            for start in range(span.start, span.stop, limit):
                blocks = table.blocks(start, min(start + limit, span.stop))
                steps = taken(np.concatenate([np.empty(0, table.row_dtype), *blocks]))
                if len(steps):
                    if self._scene:
                        check_steps(steps, recording.mdp, str(recording.path), "recorded")
                    yield steps

    def _times(self, records: Records, **timelines: Array) -> Times:
        times = times_of(records["log_time"], episode=records["episode"], **timelines)
        self.last = max(self.last, int(times["step"].max()))
        return times


def _parts(recording: Recording, agent: str = "") -> dict[str, Part]:
    """Return the numbers of a step, of one agent or of all, that are drawn as lines."""
    parts = {}
    for quantity in OBSERVED if recording.train.steps.dtype is not None else ():
        leaves = [
            leaf
            for leaf in leaves_of(recording.spaces[quantity], f"the {quantity} space")
            if leaf.dtype is not None and (not agent or leaf.path[0] == agent)
        ]
        names = [name for leaf in leaves for name in number_names(leaf, quantity, skip=bool(agent))]
        if 0 < len(names) <= MAX_LINES:
            parts[quantity] = [leaf.path for leaf in leaves], names
    return parts


def entity_name(name: str) -> str:
    """Return a user's name as a part of an entity's path."""
    return re.sub(r"[^\w.-]+", "_", name)[:80] or "_"


def _picture(data: bytes) -> rr.EncodedImage:
    return rr.EncodedImage(contents=data, media_type=media_type(data) or "image/jpeg")


def _first_frame(data: bytes) -> bytes:
    """Return the first frame of a film as PNG; empty if it is none."""
    image = require("PIL.Image", extra="plots", purpose="logged films in Rerun")
    try:
        with image.open(io.BytesIO(data), formats=["WEBP"]) as film:
            film.convert("RGB").save(buffer := io.BytesIO(), "png")
    except (OSError, ValueError, image.DecompressionBombError):
        return b""
    return buffer.getvalue()


def _step(log_time: int) -> int:
    return log_time // schema.STEP_NANOSECONDS
