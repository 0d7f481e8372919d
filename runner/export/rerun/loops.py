"""A loop recorded with `record` as tracks: episodes, logged values, frames, arrays, and the selected steps.

Entities of a vector environment are below `train/env_3`, those of a game's agent below `train/agent_0`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from runner.drawing.raster import image_bytes
from runner.errors import CannotRedo, RecordingError
from runner.export import pictures
from runner.export.pictures import decoded, encoded_picture, redrawn
from runner.export.rerun.metrics import line_colours, phase_colours, series_lines
from runner.export.rerun.selection import MAX_MEMBERS, time_of
from runner.export.rerun.steps import Batch
from runner.export.rerun.tracks import OVERVIEW, Times, Track, TrackView, Writer, scalars, times_of
from runner.export.values import FEW, acted, names_in, number_names, observed
from runner.recording import schema
from runner.recording.environment import observation_names
from runner.recording.messages import decode_array, frame_place, media_type
from runner.recording.reader import Recording
from runner.recording.spaces import least_number, leaves_of
from runner.replay.steps import frames_every, transitions_of
from runner.util.arrays import Array, Flags, MaskedArray, Records, leaves

MAX_BARS: Final = 16
"""Extras of more numbers are drawn as bars."""
MAX_LINES: Final = 24
"""Observations or actions of more numbers are not drawn as lines."""
LOG: Final = TrackView("log", "Log", rrb.TextLogView)
OBSERVED: Final = {"observation": observed, "action": acted}


class Member(NamedTuple):
    """An environment of a vector, or an agent of a game."""

    number: int
    name: str = ""
    """`env_3`, or the agent; empty if there is only one."""
    column: int = 0
    """Its column among the rewards."""
    numbers: Mapping[str, Sequence[str]] = {}
    """The names of all numbers of `observation` and `action`, if they are drawn as lines."""
    agent: str = ""
    """The agent's name in the recording of a game."""

    def is_own(self, rows: Records) -> Flags:
        """Return which steps or episodes are of the member."""
        if self.agent and "acted" in (rows.dtype.names or ()):
            return (rows["acted"] >> self.number & 1).astype(np.bool_)
        is_alone = self.agent or not self.name
        return np.full(len(rows), True) if is_alone else np.asarray(rows["environment"] == self.number)


class LoopTracks:
    """Makes the tracks of a phase of a loop: episodes, lines of its steps, and pictures."""

    def __init__(self, writer: Writer, phase: str) -> None:
        recording = self._recording = writer.recording
        self._writer = writer
        self._phase = phase
        self._of_phase = recording.phase(phase)
        if len(recording.agents) > 1:
            agents = enumerate(recording.agents)
            self._members = [Member(i, entity_name(a), i, _numbers(recording, a), a) for i, a in agents]
        else:
            numbers, environments = _numbers(recording), range(recording.environments)
            self._members = [Member(i, self._environment(i), numbers=numbers) for i in environments]
        self._pictured: dict[int, int] = {}
        """The step of the last picture of each environment."""

    @property
    def still(self) -> Iterator[Track]:
        """Everything but the steps: episodes, and recorded frames at the steps of their environments."""
        for block in self._of_phase.episodes.blocks():
            for member in self._members:
                episodes = block[member.is_own(block)]
                if len(episodes):
                    times = times_of(episodes["log_time"], episode=episodes["episode"])
                    yield self._line(member, "return", times, episodes["returns"][:, [member.column]])
                    if member.column == 0:  # agents have one length
                        named = member._replace(name="") if member.agent else member
                        yield self._line(named, "length", times, episodes["length"][:, np.newaxis])
        recording = self._recording
        is_each_step = frames_every(recording) == 1
        for frame in self._of_phase.frames.decoded():
            environment, _ = frame_place(frame)
            later = recording.environments - 1 - environment
            step = max(0, time_of(frame) - later)
            if later >= 0 and (self._is_later(environment, step) or not is_each_step):
                yield self._frame(environment, step, _picture(frame["data"]))

    def of(self, batch: Batch) -> Iterator[Track]:
        """Yield rewards, observations, actions and extras of steps."""
        recording, steps = self._recording, batch.records
        extras = self._of_phase.extras.at(steps["step"])
        for member in self._members:
            is_own = member.is_own(steps)
            if not is_own.any():
                continue
            member_steps = steps[is_own]
            times = times_of(member_steps["log_time"], episode=member_steps["episode"], t=member_steps["t"])
            yield self._line(member, "reward", times, member_steps["rewards"][:, [member.column]])
            for quantity, names in member.numbers.items():
                values = OBSERVED[quantity](recording, member_steps)
                parts = leaves("", values[member.agent] if member.agent else values)
                numbers = np.concatenate([part.reshape(len(member_steps), -1) for _, part in parts], axis=1)
                yield self._line(member, quantity, times, numbers, names)
            prefix = f"{member.agent}/" if member.agent else ""
            for name, values in extras.items():
                if name.startswith(prefix):
                    yield from self._extra(member, name.removeprefix(prefix), values[is_own], times)

    def _extra(self, member: Member, name: str, values: MaskedArray, times: Times) -> Iterator[Track]:
        """Yield a value that the loop recorded with steps: as lines, as bars if it is long, or as text."""
        is_given = ~np.ma.getmaskarray(values).reshape(len(values), -1)[:, 0]
        quantity = f"extra/{entity_name(name)}"
        if not values.dtype.hasobject and values.data[0].size <= MAX_BARS:
            # A gap in the line where the value was not recorded
            numbers = values.data.reshape(len(values), -1).astype(np.float64)
            numbers[~is_given] = np.nan
            yield self._line(member, quantity, times, numbers, [*names_in(name, values.shape[1:])])
            return
        entity = _entity(self._phase, member.name, quantity)
        title = f"{member.name} {name}".strip()
        texts = TrackView("texts", title, rrb.TextDocumentView)
        bars = TrackView("bars", title, rrb.BarChartView)
        for step, value in zip(times["step"][is_given].tolist(), values.data[is_given], strict=True):
            if isinstance(value, str):
                text = rr.TextDocument(value.encode(errors="replace").decode())
                yield Track(entity, view=texts, row=(step, text))
            elif value.size:
                chart = rr.BarChart(value.ravel().astype(np.float64))
                yield Track(entity, view=bars, row=(step, chart))

    def _line(
        self, member: Member, quantity: str, times: Times, values: Array, names: Sequence[str] = ("",)
    ) -> Track:
        """Return series, [rows, names]; the first also with how they are drawn, and in which view.

        A view shows a quantity of all environments; one of several numbers those of one environment.
        """
        entity = _entity(self._phase, member.name, quantity)
        if entity in self._writer.entities:
            return Track(entity, times, scalars(values))
        colours = phase_colours(self._phase, len(names))
        lines = names
        if len(names) == 1:
            lines = [f"{self._phase} {member.name}".strip()]
            if member.name:
                shades = line_colours(min(len(self._members), MAX_MEMBERS))
                colours = [shades[member.number % len(shades)]]
        style: Any = series_lines(lines, colours)
        is_discrete = quantity == "action" and names == ["action"]
        if is_discrete:  # lines between such numbers mean nothing
            style = rr.SeriesPoints(names=lines, colors=colours, marker_sizes=[1.5])
        tab = OVERVIEW
        title = quantity.removeprefix("extra/")
        actions = self._of_phase.action_names(member.agent) if quantity == "action" else ()
        if 0 < len(actions) <= FEW:
            space = self._recording.spaces["action"]
            least = least_number(space["spaces"][member.agent] if member.agent else space)
            title = f"action: {', '.join(f'{i} {name}' for i, name in enumerate(actions, least))}"
        if member.name and len(names) > 1:
            tab = title.capitalize()
            title = f"{member.name} {title}"
        view = TrackView(tab, title.replace("_", " "), has_focus=title not in ("return", "length"))
        return Track(entity, times, scalars(values), [style], view if member.number < MAX_MEMBERS else None)

    def drawn(self) -> Iterator[Track]:
        """Yield pictures of episodes that the environment draws, as far as it does what was recorded."""
        recording = self._recording
        phase = self._phase
        selection = self._writer.selection
        trust = selection.trust
        episodes = selection.drawn.get(phase, ())
        sources = {number: pictures.source_of(recording, phase, trust, number) for number in episodes}
        notes = sorted({f"No {phase} pictures: {reason}" for _, reason in sources.values() if reason})
        redrawable = pictures.PictureSource.REDRAWN
        numbers = [number for number, (source, _) in sources.items() if source is redrawable]
        number = 0
        try:
            if numbers:
                for number, t, pixels in redrawn(recording, phase, numbers, trust):
                    if t == 0:
                        after = [
                            int(step["log_time"]) // schema.STEP_NANOSECONDS
                            for step in transitions_of(recording, phase, number)
                        ]
                        times = [after[0] - 1, *after]
                        place = self._of_phase.episode(number).place
                        count = f"{numbers.index(number) + 1:,} of {len(numbers):,}"
                        self._writer.stage(f"drawing {phase} episode {count}")
                    if self._is_later(place, times[t]):
                        yield self._frame(place, times[t], _picture(encoded_picture(pixels)))
                    if t == len(after):  # nothing is shown until the next picture
                        yield self._frame(place, times[t] + recording.environments, rr.Clear(recursive=False))
        except CannotRedo as error:
            notes.append(f"No {phase} pictures from episode {number or numbers[0]} on: {error}")
        for note in notes:
            selection.warnings.append(note)
            yield Track("log", view=LOG, row=(self._writer.last, rr.TextLog(note, level="WARN")))

    def _is_later(self, environment: int, step: int) -> bool:
        """Return whether a picture is later than the one before.

        With a picture at each step, that of a reset must not hide that of the last step.
        """
        before = self._pictured.get(environment, -1)
        self._pictured[environment] = step
        return before < step

    def _frame(self, environment: int, step: int, picture: rr.AsComponents) -> Track:
        entity = _entity(self._phase, self._environment(environment), "frame")
        view = TrackView(self._phase, entity.replace("/", " "), rrb.Spatial2DView)
        return Track(entity, view=view, row=(step, picture))

    def _environment(self, number: int) -> str:
        return f"env_{number}" if self._recording.environments > 1 else ""


def logged_tracks(recording: Recording) -> Iterator[Track]:
    """Yield what a loop logged: pictures, arrays, texts and numbers."""
    for image in recording.table(schema.IMAGE_TOPIC).decoded():
        if data := _still(image["data"]):
            name = entity_name(image["frame_id"])
            view = TrackView("picture", name, rrb.Spatial2DView)
            yield Track(f"picture/{name}", view=view, row=(time_of(image), _picture(data)))
    for time, array in recording.table(schema.ARRAY_TOPIC).parsed(decode_array):
        name = entity_name(array.name)
        tensor = rr.Tensor(np.atleast_1d(array.values))
        view = TrackView("array", name, rrb.TensorView)
        yield Track(f"array/{name}", view=view, row=(time // schema.STEP_NANOSECONDS, tensor))
    for text in recording.table(schema.LOG_TOPIC).decoded():
        line = rr.TextLog(f"{text['name']}: {text['message']}", level="INFO")
        yield Track("log", view=LOG, row=(time_of(text), line))
    for series, rows in recording.scalars():
        names = np.array([entity_name(name) for name, _ in series])[rows["series"]]
        for name in dict.fromkeys(names.tolist()):
            values_of_name = rows[names == name]
            times = times_of(values_of_name["log_time"], episode=values_of_name["episode"])
            view = name.replace("_", " ")
            values = scalars(values_of_name["value"][:, np.newaxis])
            style = [series_lines([name])]
            yield Track(f"logged/{name}", times, values, style, TrackView("logged", view))


def _entity(*parts: str) -> str:
    return "/".join(filter(None, parts))


def _numbers(recording: Recording, agent: str = "") -> dict[str, list[str]]:
    """Return the names of the numbers of a step, of one agent or of all, that are drawn as lines."""
    numbers = {}
    has_grid = recording.tabular and recording.mdp.scene is not None
    if not (has_grid or recording.train.steps.dtype is None):
        for quantity in OBSERVED:
            known = observation_names(recording) if quantity == "observation" else ()
            names = [
                name
                for leaf in leaves_of(recording.spaces[quantity], f"the {quantity} space")
                if not agent or leaf.path[0] == agent
                for name in number_names(leaf, quantity, bool(agent), known)
            ]
            if 0 < len(names) <= MAX_LINES:
                numbers[quantity] = names
    return numbers


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
