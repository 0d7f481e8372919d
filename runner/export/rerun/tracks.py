"""A track is what one entity shows over time: readers of runs yield tracks, and one writer sends them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import ArrayLike, NDArray

from runner.drawing import palette
from runner.export.rerun.selection import Selection
from runner.recording.marks import Mark
from runner.recording.reader import Recording
from runner.recording.schema import STEP_NANOSECONDS
from runner.util.arrays import Array, Ints, Scalar

APPLICATION: Final = "dualtaxi"
MAX_ROWS: Final = 8_192
"""Maximum number of rows sent at once: the web viewer drops larger columns."""
MAX_QUEUED: Final = 40 * MAX_ROWS
"""Rows that may wait to be compressed, which takes longer than making them."""
_POINT: Final = pa.list_(pa.field("item", pa.float32(), nullable=False), 2)
_STRIP: Final = pa.list_(pa.field("item", _POINT, nullable=False))
_BLOB: Final = pa.list_(pa.field("item", pa.uint8(), nullable=False))
Colour = tuple[int, ...]
GREY: Final[Colour] = palette.rgb(palette.MIDTONE)
Floats = NDArray[np.float64]
Points = NDArray[np.float32]
"""[..., 2]: x and y."""
Times = dict[str, Array]
"""[n] numbers by timeline."""


class TrackView(NamedTuple):
    """A view of the viewer, of all tracks that name it."""

    group: str
    """Decides where it is placed."""
    name: str
    kind: type[rrb.View] = rrb.TimeSeriesView
    options: Mapping[str, Any] = {}
    has_focus: bool = False
    """Whether its time axis shows the episodes that were asked for alone."""


@dataclass(frozen=True)
class Track:
    """Rows of an entity; its first track also has what never changes."""

    entity: str
    """Its path below that of the run."""
    times: Times = field(default_factory=dict)
    columns: Iterable[Any] = ()
    """Components of as many rows as there are times."""
    static: Sequence[Any] = ()
    view: TrackView | None = None


class TrackRow(NamedTuple):
    """What an entity shows from a step on."""

    entity: str
    step: int
    shown: rr.AsComponents
    view: TrackView | None = None


@dataclass(frozen=True)
class TrackSource:
    """A run to export."""

    recording: Recording
    title: str
    root: str = ""
    """Entity path of everything of the run; empty for the root."""
    tint: str | None = None
    """Base colour of its metrics, where runs are compared."""
    marks: Sequence[Mark] = ()
    """The marks at its steps."""


@dataclass(eq=False)
class Writer:
    """Sends the tracks of a run to a stream, and keeps which views they have."""

    stream: rr.RecordingStream
    source: TrackSource
    selection: Selection
    stage: Callable[[str], None]
    """Called with what takes long."""
    last: int = 0
    """The last step of the run, or else of its lines that were sent."""
    entities: set[str] = field(default_factory=set)
    views: dict[tuple[str, str], tuple[TrackView, dict[str, None]]] = field(default_factory=dict)
    """By group and name, each with its entities."""
    _queued: int = 0

    def send(self, tracks: Iterable[Track]) -> None:
        """Send tracks by columns."""
        for track in tracks:
            entity = f"{self.source.root}/{track.entity}"
            if track.entity not in self.entities:
                self.entities.add(track.entity)
                for archetype in track.static:
                    self.stream.log(entity, archetype, static=True)
            if view := track.view:
                self.views.setdefault((view.group, view.name), (view, {}))[1][entity] = None
            if track.times:
                steps = track.times["step"]
                if "episode" in track.times:
                    self.last = max(self.last, int(steps.max()))
                times = [rr.TimeColumn(name, sequence=numbers) for name, numbers in track.times.items()]
                self.stream.send_columns(entity, times, track.columns)
                self._queued += len(steps)
                if self._queued > MAX_QUEUED:
                    self.stream.flush()
                    self._queued = 0


class Component(NamedTuple):
    """An Arrow array with the interface of a batch of Rerun's, which would copy it."""

    descriptor: rr.ComponentDescriptor
    array: pa.Array

    def component_descriptor(self) -> rr.ComponentDescriptor:
        """Return the descriptor of the component."""
        return self.descriptor

    def as_arrow_array(self) -> pa.Array:
        """Return the array."""
        return self.array


def new_stream(recording_id: str) -> rr.RecordingStream:
    """Return a stream without the timelines that Rerun adds by itself."""
    stream = rr.RecordingStream(APPLICATION, recording_id=recording_id)
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    return stream


def times_of(log_time: ArrayLike, **timelines: Array) -> Times:
    """Return the timeline `step` of log times, and others."""
    steps = np.asarray(log_time, np.int64) // STEP_NANOSECONDS
    return {"step": steps, **{name: each.astype(np.int64) for name, each in timelines.items()}}


def columns(archetype: object, lengths: Ints | None = None, **parts: Array) -> list[rr.ComponentColumn]:
    """Return the columns of n rows of a class such as `rerun.Points2D`, without one object per row.

    The parts are, by component, text or numbers [n, instances], points [n, instances, 2], line strips
    [n, strips, points, 2] or bytes [n, 1, size]. With `lengths`, rows have different numbers of instances,
    and the parts are [all instances, ...].
    """
    made = []
    for name, part in parts.items():
        counts = np.full(len(part), part.shape[1]) if lengths is None else lengths
        flat = part if lengths is not None else part.reshape(-1, *part.shape[2:])
        # Arrow refuses memory that is not aligned, which the field of a lone record may be.
        flat = np.require(flat, requirements=["C", "A"])
        items = pa.array(flat.reshape(-1))
        if flat.dtype == np.float32 and flat.ndim > 1:
            items = pa.FixedSizeListArray.from_arrays(items, type=_POINT)
        if flat.ndim == 3 or flat.dtype == np.uint8:
            kind = _BLOB if flat.dtype == np.uint8 else _STRIP
            offsets = np.arange(len(flat) + 1, dtype=np.int32) * np.int32(flat.shape[1])
            items = pa.ListArray.from_arrays(offsets, items, type=kind)
        component = Component(getattr(archetype, f"descriptor_{name}")(), items)
        made.append(rr.ComponentColumn(component.descriptor, component, lengths=counts))
    return made


def scalars(values: Array) -> list[rr.ComponentColumn]:
    """Return the column of series, [n, series]."""
    return columns(rr.Scalars, scalars=values.astype(np.float64, copy=False))


def in_tracks(rows: Iterable[TrackRow], size: int = MAX_ROWS) -> Iterator[Track]:
    """Yield rows as tracks, at most `size` rows of an entity at once; they have the same components."""
    waiting: dict[tuple[str, type], list[TrackRow]] = {}
    for row in rows:
        key = row.entity, type(row.shown)
        group = waiting.setdefault(key, [])
        group.append(row)
        if len(group) == size:
            yield _track_of(waiting.pop(key))
    yield from map(_track_of, waiting.values())


def _track_of(rows: Sequence[TrackRow]) -> Track:
    shown = []
    for batches in zip(*(row.shown.as_component_batches() for row in rows), strict=True):
        items = pa.concat_arrays([batch.as_arrow_array() for batch in batches])
        component = Component(batches[0].component_descriptor(), items)
        shown.append(rr.ComponentColumn(component.descriptor, component))
    steps = np.array([row.step for row in rows])
    return Track(rows[0].entity, {"step": steps}, shown, view=rows[0].view)


def cleared(entities: Iterable[str], steps: Array | Sequence[int]) -> Iterator[Track]:
    """Yield the tracks that clear entities, and all below them, from each of these steps on."""
    for entity in entities if len(steps) else ():
        yield Track(entity, {"step": np.array(steps)}, rr.Clear.columns(is_recursive=[True] * len(steps)))


def repeated(row: NDArray[Scalar], n: int) -> NDArray[Scalar]:
    """Return n rows of the same content, [n, ...]."""
    return np.broadcast_to(row, (n, *row.shape))


def pairs(points: Iterable[Sequence[float]]) -> Points:
    """Return points or sizes as an array, [points, 2]."""
    return np.array(list(points), np.float32).reshape(-1, 2)


def centred(count: int, spacing: float) -> list[float]:
    """Return positions at equal distances around 0."""
    return [(i - (count - 1) / 2) * spacing for i in range(count)]


def texts(rows: Sequence[str]) -> NDArray[np.object_]:
    """Return one text per row, [n, 1]."""
    return np.array(rows, dtype=object)[:, None]


def text_track(entity: str, times: Times, where: tuple[float, float], rows: Sequence[str]) -> Track:
    """Return a track of one text per row, always at the same point."""
    positions = repeated(pairs([where]), len(rows))
    return Track(entity, times, columns(rr.Points2D, positions=positions, labels=texts(rows)))


def agent_colours(agents: Iterable[int]) -> list[Colour]:
    """Return the colours of agents, or of their movers, by number."""
    return [palette.rgb(palette.agent(i)) for i in agents]


def grey_text() -> rr.Points2D:
    """Return how a text without a point is drawn."""
    return rr.Points2D.from_fields(radii=0.0, show_labels=True, colors=[GREY])
