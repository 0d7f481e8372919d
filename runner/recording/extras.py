"""Extras: the values that a loop records with its steps, such as an agent's value estimates or logits.

    extras = recording.train.extras               # a mapping: name -> dtype, with its shape
    extras.of_episode(3)["logits"]                # [T, 2], masked at steps without the value
    for block in extras.blocks():                 # NumPy records, some thousands at a time
        print(block["step"], block["values"]["value"])

A layout says which names there are. When a name occurs for the first time, a new layout begins, which has
the columns of the one before it and then the new ones.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.layout import sized
from runner.recording.metadata import json_object
from runner.recording.schema import MessageType
from runner.recording.spaces import Description, dtype_of
from runner.recording.topic_chunks import TopicChunks
from runner.util.arrays import Array, MaskedArray
from runner.util.values import is_text

MAX_NAMES: Final = 256
"""The most names of extras in a recording; those of each agent count."""
MAX_NAME_LENGTH: Final = 200
MAX_EXTRA_BYTES: Final = 1 << 20
"""The most bytes of a step's extras."""
MAX_READ_BYTES: Final = 128 << 20
"""The most that `of_episode` and `at` return."""


@dataclass(frozen=True)
class ExtraLayout:
    """The names of extras from a time on."""

    start_time: int
    """Nanoseconds: that of the first step that has them."""
    values: np.dtype[Any]
    """A field for each name."""

    @property
    def names(self) -> tuple[str, ...]:
        """The names, in order."""
        return self.values.names or ()

    @cached_property
    def message(self) -> MessageType:
        """The type of a message: `values` by name, `given` by name, and `step`."""
        given = np.dtype([(name, "?") for name in self.names])
        return sized(schema.EXTRA, {"values": self.values, "given": given})

    @property
    def description(self) -> Description:
        """The names as a `Dict` space, as `spaces` describes one."""
        parts = {}
        for name in self.names:
            own = self.values[name]
            kind = {"type": "Box", "dtype": own.base.str, "shape": list(own.shape)}
            parts[name] = kind | {"low": None, "high": None}
        return {"type": "Dict", "spaces": parts}

    @property
    def json(self) -> str:
        """The text of an `ExtraColumns`."""
        return json.dumps(self.description)


def read_layouts(columns: Iterable[tuple[int, str]], where: str) -> list[ExtraLayout]:
    """Return the layouts of a recording.

    Args:
        columns: log time and text of each `ExtraColumns`, in order.

    Raises:
        RecordingError: they are not what a recorder writes.
    """
    layouts: list[ExtraLayout] = []
    for time, text in columns:
        what = f"{where}: the names of extras at {time} ns"
        layout = ExtraLayout(time, _values_dtype(json_object(text, what), what))
        if layouts:
            last = layouts[-1]
            earlier = list(last.values.fields or ())
            grows = list(layout.names[: len(earlier)]) == earlier and len(layout.names) > len(earlier)
            same = grows and all(layout.values[name] == last.values[name] for name in earlier)
            if not same or time <= last.start_time:
                raise RecordingError(f"{what} do not continue those before them.")
        layouts.append(layout)
    return layouts


def _values_dtype(description: dict[str, object], what: str) -> np.dtype[Any]:
    parts = description.get("spaces")
    if description.get("type") != "Dict" or not isinstance(parts, dict) or not 0 < len(parts) <= MAX_NAMES:
        raise RecordingError(f"{what}: found no mapping of 1 to {MAX_NAMES} names.")
    for name, part in parts.items():
        if not is_text(name) or not 0 < len(name) <= MAX_NAME_LENGTH:
            raise RecordingError(
                f"{what}: found the name {name[:40]!r}, expected at most {MAX_NAME_LENGTH} letters."
            )
        if not isinstance(part, dict) or part.get("type") != "Box":
            raise RecordingError(f"{what}: {name!r} is no array of numbers.")
    values = dtype_of(description, what)
    if values is None or not 0 < values.itemsize <= MAX_EXTRA_BYTES:
        raise RecordingError(f"{what}: found values of more than {MAX_EXTRA_BYTES:,} bytes, or of none.")
    return values


class Extras(Mapping[str, np.dtype[np.generic]]):
    """The extras of a phase: a mapping of the names to their dtypes, which include the shapes.

    Args:
        parts: each layout, and the chunks of the phase that have it.
        steps_of: returns the numbers of an episode's steps.
    """

    def __init__(
        self,
        parts: Sequence[tuple[ExtraLayout, TopicChunks]],
        steps_of: Callable[[int], NDArray[np.int64]],
        where: str,
    ) -> None:
        self._parts = parts
        self._steps_of = steps_of
        self._where = where
        self._dtypes = {name: part.values[name] for part, _ in parts for name in part.names}

    def __getitem__(self, name: str) -> np.dtype[np.generic]:
        return self._dtypes[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._dtypes)

    def __len__(self) -> int:
        return len(self._dtypes)

    @property
    def count(self) -> int:
        """The number of steps with extras."""
        return sum(chunks.count() for _, chunks in self._parts)

    def blocks(self, start: int = 0, stop: int | None = None) -> Iterator[NDArray[np.void]]:
        """Yield the extras of the steps number `start` up to `stop` in blocks of one layout each.

        Each block is a read-only structured array with `step`, `values` and `given` (whether the value was
        recorded with the step; both by name), and `log_time` in nanoseconds. Steps without extras are
        left out.

        Raises:
            RecordingError: they cannot be read.
        """
        for _, chunks in self._parts:
            first = chunks.first_from("step", start) if start else 0
            end = None if stop is None else chunks.first_from("step", stop)
            yield from (block for block in chunks.blocks(first, end) if len(block))

    def of_episode(self, episode: int) -> dict[str, MaskedArray]:
        """Return the extras along an episode by name, [T, *shape] each, masked where a step has none.

        They stand in the order of `Phase.episode_steps`.

        Raises:
            RecordingError: there is no such episode, or it is too long for an array.
        """
        return self.at(self._steps_of(episode))

    def at(self, steps: NDArray[np.int64]) -> dict[str, MaskedArray]:
        """Return the extras of steps, given by their numbers, ascending; as `of_episode`.

        Raises:
            RecordingError: they cannot be read, or take more than 134 MB.
        """
        n, width = len(steps), sum(own.itemsize for own in self._dtypes.values())
        if n * width > MAX_READ_BYTES:
            raise RecordingError(
                f"{self._where}: the extras of {n:,} steps take {n * width:,} bytes, expected at most "
                f"{MAX_READ_BYTES:,}; read them in blocks."
            )
        values = {name: np.zeros((n, *own.shape), own.base) for name, own in self._dtypes.items()}
        given = {name: np.zeros(n, np.bool_) for name in self._dtypes}
        for block in self.blocks(int(steps[0]), int(steps[-1]) + 1) if n else ():
            rows = np.minimum(np.searchsorted(steps, block["step"]), n - 1)
            wanted = steps[rows] == block["step"]
            rows, chosen = rows[wanted], block[wanted]
            for name in chosen["values"].dtype.names:
                values[name][rows], given[name][rows] = chosen["values"][name], chosen["given"][name]
        return {
            name: np.ma.MaskedArray(each, np.broadcast_to(_column(~given[name], each.ndim), each.shape))
            for name, each in values.items()
        }


def _column(flags: NDArray[np.bool_], dimensions: int) -> NDArray[np.bool_]:
    """Return [n] flags as [n, 1, ...]."""
    return flags.reshape(-1, *[1] * (dimensions - 1))


def filled(values: MaskedArray) -> Array:
    """Return extras as a plain array: NaN where there is none, for which whole numbers become floats."""
    if not np.ma.is_masked(values):
        return np.asarray(values.data)
    kind = values.dtype if values.dtype.kind == "f" else np.dtype(np.float64)
    return np.where(np.ma.getmaskarray(values), np.nan, values.data.astype(kind))
