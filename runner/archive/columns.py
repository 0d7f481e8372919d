"""The tables of a run and their columns, which follow from the fields of its messages.

A column is read from message records and written back. The values of a space have one column for each number
if there are few, else one with the bytes of the array:

    Box(4,) float32              action_0, action_1, action_2, action_3
    Dict(at=Box(2,), image=Box(84, 84, 3))
                                 observation_at_0, observation_at_1, observation_image (bytes, row by row)
    Text                         one column of text

Names are the path to the number: keys of `Dict`s, positions in `Tuple`s and arrays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Pb
from numpy.typing import NDArray

from runner.archive import layout
from runner.archive.layout import TEXT
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.description import RunDescription
from runner.recording.extras import ExtraLayout
from runner.recording.fields import Field
from runner.recording.layout import DTYPE_OF, record_dtype
from runner.recording.schema import MessageType, Topic
from runner.recording.spaces import Leaf, Value, decode, encode_bytes, encode_text, leaves_of, row_dtype
from runner.util.arrays import Array, RecordDType, Records

MAX_NUMBERS: Final = 64
"""An array with more numbers is one column of bytes."""
MAX_COLUMNS: Final = 1024
"""In a space with more columns than this, every array is one column of bytes."""


@dataclass(frozen=True)
class ArchiveColumn:
    """A column of messages: how it is read from message records, and written back."""

    name: str
    type: pa.DataType
    read: Callable[[Records], pa.Array]
    write: Callable[[Records, pa.Array], None] | None = None
    """Sets the records' field; None if other columns determine it."""


def stored(name: str, kind: pa.DataType, values_in: Callable[[Records], Array]) -> ArchiveColumn:
    """Return the column of values that stand in records; `values_in` returns a view of them, [n, ...].

    Unsigned 32-bit numbers become signed, which readers can subtract.
    """
    is_bytes = pa.types.is_fixed_size_binary(kind)

    def read(records: Records) -> pa.Array:
        values = values_in(records)
        if values.dtype.hasobject:
            return pa.array(values.tolist(), kind)
        if is_bytes:
            raw = np.ascontiguousarray(values).view(np.uint8)
            return pa.FixedSizeBinaryArray.from_buffers(kind, len(records), [None, pa.py_buffer(raw.data)])
        return pa.array(np.ascontiguousarray(values).astype(kind.to_pandas_dtype(), copy=False), kind)

    def write(records: Records, column: pa.Array) -> None:
        values = values_in(records)
        if is_bytes:
            start = column.offset * kind.byte_width
            size = len(records) * kind.byte_width
            raw = np.frombuffer(column.buffers()[1], np.uint8)[start : start + size]
            values[...] = raw.view(values.dtype).reshape(values.shape)
        else:
            values[...] = numbers(column)

    return ArchiveColumn(name, kind, read, write)


def nullable(column: ArchiveColumn, given_in: Callable[[Records], Array | None]) -> ArchiveColumn:
    """Return the column with null where a value was not given.

    Args:
        given_in: returns a view of the flags in records, [n]; None if the records do not have the field.
    """
    write_values = column.write
    assert write_values is not None
    is_bytes = pa.types.is_fixed_size_binary(column.type)
    zero = pa.scalar(bytes(column.type.byte_width) if is_bytes else 0).cast(column.type)

    def read(records: Records) -> pa.Array:
        given = given_in(records)
        if given is None:
            return pa.nulls(len(records), column.type)
        values = column.read(records)
        null = pa.scalar(None, column.type)
        return values if given.all() else pc.if_else(pa.array(np.ascontiguousarray(given)), values, null)

    def write(records: Records, values: pa.Array) -> None:
        given = given_in(records)
        if given is not None:
            given[...] = numbers(values.is_valid())
            write_values(records, values.fill_null(zero))

    return ArchiveColumn(column.name, column.type, read, write)


class SpaceColumns:
    """The columns of the values of a space.

    Args:
        prefix: the beginning of the columns' names; the field unless given.
        given: the field that says of each name whether it has a value; else all have.
    """

    def __init__(
        self, description: Mapping[str, object], field: str, where: str, prefix: str = "", given: str = ""
    ) -> None:
        self._description = description
        self._where = where
        self._leaves = leaves_of(description, where)
        self.dtype: np.dtype[np.generic] = row_dtype(description)
        """The dtype of a value in records; a text is an object."""
        prefix = prefix or field
        parts = _parts(self._leaves)
        names = [
            "_".join([prefix, *(key.replace(".", "_") for key in leaf.path), *map(str, at or ())])
            for leaf, at in parts
        ]
        if len(set(names)) < len(names):
            names = [f"{prefix}_{number}" for number in range(1, len(names) + 1)]
        self.columns = [
            _column(name, field, given, leaf, at) for name, (leaf, at) in zip(names, parts, strict=True)
        ]
        """The columns, in order."""

    def unpack(self, value: bytes) -> Value:
        """Return an encoded value as it is assigned to a record.

        Raises:
            RecordingError: it is not a value of the space.
        """
        return _as_record(decode(self._description, value, self._where))

    def pack(self, values: Array) -> list[bytes]:
        """Return the encoded values of records."""
        parts: list[list[bytes]] = [[b""] * len(values)]
        for leaf in self._leaves:
            leaf_values = _inside(values, leaf)
            if leaf.item is not None:
                parts.append([encode_bytes(v.tobytes()) for v in leaf_values])
            else:
                parts.append([encode_text(v) if leaf.dtype is None else v.tobytes() for v in leaf_values])
        return [b"".join(pieces) for pieces in zip(*parts, strict=True)]


def _parts(leaves: Sequence[Leaf]) -> list[tuple[Leaf, tuple[int, ...] | None]]:
    """Return the leaf of each column, and its number's place in the leaf; None for all of the leaf."""
    few = sum(map(_spreadable, leaves)) <= MAX_COLUMNS
    parts: list[tuple[Leaf, tuple[int, ...] | None]] = []
    for leaf in leaves:
        if leaf.dtype is not None and (not leaf.dtype.shape or (few and _spreadable(leaf))):
            parts += [(leaf, at) for at in np.ndindex(leaf.dtype.shape)]
        elif leaf.dtype is None or leaf.dtype.itemsize:
            parts.append((leaf, None))
    return parts


def _spreadable(leaf: Leaf) -> int:
    """Return the count of numbers in a leaf, if they are few enough for a column each; else 0."""
    count = math.prod(leaf.dtype.shape) if leaf.dtype is not None else 0
    return count if count <= MAX_NUMBERS else 0


def _column(name: str, field: str, given: str, leaf: Leaf, at: tuple[int, ...] | None) -> ArchiveColumn:
    """Return the column of one number of a leaf, or of all of it."""
    if leaf.dtype is None and given:
        return _varying(name, field, given, leaf)
    if leaf.dtype is None:
        kind = pa.string()
    elif at is None:
        kind = pa.binary(leaf.dtype.itemsize)
    else:
        kind = _number(leaf.dtype.base)
    place: Any = (..., *(at or ()))

    def given_in(records: Records) -> Array | None:
        flags = records[given]
        return flags[leaf.path[0]] if leaf.path[0] in (flags.dtype.names or ()) else None

    column = stored(name, kind, lambda records: _inside(records[field], leaf)[place])
    return nullable(column, given_in) if given else column


def _number(dtype: np.dtype[np.generic]) -> pa.DataType:
    """Return the type of a column of numbers; programs that read tables take float32 for float16."""
    return pa.float32() if dtype == np.float16 else pa.from_numpy_dtype(dtype.newbyteorder("="))


def _varying(name: str, field: str, given: str, leaf: Leaf) -> ArchiveColumn:
    """Return the column of an extra of varying size: of texts, or of lists, which hold arrays row by row."""
    (key,), item = leaf.path, leaf.item
    kind = pa.string() if item is None else pa.list_(_number(item.base))

    def values_in(records: Records) -> Array | None:
        """Return a view of the values; None if the records do not have them."""
        if key not in (records.dtype[given].names or ()):
            return None
        fields = records.dtype.names or ()
        is_object = "varying" in fields and key in (records.dtype["varying"].names or ())
        return records["varying" if is_object else field][key]  # some records have arrays of one shape

    def read(records: Records) -> pa.Array:
        values = values_in(records)
        if values is None:
            return pa.nulls(len(records), kind)
        flags = records[given][key].tolist()
        if item is None:
            plain = values.tolist()
        else:
            plain = [value.ravel().astype(kind.value_type.to_pandas_dtype()) for value in values]
        return pa.array(
            [value if is_given else None for value, is_given in zip(plain, flags, strict=True)], kind
        )

    def write(records: Records, column: pa.Array) -> None:
        values = values_in(records)
        if values is None:
            return
        records[given][key] = numbers(column.is_valid())
        for k, value in enumerate(numbers(column).tolist()):
            if item is None:
                values[k] = value or ""
            elif values.dtype.hasobject or value is not None:
                flat = np.array([] if value is None else value, item.base)
                values[k] = flat.reshape(-1, *item.shape)

    return ArchiveColumn(name, kind, read, write)


def _inside(values: NDArray[Any], leaf: Leaf) -> NDArray[Any]:
    """Return the values of a leaf, a view."""
    for key in leaf.path:
        values = values[key]
    return values


def _as_record(value: Value) -> Value:
    """Return a value with tuples in place of dictionaries, as it is assigned to a record."""
    parts = value.values() if isinstance(value, Mapping) else value
    return tuple(map(_as_record, parts)) if isinstance(value, Mapping | tuple) else value


def numbers(column: pa.Array) -> Array:
    """Return a column as an array: a view where possible."""
    values: Array = column.to_numpy(zero_copy_only=False)
    return values


_INT32, _FLOAT, _FLAG = pa.int32(), pa.float64(), pa.bool_()
_TYPES: Final[Mapping[int, pa.DataType]] = {
    Pb.TYPE_DOUBLE: _FLOAT,
    Pb.TYPE_SFIXED64: pa.int64(),
    Pb.TYPE_FIXED64: pa.uint64(),
    Pb.TYPE_FIXED32: _INT32,
    Pb.TYPE_BOOL: _FLAG,
    Pb.TYPE_STRING: pa.string(),
    Pb.TYPE_ENUM: pa.string(),
    Pb.TYPE_BYTES: pa.binary(),
}


@dataclass(frozen=True)
class Table:
    """A table of messages."""

    name: str
    """Its file."""
    topics: tuple[Topic, ...]
    """The topics of its messages: one, or one of training and one of evaluation."""
    messages: tuple[ArchiveColumn, ...]
    """The columns of the messages, besides run, phase and position."""
    gives_tables: bool = False
    """Whether its rows are steps from which the Q-tables follow, so that no snapshot is stored."""

    @cached_property
    def columns(self) -> pa.Schema:
        """All columns."""
        types = {column.name: column.type for column in self.messages}
        phase = {"phase": TEXT} if len(self.topics) > 1 or "phase" in types else {}
        return pa.schema({"run_id": TEXT, **phase, "position": pa.int64(), **types})


class Shape:
    """The facts of a run that determine its tables and their columns.

    Args:
        extras: the names of its extras, from when on.

    Raises:
        RecordingError: they contradict each other.
    """

    def __init__(self, run: RunDescription, extras: Sequence[ExtraLayout] = ()) -> None:
        self.run_id = run.run_id
        self.learners = run.agents
        self.extras = extras
        self._topics = run.topics
        space = run.spaces["action"]
        first = 0 if run.has_states else space.get("start", 0)
        is_discrete = space.get("type") == "Discrete"
        self._actions = range(first, first + space["n"]) if is_discrete else range(0)
        self.mdp = run.mdp if run.tabular else None
        self._events = self.mdp.event_names if self.mdp else ()
        where = self._where = str(run.path)
        if len(self._events) != int(run.run["events"]):
            raise RecordingError(f"{where}: found {len(self._events)} events, expected {run.run['events']}.")
        self.spaces: dict[str, SpaceColumns] = {}
        """The spaces of a loop by the field of their values."""
        self._extras = [
            (schema.extra_topic(phase, names.number), names) for names in extras for phase in schema.PHASES
        ]
        self._varying = {
            topic: SpaceColumns(names.varying, "varying", where) for topic, names in self._extras
        }
        """The names of extras with values of varying size, by the topic of each layout."""
        if run.layout.spaces:
            for name in ("action", "next_observation", "observation"):
                self.spaces[name] = SpaceColumns(run.spaces[name.removeprefix("next_")], name, where)
        self.messages = {topic: run.layout.message(topic) for topic in run.topics}
        """The type of each topic's messages; extras have a topic for each layout."""
        self.messages |= {topic: names.message for topic, names in self._extras}
        self.dtypes = {
            topic: dtype if (dtype := record_dtype(message)) is not None else self._dtype(topic, message)
            for topic, message in self.messages.items()
        }
        """The dtype of each topic's records: as in the file, or as `_dtype` returns it."""

    def topics_of(self, table: Table) -> list[Topic]:
        """Return the topics whose records a table holds; for extras, a topic for each layout."""
        return [topic for topic, _ in self._extras] if table.name == layout.EXTRAS else [*table.topics]

    def space(self, topic: Topic, field: str) -> SpaceColumns | None:
        """Return the space of a field's values; None for another field."""
        return self._varying.get(topic) if field == "varying" else self.spaces.get(field)

    def _dtype(self, topic: Topic, message: MessageType) -> RecordDType:
        """Return the dtype of messages of varying size: time, bytes of the message record, and fields."""

        def held(field: Field) -> object:
            if (space := self.space(topic, field.name)) is not None:
                return space.dtype
            if field.parts is not None:
                return field.row_dtype
            if field.dtype is not None:
                return field.dtype
            return object if field.repeated else DTYPE_OF.get(field.kind, object)

        head = [("log_time", "<u8"), ("publish_time", "<u8"), ("record", object)]
        return np.dtype([*head, *((field.name, held(field)) for field in message.fields)])

    @cached_property
    def tables(self) -> dict[str, Table]:
        """The tables of messages by name, without Q-tables, in the order in which they are written."""
        tables = {}
        for name, topic_names in layout.TOPICS.items():
            topics = tuple(topic for topic in self._topics if topic.name in topic_names)
            if topics and name != layout.EXTRAS:
                gives_tables = name == layout.STEPS and schema.Q_TABLE_TOPIC in self._topics
                tables[name] = Table(name, topics, tuple(self._columns_of(topics[0])), gives_tables)
            elif topics and self.extras:
                space = {"type": "Dict", "spaces": self.extras[-1].columns}
                columns = SpaceColumns(space, "values", self._where, "extra", "given").columns
                step = stored("step", pa.int64(), lambda records: records["step"])
                tables[name] = Table(name, topics, (step, *columns))
        return tables

    def per_learner(self, name: str) -> list[str]:
        """Return the columns of each learner, such as `reward_taxi_1`; none if there is one learner."""
        return _names(f"{name}_", self.learners) if len(self.learners) > 1 else []

    @cached_property
    def own_actions(self) -> list[str]:
        """The columns of the agents' own actions, such as `action_taxi_1`; none if there is one agent."""
        return _names("action_", self.mdp.agents) if self.mdp and len(self.mdp.agents) > 1 else []

    @cached_property
    def action_values(self) -> dict[str, range]:
        """The values of each column of discrete actions."""
        counts = self.mdp.action_counts if self.mdp and self.own_actions else ()
        return {"action": self._actions} | dict(zip(self.own_actions, map(range, counts), strict=True))

    @cached_property
    def event_columns(self) -> list[str]:
        """The columns that count events, such as `n_taxi_1_drop_off`."""
        return _names("n_", self._events)

    @cached_property
    def event_masks(self) -> dict[str, int]:
        """The bits of events by name, such as `taxi_1_drop_off`; `drop_off` has the bits of all agents."""
        masks: dict[str, int] = {}
        for bit, (event, column) in enumerate(zip(self._events, self.event_columns, strict=True)):
            names = (column.removeprefix("n_"), event.rpartition(".")[2])
            for name in dict.fromkeys(names):  # a set has another order in each process
                masks[name] = masks.get(name, 0) | 1 << bit
        return masks

    def _columns_of(self, topic: Topic) -> list[ArchiveColumn]:
        fields = {field.name: field for field in self.messages[topic].fields}
        return [
            column
            for name in layout.FIELDS.get(topic.message, fields)
            if name in fields
            for column in self._columns_of_field(topic.message, fields[name])
        ]

    def _columns_of_field(self, message: MessageType, field: Field) -> list[ArchiveColumn]:
        name = field.name
        is_row = message in schema.NUMBERED_BY
        if is_row and name in ("rewards", "returns"):
            return self._summed(name.removesuffix("s"), name)
        if is_row and name == "events":
            return [stored(event, _INT32, _item(name, i)) for i, event in enumerate(self.event_columns)]
        if name == "explored":
            return self._explored()
        if field.is_value:
            return self.spaces[name].columns
        column = stored(name, _type_of(field), lambda records: records[name])
        if name == "seed":
            column = nullable(column, lambda records: records["seeded"])
        agent_actions = self.own_actions if message is schema.STEP and name == "action" else []
        return [column, *(self._action_of(i, action) for i, action in enumerate(agent_actions))]

    def _action_of(self, agent: int, name: str) -> ArchiveColumn:
        """Return the column of an agent's own action, which follows from the joint one."""
        assert self.mdp is not None
        actions = self.mdp.own_actions[:, agent].astype(np.int32)
        return ArchiveColumn(
            name, _INT32, lambda records: pa.array(actions[records["action"] % len(actions)])
        )

    def _summed(self, name: str, source: str) -> list[ArchiveColumn]:
        """Return the column of the learners' sum and, where there are several, one for each."""
        learners = self.per_learner(name)
        if not learners:
            return [stored(name, _FLOAT, _item(source, 0))]
        total = ArchiveColumn(name, _FLOAT, lambda records: pa.array(records[source].sum(axis=1)))
        return [total, *(stored(key, _FLOAT, _item(source, i)) for i, key in enumerate(learners))]

    def _explored(self) -> list[ArchiveColumn]:
        """Return the column for any learner's exploration and, where there are several, one for each."""
        learners = self.per_learner("explored")
        any_explored = ArchiveColumn("explored", _FLAG, lambda records: pa.array(records["explored"] != 0))
        bits = [_bit("explored", i, name) for i, name in enumerate(learners or ["explored"])]
        return [any_explored, *bits] if learners else bits


def _bit(field: str, i: int, name: str) -> ArchiveColumn:
    """Return the column of bit `i` of a field, which is 0 in blank records."""

    def write(records: Records, column: pa.Array) -> None:
        records[field] |= numbers(column).astype(np.uint32) << i

    return ArchiveColumn(name, _FLAG, lambda records: pa.array(records[field] >> i & 1 != 0), write)


def _type_of(field: Field) -> pa.DataType:
    """Return the type of a field's column."""
    if field.name == "phase":
        return TEXT
    is_wide = field.repeated or field.name == "stream"
    kind = pa.int64() if is_wide and field.kind == Pb.TYPE_FIXED32 else _TYPES[field.kind]
    return pa.list_(kind) if field.repeated else kind


def _item(field: str, i: int) -> Callable[[Records], Array]:
    """Return the function that returns an element of a field, which is an array, as a view."""
    return lambda records: records[field][..., i]


def _names(prefix: str, names: tuple[str, ...]) -> list[str]:
    """Return a column for each name, numbered if the names would not be unique."""
    made = [prefix + name.replace(".", "_") for name in names]
    if len(set(made)) < len(made):
        made = [f"{prefix}{number}" for number in range(1, len(made) + 1)]
    return made
