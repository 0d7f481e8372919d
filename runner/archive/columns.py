"""The tables of a run and their columns, which follow from the fields of its messages."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final

import numpy as np
import pyarrow as pa
from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Pb

from runner.archive import layout
from runner.archive.layout import TEXT
from runner.archive.values import Column, SpaceColumns, nullable, numbers, stored
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.description import RunDescription
from runner.recording.extras import ExtraLayout
from runner.recording.metadata import dtypes_of
from runner.recording.schema import Field, MessageType, Topic
from runner.util.arrays import Array, Records

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
    messages: tuple[Column, ...]
    """The columns of the messages, besides run, phase and position."""

    @cached_property
    def columns(self) -> pa.Schema:
        """All columns."""
        own = {column.name: column.type for column in self.messages}
        phase = {"phase": TEXT} if len(self.topics) > 1 or "phase" in own else {}
        return pa.schema({"run_id": TEXT, **phase, "position": pa.int64(), **own})


@dataclass(frozen=True)
class Shape:
    """The facts of a run that determine its tables and their columns."""

    run_id: str
    kind: str
    """One of `schema.KINDS`."""
    learners: tuple[str, ...]
    agents: tuple[str, ...]
    action_counts: tuple[int, ...]
    events: tuple[str, ...]
    dtypes: Mapping[Topic, np.dtype[np.void]]
    """The dtype of each fixed-width topic's message records."""
    spaces: Mapping[str, SpaceColumns] = field(default_factory=dict)
    """The spaces of a loop by the field of their values; those of extras have all names."""
    extras: tuple[ExtraLayout, ...] = ()
    """The names of extras, from when on."""

    @cached_property
    def tables(self) -> dict[str, Table]:
        """The tables of messages by name, without Q-tables, in the order in which they are written."""
        tables = {}
        for name, topic_names in layout.TOPICS.items():
            topics = tuple(topic for topic in schema.KINDS[self.kind] if topic.name in topic_names)
            if topics and (name != layout.EXTRAS or self.extras):
                tables[name] = Table(name, topics, tuple(self._columns_of(topics[0].message)))
        return tables

    def per_learner(self, name: str) -> list[str]:
        """Return the columns of each learner, such as `reward_taxi_1`; none if there is one learner."""
        return _names(f"{name}_", self.learners) if len(self.learners) > 1 else []

    @cached_property
    def own_actions(self) -> list[str]:
        """The columns of the agents' own actions, such as `action_taxi_1`; none if there is one agent."""
        return _names("action_", self.agents) if len(self.agents) > 1 else []

    @cached_property
    def event_columns(self) -> list[str]:
        """The columns that count events, such as `n_taxi_1_drop_off`."""
        return _names("n_", self.events)

    def _columns_of(self, message: MessageType) -> list[Column]:
        fields = {field.name: field for field in message.fields}
        return [
            column
            for name in layout.FIELDS.get(message, fields)
            for column in self._columns_of_field(message, fields[name])
        ]

    def _columns_of_field(self, message: MessageType, field: Field) -> list[Column]:
        name, is_row = field.name, message in schema.NUMBERED_BY
        if is_row and name in ("rewards", "returns"):
            return self._summed(name.removesuffix("s"), name)
        if is_row and name == "events":
            return [stored(event, _INT32, _item(name, i)) for i, event in enumerate(self.event_columns)]
        if name == "explored":
            return self._explored()
        if message is schema.EXTRA and name == "values":
            return [_extra(leaf.path[0], column) for leaf, column in self.spaces[name].columns_by_leaf]
        if field.kind == Pb.TYPE_BYTES and name in self.spaces:
            return self.spaces[name].columns
        column = stored(field.stored_name, _type_of(field), lambda records: records[name])
        if name == "seed":
            column = nullable(column, lambda records: records["seeded"])
        own = self.own_actions if message is schema.STEP and name == "action" else []
        return [column, *(Column(action, _INT32, self._action_of(i)) for i, action in enumerate(own))]

    def _action_of(self, agent: int) -> Callable[[Records], pa.Array]:
        """Return the function that reads an agent's own action from the joint one."""
        counts, joint = self.action_counts, math.prod(self.action_counts)
        divisor, count = math.prod(counts[agent + 1 :]), counts[agent]
        return lambda records: pa.array((records["action"] % joint // divisor % count).astype(np.int32))

    def _summed(self, name: str, source: str) -> list[Column]:
        """Return the column of the learners' sum and, where there are several, one for each."""
        own = self.per_learner(name)
        if not own:
            return [stored(name, _FLOAT, _item(source, 0))]
        total = Column(name, _FLOAT, lambda records: pa.array(records[source].sum(axis=1)))
        return [total, *(stored(key, _FLOAT, _item(source, i)) for i, key in enumerate(own))]

    def _explored(self) -> list[Column]:
        """Return the column for any learner's exploration and, where there are several, one for each."""
        own = self.per_learner("explored")
        any_explored = Column("explored", _FLAG, lambda records: pa.array(records["explored"] != 0))
        bits = [_bit("explored", i, name) for i, name in enumerate(own or ["explored"])]
        return [any_explored, *bits] if own else bits


def _bit(field: str, i: int, name: str) -> Column:
    """Return the column of bit `i` of a field, which is 0 in blank records."""

    def write(records: Records, column: pa.Array) -> None:
        records[field] |= numbers(column).astype(np.uint32) << i

    return Column(name, _FLAG, lambda records: pa.array(records[field] >> i & 1 != 0), write)


def _extra(name: str, column: Column) -> Column:
    """Return the column of an extra, or of a part of it, which is null where it was not given."""

    def given_in(records: Records) -> Array | None:
        given = records["given"]
        return given[name] if name in (given.dtype.names or ()) else None

    return nullable(column, given_in)


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


def shape_of(run: RunDescription, extras: tuple[ExtraLayout, ...] = ()) -> Shape:
    """Return the shape of a run.

    Args:
        extras: the names of its extras, from when on.

    Raises:
        RecordingError: they contradict each other.
    """
    where, mdp = str(run.path), run.mdp if run.tabular else None
    events = mdp.event_names if mdp else ()
    if len(events) != int(run.run["events"]):
        raise RecordingError(f"{where}: found {len(events)} events, expected {run.run['events']}.")
    spaces, dtypes = {}, dtypes_of(run.run, where)
    if extras:
        spaces["values"] = SpaceColumns(extras[-1].description, "values", where, "extra")
        dtypes |= dict.fromkeys(schema.EXTRA_TOPICS, extras[-1].record)
    if not run.can_train_again:
        for name in ("action", "next_observation", "observation"):
            spaces[name] = SpaceColumns(run.spaces[name.removeprefix("next_")], name, where)
    return Shape(
        run_id=run.run_id,
        kind=run.kind,
        learners=run.agents,
        agents=mdp.agents if mdp else (),
        action_counts=mdp.action_counts if mdp else (),
        events=events,
        dtypes=dtypes,
        spaces=spaces,
        extras=extras,
    )
