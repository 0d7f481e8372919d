"""Arrays as Rerun columns, without one object per row."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from runner.drawing import palette
from runner.export.rerun.step_values import StepValues
from runner.recording.schema import STEP_NANOSECONDS
from runner.util.arrays import Array

APPLICATION: Final = "dualtaxi"
MAX_ROWS: Final = 8_192
"""Maximum number of rows sent at once: the web viewer drops larger columns."""
_POINT: Final = pa.list_(pa.field("item", pa.float32(), nullable=False), 2)
_STRIP: Final = pa.list_(pa.field("item", _POINT, nullable=False))
_BLOB: Final = pa.list_(pa.field("item", pa.uint8(), nullable=False))


@dataclass(frozen=True, eq=False)
class Batch:
    """Steps of one phase."""

    records: NDArray[np.void]
    episode: NDArray[np.int64]
    """[n]: training episodes; for evaluation those before it."""
    time: NDArray[np.int64]
    """[n]: steps executed, this one included."""
    values: StepValues | None = None
    """None where they are unknown, or not exported."""
    trials: int = 0
    """Trials of an evaluation; 0 for training."""

    @classmethod
    def of(
        cls,
        records: NDArray[np.void],
        episode: NDArray[np.int64],
        values: StepValues | None = None,
        trials: int = 0,
    ) -> Batch:
        """Return recorded steps, whose times are known."""
        return cls(records, episode, records["log_time"].astype(np.int64) // STEP_NANOSECONDS, values, trials)

    @classmethod
    def concatenated(cls, parts: Sequence[Batch]) -> Batch:
        """Return successive batches as one; the values of all are known, or of none."""
        if len(parts) == 1:
            return parts[0]
        records, episode, time = (
            np.concatenate([getattr(part, name) for part in parts]) for name in ("records", "episode", "time")
        )
        values = [part.values for part in parts if part.values is not None]
        whole = StepValues.concatenated(values) if values else None
        return cls(records, episode, time, whole, parts[0].trials)

    def number(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the number of the episode at these rows, or of the trial within its evaluation."""
        own = self.records["episode"][rows].astype(np.int64)
        return np.asarray(own % self.trials) if self.trials else own

    @cached_property
    def times(self) -> list[rr.TimeColumn]:
        """The timelines of all rows."""
        return self.times_at(slice(None))

    def times_at(self, rows: slice | NDArray[np.int64]) -> list[rr.TimeColumn]:
        """Return the timelines of some rows."""
        return [
            rr.TimeColumn("step", sequence=self.time[rows]),
            rr.TimeColumn("episode", sequence=self.episode[rows]),
            rr.TimeColumn("t", sequence=self.records["t"][rows].astype(np.int64)),
        ]


def new_stream(recording_id: str) -> rr.RecordingStream:
    """Return a stream without the timelines that Rerun adds by itself."""
    stream = rr.RecordingStream(APPLICATION, recording_id=recording_id)
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    return stream


class Sender:
    """Sends data of the entities below one path."""

    def __init__(self, stream: rr.RecordingStream, path: str) -> None:
        self._stream = stream
        self.path = path

    def send(self, part: str, times: list[rr.TimeColumn], columns: Iterable[Any]) -> None:
        """Send columns, a row for each time."""
        self._stream.send_columns(f"{self.path}/{part}", times, columns)

    def send_static(self, part: str, *archetypes: rr.AsComponents) -> None:
        """Send what never changes."""
        for archetype in archetypes:
            self._stream.log(f"{self.path}/{part}", archetype, static=True)

    def clear(self, part: str, times: Sequence[int]) -> None:
        """Clear a part from each of these times until something is sent for it again."""
        columns = rr.Clear.columns(is_recursive=[True] * len(times))
        self.send(part, [rr.TimeColumn("step", sequence=times)], columns)


class Column(NamedTuple):
    """An Arrow array with the interface of Rerun's `ComponentColumn`, which would copy it."""

    descriptor: rr.ComponentDescriptor
    array: pa.Array

    def component_descriptor(self) -> object:
        """Return the descriptor of the component."""
        return self.descriptor

    def as_arrow_array(self) -> pa.Array:
        """Return the array."""
        return self.array


def instances(archetype: object, **parts: Array) -> list[Column]:
    """Return the columns of n rows with equally many instances each, of a class such as `rerun.Points2D`.

    The parts are, by component, text or numbers [n, instances], or points [n, instances, 2].
    """
    return [
        _column(archetype, name, _offsets(*part.shape[:2]), part.reshape(-1, *part.shape[2:]))
        for name, part in parts.items()
    ]


def ragged(archetype: object, lengths: NDArray[np.int64], **parts: Array) -> list[Column]:
    """Return the columns of rows with different numbers of instances; each part is [all instances, ...]."""
    offsets = pa.array(np.concatenate(([0], np.cumsum(lengths))).astype(np.int32))
    return [_column(archetype, name, offsets, part) for name, part in parts.items()]


def scalars(values: NDArray[np.float64]) -> list[Column]:
    """Return the column of series, [n, series]."""
    return instances(rr.Scalars, scalars=values)


def strips(lines: NDArray[np.float32]) -> list[Column]:
    """Return the column of line strips, [n, strips, points, 2]."""
    n, count, points, _ = lines.shape
    flat = pa.FixedSizeListArray.from_arrays(pa.array(lines.reshape(-1)), type=_POINT)
    each = pa.ListArray.from_arrays(_offsets(n * count, points), flat, type=_STRIP)
    return [Column(rr.LineStrips2D.descriptor_strips(), pa.ListArray.from_arrays(_offsets(n, count), each))]


def images(values: NDArray[np.float32]) -> list[object]:
    """Return the columns of images, [n, pixels], each with its own range of colours."""
    n, pixels = values.shape
    flat = pa.array(np.ascontiguousarray(values).view(np.uint8).reshape(-1))
    blobs = pa.ListArray.from_arrays(_offsets(n, pixels * 4), flat, type=_BLOB)
    rows = pa.ListArray.from_arrays(_offsets(n, 1), blobs)
    with np.errstate(all="ignore"):
        low, high = np.nanmin(values, axis=1), np.nanmax(values, axis=1)
    ranges = np.stack((low, np.where(high > low, high, low + 1)), axis=1).astype(np.float64)
    shown = rr.DepthImage.columns(depth_range=np.nan_to_num(ranges))
    return [Column(rr.DepthImage.descriptor_buffer(), rows), *shown]


def _column(archetype: object, name: str, offsets: pa.Array, flat: Array) -> Column:
    # Arrow refuses memory that is not aligned, which the field of a lone record may be.
    flat = np.require(flat, requirements=["C", "A"])
    items = (
        pa.FixedSizeListArray.from_arrays(flat.reshape(-1), type=_POINT) if flat.ndim == 2 else pa.array(flat)
    )
    descriptor = getattr(archetype, f"descriptor_{name}")()
    return Column(descriptor, pa.ListArray.from_arrays(offsets, items))


def _offsets(count: int, size: int) -> pa.Array:
    return pa.array(np.arange(count + 1, dtype=np.int32) * size)


def pixel_centres(height: int, width: int) -> NDArray[np.float32]:
    """Return the centre of each pixel, row by row, [pixels, 2]."""
    pixel = np.arange(height * width)
    return np.stack((pixel % width + 0.5, pixel // width + 0.5), axis=1).astype(np.float32)


def repeated_point(n: int, x: float, y: float) -> NDArray[np.float32]:
    """Return the same point in each of n rows, [n, 1, 2]."""
    return np.broadcast_to(np.array([[x, y]], np.float32), (n, 1, 2))


def texts(rows: Sequence[str]) -> NDArray[np.object_]:
    """Return one text per row, [n, 1]."""
    return np.array(rows, dtype=object)[:, None]


def rgba(colour: str, alpha: int = 255) -> tuple[int, int, int, int]:
    """Return red, green, blue and alpha of a colour "#rrggbb"."""
    return *palette.rgb(colour), alpha
