"""The tables of a run and their columns, which follow from the fields of its messages."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
import pyarrow as pa
from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Pb

from runner.archive import layout
from runner.archive.layout import TEXT
from runner.archive.values import ArchiveColumn, SpaceColumns, nullable, numbers, stored
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.blocks import record_dtype
from runner.recording.description import RunDescription
from runner.recording.extras import ExtraLayout
from runner.recording.fields import Field
from runner.recording.layout import NUMBERS
from runner.recording.schema import MessageType, Topic
from runner.util.arrays import Array, RecordDType, Records

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
    """The topics of its messages: one, or those of training and of evaluation."""
    messages: tuple[ArchiveColumn, ...]
    """The columns of the messages, besides run, phase and position."""
    gives_tables: bool = False
    """Whether its rows are steps from which the Q-tables follow, so that no snapshot is stored."""

    @cached_property
    def columns(self) -> pa.Schema:
        """All columns."""
        own = {column.name: column.type for column in self.messages}
        phase = {"phase": TEXT} if len(self.topics) > 1 or "phase" in own else {}
        return pa.schema({"run_id": TEXT, **phase, "position": pa.int64(), **own})


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
        first = 0
        if not run.has_states:
            first = space.get("start", 0)
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
        """The dtype of each topic's records: message records, or those of `_dtype`."""

    def topics_of(self, table: Table) -> list[Topic]:
        """Return the topics whose records a table holds: of extras, those of each layout."""
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
            return object if field.repeated else NUMBERS.get(field.kind, object)

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
        own = self.own_actions if message is schema.STEP and name == "action" else []
        return [column, *(self._action_of(i, action) for i, action in enumerate(own))]

    def _action_of(self, agent: int, name: str) -> ArchiveColumn:
        """Return the column of an agent's own action, which follows from the joint one."""
        assert self.mdp is not None
        own = self.mdp.own_actions[:, agent].astype(np.int32)
        return ArchiveColumn(name, _INT32, lambda records: pa.array(own[records["action"] % len(own)]))

    def _summed(self, name: str, source: str) -> list[ArchiveColumn]:
        """Return the column of the learners' sum and, where there are several, one for each."""
        own = self.per_learner(name)
        if not own:
            return [stored(name, _FLOAT, _item(source, 0))]
        total = ArchiveColumn(name, _FLOAT, lambda records: pa.array(records[source].sum(axis=1)))
        return [total, *(stored(key, _FLOAT, _item(source, i)) for i, key in enumerate(own))]

    def _explored(self) -> list[ArchiveColumn]:
        """Return the column for any learner's exploration and, where there are several, one for each."""
        own = self.per_learner("explored")
        any_explored = ArchiveColumn("explored", _FLAG, lambda records: pa.array(records["explored"] != 0))
        bits = [_bit("explored", i, name) for i, name in enumerate(own or ["explored"])]
        return [any_explored, *bits] if own else bits


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
