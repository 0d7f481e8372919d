"""Arrays as Rerun columns, without an object a row."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from runner.drawing import palette

APPLICATION: Final = "dualtaxi"
_POINT: Final = pa.list_(pa.field("item", pa.float32(), nullable=False), 2)
_STRIP: Final = pa.list_(pa.field("item", _POINT, nullable=False))
_BLOB: Final = pa.list_(pa.field("item", pa.uint8(), nullable=False))


@dataclass(frozen=True, eq=False)
class StepValues:
    """The learners' Q-values at n steps, and maps of them at the steps `renewed` among these."""

    values: NDArray[np.float64]
    """[n, sum of the agents' action counts]: each agent's values of its own actions; of a joint table the
    best over the others' actions."""
    greedy: NDArray[np.int64]
    """[n, agents]: each agent's greedy action."""
    renewed: NDArray[np.int64]
    """[k]: the rows at which the maps were renewed."""
    value_maps: NDArray[np.float32]
    """[k, learners, pixels]: the greatest value in the state of each pixel; nan where there is none."""
    greedy_maps: NDArray[np.int32]
    """[k, learners, pixels]: the learner's greedy action there; -1 where there is none."""


@dataclass(frozen=True, eq=False)
class Batch:
    """Steps of one phase, with what goes with them."""

    records: NDArray[np.void]
    values: StepValues | None
    """None where they are unknown, or not exported."""
    episode: NDArray[np.int64]
    """[n]: training episodes; for evaluation those before it."""
    before: NDArray[np.void]
    """The steps before the first, as many as its trail may show."""
    time: NDArray[np.int64]
    """[n]: steps executed, this one included."""
    trials: int = 0
    """Trials of an evaluation, of whose steps they are; 0 for training."""

    def number(self, rows: Any = slice(None)) -> NDArray[np.int64]:
        """Return the number of each row's episode, or of its trial within the evaluation."""
        own = self.records["episode"][rows].astype(np.int64)
        return np.asarray(own % self.trials) if self.trials else own

    def times(self, rows: Any = None) -> list[rr.TimeColumn]:
        """Return the timelines of these rows, of all unless given."""
        return self._all_times if rows is None else self._times(rows)

    @cached_property
    def _all_times(self) -> list[rr.TimeColumn]:
        return self._times(slice(None))

    def _times(self, rows: Any) -> list[rr.TimeColumn]:
        return [
            rr.TimeColumn("step", sequence=self.time[rows]),
            rr.TimeColumn("episode", sequence=self.episode[rows]),
            rr.TimeColumn("t", sequence=self.records["t"][rows].astype(np.int64)),
        ]


def new_stream(recording_id: str) -> rr.RecordingStream:
    """Return a stream that has no other timelines than ours."""
    stream = rr.RecordingStream(APPLICATION, recording_id=recording_id)
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    return stream


class Sender:
    """Sends what is under one entity path."""

    def __init__(self, stream: rr.RecordingStream, path: str) -> None:
        self._stream = stream
        self.path = path

    def send(self, part: str, times: list[rr.TimeColumn], columns: Iterable[Any]) -> None:
        """Send columns of rows."""
        self._stream.send_columns(f"{self.path}/{part}", times, columns)

    def static(self, part: str, *archetypes: Any) -> None:
        """Log what never changes."""
        for archetype in archetypes:
            self._stream.log(f"{self.path}/{part}", archetype, static=True)

    def clear(self, part: str, times: Sequence[int]) -> None:
        """Say that from these times on nothing is known of a part, until something is sent."""
        whole = [rr.TimeColumn("step", sequence=times)]
        self._stream.send_columns(
            f"{self.path}/{part}", whole, rr.Clear.columns(is_recursive=[True] * len(times))
        )


class _Column:
    """A column whose Arrow array is there already; stands in for Rerun's `ComponentColumn`."""

    def __init__(self, descriptor: Any, array: pa.Array) -> None:
        self._descriptor = descriptor
        self._array = array

    def component_descriptor(self) -> Any:
        return self._descriptor

    def as_arrow_array(self) -> pa.Array:
        return self._array


def instances(archetype: Any, n: int, **parts: NDArray[Any]) -> list[Any]:
    """Return the columns of n rows of equally many instances; each part is [n, instances, ...]."""
    return [column(getattr(archetype, f"descriptor_{name}")(), n, part) for name, part in parts.items()]


def column(descriptor: Any, n: int, values: NDArray[Any]) -> Any:
    """Return a component's column of n rows: text or numbers [n, instances], points [n, instances, 2]."""
    count = values.shape[1]
    flat = _aligned(values).reshape(n * count, *values.shape[2:])
    items = pa.FixedSizeListArray.from_arrays(flat.reshape(-1), type=_POINT) if flat.ndim == 2 else flat
    return _Column(descriptor, pa.ListArray.from_arrays(_offsets(n, count), pa.array(items)))


def lists(archetype: Any, lengths: NDArray[np.int64], **parts: NDArray[Any]) -> list[Any]:
    """Return the columns of rows of so many instances each; each part is [all instances, ...]."""
    offsets = pa.array(np.concatenate(([0], np.cumsum(lengths))).astype(np.int32))
    columns = []
    for name, flat in parts.items():
        descriptor = getattr(archetype, f"descriptor_{name}")()
        columns.append(_Column(descriptor, pa.ListArray.from_arrays(offsets, _items(flat))))
    return columns


def scalars(values: NDArray[np.float64]) -> list[Any]:
    """Return the column of series, [n, series]."""
    return [column(rr.Scalars.descriptor_scalars(), len(values), values)]


def strips(lines: NDArray[np.float32]) -> list[Any]:
    """Return the column of line strips, given as [n, strips, points, 2]."""
    n, count, points, _ = lines.shape
    flat = pa.FixedSizeListArray.from_arrays(pa.array(lines.reshape(-1)), type=_POINT)
    each = pa.ListArray.from_arrays(_offsets(n * count, points), flat, type=_STRIP)
    rows = pa.ListArray.from_arrays(_offsets(n, count), each)
    return [_Column(rr.LineStrips2D.descriptor_strips(), rows)]


def images(values: NDArray[np.float32]) -> list[Any]:
    """Return the columns of images, [n, pixels], each with its own range of colours."""
    n, pixels = values.shape
    flat = pa.array(np.ascontiguousarray(values).view(np.uint8).reshape(-1))
    blobs = pa.ListArray.from_arrays(_offsets(n, pixels * 4), flat, type=_BLOB)
    rows = pa.ListArray.from_arrays(_offsets(n, 1), blobs)
    with np.errstate(all="ignore"):
        low, high = np.nanmin(values, axis=1), np.nanmax(values, axis=1)
    ranges = np.stack((low, np.where(high > low, high, low + 1)), axis=1).astype(np.float64)
    shown = rr.DepthImage.columns(depth_range=np.nan_to_num(ranges))
    return [_Column(rr.DepthImage.descriptor_buffer(), rows), *shown]


def _aligned(values: NDArray[Any]) -> NDArray[Any]:
    """Return values as Arrow wants them in memory; a lone record's field is contiguous but not aligned."""
    return np.require(values, requirements=["C", "A"])


def _items(flat: NDArray[Any]) -> pa.Array:
    """Return all instances one after another: text or numbers [n], or points [n, 2]."""
    return (
        pa.FixedSizeListArray.from_arrays(flat.reshape(-1), type=_POINT) if flat.ndim == 2 else pa.array(flat)
    )


def _offsets(count: int, size: int) -> pa.Array:
    return pa.array(np.arange(count + 1, dtype=np.int32) * size)


def centres(height: int, width: int) -> NDArray[np.float32]:
    """Return the centre of each pixel, row by row, [pixels, 2]."""
    pixel = np.arange(height * width)
    return np.stack((pixel % width + 0.5, pixel // width + 0.5), axis=1).astype(np.float32)


def place(n: int, x: float, y: float) -> NDArray[np.float32]:
    """Return the same point for n rows, [n, 1, 2]."""
    return np.broadcast_to(np.array([[x, y]], np.float32), (n, 1, 2))


def texts(words: Sequence[str]) -> NDArray[Any]:
    """Return a label a row, [n, 1]."""
    return np.array(words, dtype=object)[:, None]


def ink(n: int) -> NDArray[np.uint32]:
    """Return the colour of writing for n rows, [n, 1]."""
    red, green, blue, alpha = rgba(palette.MIDTONE)
    return np.full((n, 1), red << 24 | green << 16 | blue << 8 | alpha, np.uint32)


def rgba(colour: str, alpha: int = 255) -> tuple[int, int, int, int]:
    """Return the parts of a colour "#rrggbb"."""
    return *palette.rgb(colour), alpha
