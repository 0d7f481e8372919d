"""Extras: the values that a loop records with its steps, such as an agent's value estimates or logits.

    extras = recording.train.extras               # a mapping: name -> dtype, with its shape
    extras.of_episode(3)["logits"]                # [T, 2], masked at steps without the value
    extras.of_episode(3)["tokens"]                # arrays of varying length, or texts, as objects
    for block in extras.blocks():                 # NumPy records, some thousands at a time
        print(block["step"], block["values"]["value"])

A layout says which names there are. A new one begins when a name occurs for the first time, or when the first
axis of a name's arrays has another length for the first time. It has the names of the one before it and then
the new ones, and channels and a schema of its own: its names are fields, as the parts of a `Dict` space are.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.fields import space_field
from runner.recording.index import Beginning, Index, beginning_of_extras
from runner.recording.layout import HEADER_BYTES
from runner.recording.messages import Message, decode
from runner.recording.metadata import json_object
from runner.recording.records import ReadChunk, check_constants
from runner.recording.schema import MessageType
from runner.recording.spaces import Description, encode_bytes, encode_text, leaf_dtype, leaves_of, row_dtype
from runner.recording.spaces import decode as decode_value
from runner.recording.steps import EpisodeSteps
from runner.recording.topic_chunks import FOREVER, TopicChunks
from runner.recording.writer import RecordingFile
from runner.util.arrays import Array, DType, Ints, MaskedArray, Records, zeros
from runner.util.values import is_whole

MAX_NAMES: Final = 256
"""The most names of extras in a recording; the names of each agent count."""
MAX_NAME_LENGTH: Final = 200
MAX_EXTRA_BYTES: Final = 1 << 20
"""The most bytes of a step's extras."""
MAX_READ_BYTES: Final = 128 << 20
"""The most that `of_episode` and `at` return."""
NOTHING: Final = encode_bytes(b"")
"""What stands for a value of varying size where none is given: an empty text or array."""
_FLAG: Final = {"type": "MultiBinary", "dtype": "|b1", "shape": []}


@dataclass(frozen=True)
class ExtraLayout:
    """The names of extras from a time on."""

    number: int
    """Counted from 0; its channels and schema follow from it."""
    start_time: int
    """Log time in nanoseconds of the first step with these names."""
    columns: Mapping[str, Description]
    """The description of each name's values, as `spaces` has them: a `Box`, an `Array`, or a `Text`."""

    @cached_property
    def values(self) -> DType:
        """A field for each name; values of varying size are objects."""
        return row_dtype({"type": "Dict", "spaces": self.columns})

    @cached_property
    def varying(self) -> Description:
        """The names with values of varying size, as a `Dict` space."""
        varying = {name: column for name, column in self.columns.items() if leaf_dtype(column) is None}
        return {"type": "Dict", "spaces": varying}

    @cached_property
    def message(self) -> MessageType:
        """The type of a message: `values` and `given` by name, `step`, and `varying` by name.

        A name has the same number in each of them and in later layouts, so that a reader which knows one
        schema of a topic reads the messages of all.
        """
        whole = space_field(1, "values", {"type": "Dict", "spaces": self.columns})
        flags = space_field(2, "given", {"type": "Dict", "spaces": dict.fromkeys(self.columns, _FLAG)})
        fixed = tuple(part for part in whole.parts or () if part.has_one_size)
        varying = tuple(part for part in whole.parts or () if not part.has_one_size)
        fields = [replace(whole, parts=fixed, is_value=False)] if fixed else []
        fields += [replace(flags, is_value=False), *schema.EXTRA.fields]
        if varying:
            fields.append(replace(whole, number=4, name="varying", parts=varying))
        name = f"Extra_{self.number + 1}" if self.number else "Extra"
        return replace(schema.EXTRA, name=name, fields=tuple(fields), varies=False)

    @property
    def beginning(self) -> Beginning:
        """Its schema and channels."""
        return beginning_of_extras(self.number, self.message)

    def is_declared_in(self, index: Index) -> bool:
        """Return whether a file has its schema and channels."""
        return all(index.schemas.get(schema.id) == schema for schema in self.beginning.schemas) and all(
            index.channels.get(channel.id) == channel for channel in self.beginning.channels
        )

    @property
    def fields(self) -> Message:
        """The fields of its `ExtraColumns`."""
        return {"json": json.dumps({"type": "Dict", "spaces": self.columns}), "layout": self.number}


def encoded(description: Description, value: Any) -> bytes:
    """Return a value of varying size as it stands in a recording: a text, or an array."""
    if isinstance(value, str):
        return encode_text(value)
    return encode_bytes(np.ascontiguousarray(value, description["dtype"]).tobytes())


def box_of(dtype: DType, shape: tuple[int, ...]) -> Description:
    """Return the description of arrays of one shape."""
    return {"type": "Box", "dtype": dtype.str, "shape": list(shape), "low": None, "high": None}


def lengthened(column: Description) -> Description:
    """Return the description of arrays with a first axis of varying length, in place of one shape."""
    return {"type": "Array", "dtype": column["dtype"], "shape": [None, *column["shape"][1:]]}


def united(first: Description, second: Description) -> Description | None:
    """Return the description of values of both: with the wider dtype, and of varying length if it differs.

    None if only one is a text, or if arrays differ in more than the length of their first axis.
    """
    if "Text" in (first["type"], second["type"]):
        return first if first == second else None
    column = {**first, "dtype": np.promote_types(first["dtype"], second["dtype"]).str}
    if first["shape"] == second["shape"]:
        return column
    is_alike = len(first["shape"]) == len(second["shape"]) and first["shape"][1:] == second["shape"][1:]
    return lengthened(column) if is_alike else None


def _columns_of(description: dict[str, object], what: str) -> dict[str, Description]:
    parts = description.get("spaces")
    if description.get("type") != "Dict" or not isinstance(parts, dict) or not 0 < len(parts) <= MAX_NAMES:
        raise RecordingError(f"{what}: found no mapping of 1 to {MAX_NAMES} names.")
    leaves = leaves_of(description, what)
    for name, part in parts.items():
        if part["type"] not in ("Box", "Array", "Text"):
            raise RecordingError(f"{what}: {name!r} is no array of numbers, and no text.")
    dtypes = [dtype for leaf in leaves for dtype in (leaf.dtype, leaf.item) if dtype is not None]
    if any(leaf.dtype is not None and not leaf.dtype.itemsize for leaf in leaves):
        raise RecordingError(f"{what}: found an array without numbers.")
    if sum(dtype.itemsize for dtype in dtypes) > MAX_EXTRA_BYTES:
        raise RecordingError(f"{what}: found values of more than {MAX_EXTRA_BYTES:,} bytes.")
    return parts


class ExtraNames:
    """The layouts of extras, as a recording names them, one after the other.

    Args:
        columns: log time, in nanoseconds, and fields of each `ExtraColumns` read so far.
    """

    def __init__(self, where: str, columns: Iterable[tuple[int, Message]] = ()) -> None:
        self._where = where
        self.layouts: dict[int, ExtraLayout] = {}
        """Those named so far, by number."""
        for time, fields in columns:
            self._add(time, fields)

    def take(self, chunk: ReadChunk) -> None:
        """Take the names in a chunk of `ExtraColumns`.

        Raises:
            RecordingError: they are not what a recorder writes.
        """
        for time, record in zip(chunk.times.tolist(), chunk.messages, strict=True):
            self._add(time, decode(schema.EXTRA_COLUMNS, record[HEADER_BYTES:]))

    def _add(self, time: int, fields: Message) -> None:
        """Add the layout that follows the last one; after a repair, numbers may be missing."""
        what = f"{self._where}: the names of extras at {time} ns"
        layout = ExtraLayout(fields["layout"], time, _columns_of(json_object(fields["json"], what), what))
        if not is_whole(layout.number, 0, schema.MAX_LAYOUTS - 1):
            raise RecordingError(
                f"{what}: found layout {layout.number}, expected {schema.MAX_LAYOUTS - 1} at most."
            )
        if self.layouts:
            last = next(reversed(self.layouts.values()))
            same = list(layout.columns)[: len(last.columns)] == list(last.columns) and all(
                column == united(before, column) and column.get("dtype") == before.get("dtype")
                for before, column in zip(last.columns.values(), layout.columns.values(), strict=False)
            )
            if not same or layout.number <= last.number or time <= last.start_time:
                raise RecordingError(f"{what} do not continue those before them.")
        self.layouts[layout.number] = layout

    def of(self, chunk: ReadChunk) -> ExtraLayout | None:
        """Return the layout of a chunk of extras; None if its names are lost."""
        return self.layouts.get(chunk.entry.channel // schema.LAYOUT_STRIDE)

    def check(self, chunk: ReadChunk, index: Index) -> None:
        """Check that a chunk of extras has the channel and the messages that follow from its names.

        Raises:
            RecordingError: they are others.
        """
        layout = self.of(chunk)
        if layout is None or not layout.is_declared_in(index):
            raise RecordingError(f"chunk at {chunk.offset}: found extras with other names than were recorded")
        check_constants(chunk, layout.message)

    def declare(self, file: RecordingFile) -> None:
        """State the channels of these layouts in a file that extras are written into."""
        for layout in self.layouts.values():
            file.declare(layout.beginning)


class Extras(Mapping[str, DType]):
    """The extras of a phase: a mapping of the names to their dtypes, which include the shapes.

    Names with values of varying size have the dtype `object`; `columns` describes them.

    Args:
        parts: each layout, and the chunks of the phase that have it.
        episode: returns the steps of an episode.
    """

    def __init__(
        self,
        parts: Sequence[tuple[ExtraLayout, TopicChunks]],
        episode: Callable[[int], EpisodeSteps],
        where: str,
    ) -> None:
        self.parts = parts
        self._episode = episode
        self._where = where
        self._values = parts[-1][0].values if parts else np.dtype([])
        self.columns: Mapping[str, Description] = parts[-1][0].columns if parts else {}
        """The description of each name's values: a `Box` of one shape, an `Array` whose `shape` begins with
        null where its first axis varies in length, or a `Text`."""

    def __getitem__(self, name: str) -> DType:
        if name not in self.columns:
            raise KeyError(name)
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)

    def __len__(self) -> int:
        return len(self.columns)

    @property
    def count(self) -> int:
        """The number of steps with extras."""
        return sum(chunks.count() for _, chunks in self.parts)

    def blocks(self, start: int = 0, stop: int | None = None) -> Iterator[Records]:
        """Yield the extras of the steps number `start` up to `stop` in blocks of one layout each.

        Each block is a read-only structured array with `step`, `values` and `given` (whether the value was
        recorded with the step; both by name), and `log_time` in nanoseconds. Arrays of varying length and
        texts are objects. Steps without extras are left out.

        Raises:
            RecordingError: they cannot be read.
        """
        for layout, chunks in self.parts:
            is_all = not start and stop is None
            limit = FOREVER if stop is None else stop
            for rows in chunks.rows() if is_all else chunks.rows_between("step", start, limit):
                yield self._with_objects(layout, rows) if layout.varying["spaces"] else rows

    def _with_objects(self, layout: ExtraLayout, rows: Records) -> Records:
        """Return rows of a layout with values of varying size, with these among the others."""
        copied = [(name, rows.dtype[name]) for name in ("log_time", "given", "step")]
        block = np.zeros(len(rows), [*copied, ("values", layout.values)])
        for name, _ in copied:
            block[name] = rows[name]
        values = block["values"]
        for name in layout.columns.keys() - layout.varying["spaces"].keys():
            values[name] = rows["values"][name]
        for k, data in enumerate(rows["varying"].tolist()):
            for name, value in decode_value(layout.varying, data, self._where).items():
                values[name][k] = value
        block.flags.writeable = False
        return block

    def of_episode(self, episode: int) -> dict[str, MaskedArray]:
        """Return the extras along an episode by name, [T, *shape] each, masked where a step has none.

        They stand in the order of `Phase.episode_steps`. Arrays of varying length and texts are objects, [T].

        Raises:
            RecordingError: there is no such episode, or it is too long for an array.
        """
        steps = self._episode(episode)
        self._check_size(len(steps) * self._values.itemsize, len(steps))  # before numbers take as much
        return self.at(steps.numbers())

    def at(self, steps: Ints) -> dict[str, MaskedArray]:
        """Return the extras of steps, given by their numbers, ascending; as `of_episode`.

        Raises:
            RecordingError: they cannot be read, or take more than 134 MB.
        """
        n = len(steps)
        size = n * self._values.itemsize
        self._check_size(size, n)
        values = {name: zeros((n,), dtype) for name, dtype in self.items()}
        given = {name: np.zeros(n, np.bool_) for name in self}
        if n:
            for block in self.blocks(int(steps[0]), int(steps[-1]) + 1):
                rows = np.minimum(np.searchsorted(steps, block["step"]), n - 1)
                wanted = steps[rows] == block["step"]
                rows, block_rows = rows[wanted], block[wanted]
                for name in block_rows["values"].dtype.names:
                    given[name][rows], part = block_rows["given"][name], block_rows["values"][name]
                    if not values[name].dtype.hasobject:
                        values[name][rows] = part
                        continue
                    is_given = block_rows["given"][name]
                    for row, value in zip(rows[is_given].tolist(), part[is_given], strict=True):
                        values[name][row] = value
                        size += len(value) if isinstance(value, str) else value.nbytes
                    self._check_size(size, n)
        return {
            name: np.ma.MaskedArray(
                column, np.broadcast_to(~given[name].reshape(-1, *[1] * (column.ndim - 1)), column.shape)
            )
            for name, column in values.items()
        }

    def _check_size(self, size: int, n: int) -> None:
        if size > MAX_READ_BYTES:
            raise RecordingError(
                f"{self._where}: the extras of {n:,} steps take {size:,} bytes, expected at most "
                f"{MAX_READ_BYTES:,}; read them in blocks."
            )


def filled(values: MaskedArray) -> Array:
    """Return extras as a plain array.

    Where there is none it has NaN, for which whole numbers become floats; None among objects.
    """
    if not np.ma.is_masked(values):
        return np.asarray(values.data)
    if values.dtype.hasobject:
        plain: NDArray[Any] = values.data.copy()
        plain[np.ma.getmaskarray(values)] = None
        return plain
    kind = values.dtype if values.dtype.kind == "f" else np.dtype(np.float64)
    return np.where(np.ma.getmaskarray(values), np.nan, values.data.astype(kind))
