"""A loop recorded with `record` as tracks: episodes, logged values, frames, arrays, and the selected steps.

Entities of a vector environment are below `train/env_3`, those of a game's agent below `train/agent_0`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import reduce
from operator import getitem
from typing import Any, Final, NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from runner.drawing.raster import image_bytes
from runner.errors import CannotRedo, RecordingError
from runner.export import pictures
from runner.export.encoded import encoded_picture
from runner.export.painting import decoded, redrawn
from runner.export.rerun.layout import OVERVIEW
from runner.export.rerun.metrics import line_colours, phase_colours, series_lines
from runner.export.rerun.selection import MAX_MEMBERS, Selection
from runner.export.rerun.tracks import (
    MAX_ROWS,
    Row,
    Times,
    Track,
    TrackView,
    Writer,
    grouped,
    rows_of,
    scalars,
    times_of,
)
from runner.export.values import FEW, acted, number_names, observed
from runner.recording import schema
from runner.recording.messages import frame_place, media_type
from runner.recording.observation_names import observation_names
from runner.recording.reader import Recording
from runner.recording.spaces import least_number, leaves_of
from runner.replay.steps import frames_every, log_times_of
from runner.util.arrays import Array, MaskedArray, Records

MAX_BARS: Final = 16
"""Extras of more numbers are drawn as bars."""
MAX_LINES: Final = 24
"""Observations or actions of more numbers are not drawn as lines."""
FRAMES_SENT: Final = 64
"""Pictures sent at once."""
LOG: Final = TrackView("log", "Log", rrb.TextLogView)
_NAMED: Final = {"picture": ("pictures", rrb.Spatial2DView), "array": ("array", rrb.TensorView)}
"""Entities of what is logged by name: the group and the kind of their views."""
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


class LoopTracks:
    """Makes the tracks of a loop: an overview, lines of its steps, and pictures that are drawn of them."""

    def __init__(
        self, writer: Writer, selection: Selection, trust: bool, stage: Callable[[str], None]
    ) -> None:
        recording = self._recording = writer.source.recording
        self._writer, self._root, self._selection = writer, writer.source.root, selection
        self._trust, self._stage = trust, stage
        self._is_game, n = len(recording.agents) > 1, recording.environments
        self._environments = [f"env_{i}" if n > 1 else "" for i in range(n)]
        self._alone = n == 1
        """Whether environments take no turns, or follow one another."""
        if self._is_game:
            agents = enumerate(recording.agents)
            self._members = [Member(i, entity_name(a), i, _parts(recording, a), a) for i, a in agents]
        else:
            parts = _parts(recording)
            self._members = [Member(i, name, 0, parts) for i, name in enumerate(self._environments)]
        self._pictured: dict[tuple[str, int], int] = {}
        """The step of the last picture, by phase and environment."""

    def overview(self) -> Iterator[Track]:
        """Yield everything but the steps."""
        recording = self._recording
        for phase in schema.PHASES:
            yield from self._episodes(phase)
            for environment, frames in grouped(self._recorded_frames(phase), FRAMES_SENT):
                yield self._frames(phase, environment, frames)
        for image in recording.table(schema.IMAGE_TOPIC).decoded():
            if data := _still(image["data"]):
                yield self._named("picture", image["frame_id"], image["log_time"], _picture(data))
        for series, rows in recording.scalars():
            names = np.array([entity_name(name) for name, _ in series])[rows["series"]]
            for name in dict.fromkeys(names.tolist()):
                own = rows[names == name]
                times, view = times_of(own["log_time"], episode=own["episode"]), name.replace("_", " ")
                values, style = scalars(own["value"][:, np.newaxis]), [series_lines([name])]
                yield Track(f"{self._root}/logged/{name}", times, values, style, TrackView("logged", view))
        texts = (
            ("log", (_step(text["log_time"]), rr.TextLog(f"{text['name']}: {text['message']}", level="INFO")))
            for text in recording.table(schema.LOG_TOPIC).decoded()
        )
        for name, lines in grouped(texts, MAX_ROWS):
            yield rows_of(f"{self._root}/{name}", lines, LOG)
        arrays = recording.table(schema.ARRAY_TOPIC).messages()
        for (time, _), array in zip(arrays, recording.arrays(), strict=True):
            yield self._named("array", array.name, time, rr.Tensor(np.atleast_1d(array.values)))

    def _named(self, folder: str, name: str, log_time: int, shown: rr.AsComponents) -> Track:
        """Return a track of what was logged once under a name, in a view of its own."""
        group, kind = _NAMED[folder]
        name = entity_name(name)
        return rows_of(
            f"{self._root}/{folder}/{name}", [(_step(log_time), shown)], TrackView(group, name, kind)
        )

    def _episodes(self, phase: str) -> Iterator[Track]:
        """Yield returns and lengths: of a game one length, and the return of each agent."""
        for block in self._recording.phase(phase).episodes.blocks():
            for member in self._members:
                own = block if self._alone else block[block["environment"] == member.number]
                if len(own):
                    times = times_of(own["log_time"], episode=own["episode"])
                    yield self._line(phase, member, "return", times, own["returns"][:, [member.column]])
                    if member.column == 0:
                        named = member._replace(name="") if member.agent else member
                        yield self._line(phase, named, "length", times, own["length"][:, np.newaxis])

    def lines(self, phase: str, steps: Records) -> Iterator[Track]:
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
            times = times_of(own["log_time"], episode=own["episode"], t=own["t"])
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
        """Yield a value that the loop recorded with steps: as lines, as bars if it is long, or as text."""
        is_given = ~np.ma.getmaskarray(values).reshape(len(values), -1)[:, 0]
        quantity = f"extra/{entity_name(name)}"
        if not values.dtype.hasobject and values.data[0].size <= MAX_BARS:
            # A gap in the line where the value was not recorded
            numbers = values.data.reshape(len(values), -1).astype(np.float64)
            numbers[~is_given] = np.nan
            names = [f"{name}[{i}]" for i in range(numbers.shape[1])]
            yield self._line(phase, member, quantity, times, numbers, names)
            return
        texts: list[Row] = []
        bars: list[Row] = []
        for step, value in zip(times["step"][is_given].tolist(), values.data[is_given], strict=True):
            if isinstance(value, str):
                texts.append((step, rr.TextDocument(value.encode(errors="replace").decode())))
            elif value.size:
                bars.append((step, rr.BarChart(value.ravel().astype(np.float64))))
        entity, title = self._entity(phase, member.name, quantity), f"{member.name} {name}".strip()
        if texts:
            yield rows_of(entity, texts, TrackView("texts", title, rrb.TextDocumentView))
        if bars:
            yield rows_of(entity, bars, TrackView("bars", title, rrb.BarChartView))

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
        if entity in self._writer.entities:
            return Track(entity, times, scalars(values))
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
        view = TrackView(tab, title.replace("_", " "), has_focus=title not in ("return", "length"))
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

    def drawn_frames(self, phase: str, episodes: Sequence[int]) -> Iterator[Track]:
        """Yield pictures of episodes that the environment draws, as far as it does what was recorded."""
        recording = self._recording
        sources = {number: pictures.source_of(recording, phase, self._trust, number) for number in episodes}
        notes = sorted({f"No {phase} pictures: {reason}" for _, reason in sources.values() if reason})
        chosen = [
            number for number, (source, _) in sources.items() if source is pictures.PictureSource.REDRAWN
        ]
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
            yield rows_of(f"{self._root}/log", [(self._writer.last, rr.TextLog(note, level="WARN"))], LOG)

    def _is_later(self, phase: str, environment: int, step: int) -> bool:
        """Return whether a picture is later than the one before.

        With a picture at each step, that of a reset must not hide that of the last step.
        """
        before = self._pictured.get((phase, environment), -1)
        self._pictured[phase, environment] = step
        return before < step

    def _frames(self, phase: str, environment: int, rows: Sequence[Row]) -> Track:
        parts = [phase, *filter(None, [self._environments[environment]]), "frame"]
        return rows_of(self._entity(*parts), rows, TrackView(phase, " ".join(parts), rrb.Spatial2DView))

    def _entity(self, *parts: str) -> str:
        return "/".join([self._root, *filter(None, parts)])


def _parts(recording: Recording, agent: str = "") -> dict[str, Part]:
    """Return the numbers of a step, of one agent or of all, that are drawn as lines."""
    parts = {}
    has_grid = recording.tabular and recording.mdp.scene is not None
    for quantity in () if has_grid or recording.train.steps.dtype is None else OBSERVED:
        leaves = [
            leaf
            for leaf in leaves_of(recording.spaces[quantity], f"the {quantity} space")
            if leaf.dtype is not None and (not agent or leaf.path[0] == agent)
        ]
        known = observation_names(recording) if quantity == "observation" else ()
        names = [name for leaf in leaves for name in number_names(leaf, quantity, bool(agent), known)]
        if 0 < len(names) <= MAX_LINES:
            parts[quantity] = [leaf.path for leaf in leaves], names
    return parts


def entity_name(name: str) -> str:
    """Return a user's name as a part of an entity's path."""
    return re.sub(r"[^\w.-]+", "_", name)[:80] or "_"


def _picture(data: bytes) -> rr.EncodedImage:
    return rr.EncodedImage(contents=data, media_type=media_type(data) or "image/jpeg")


def _still(data: bytes) -> bytes:
    """Return a picture, of a film its first frame as PNG; empty if it is neither."""
    if media_type(data) in ("image/png", "image/jpeg"):
        return data
    try:
        return image_bytes(np.asarray(decoded(data, "A film", ("WEBP",))), "png")
    except RecordingError:
        return b""


def _step(log_time: int) -> int:
    return log_time // schema.STEP_NANOSECONDS
