"""The messages of a run: their fields follow from its learners, its events and its environment's spaces.

A step over states has `state`, `action` and `next_state`; in other spaces `action` and `next_observation`
have the types of the spaces' values, with a field for each part of a `Dict` or `Tuple` (`fields`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Final

import numpy as np
from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Pb

from runner.recording import schema
from runner.recording.blocks import record_dtype, row_dtype
from runner.recording.fields import Field, space_field
from runner.recording.schema import MessageType, Topic
from runner.util.arrays import DType, RecordDType
from runner.util.values import Json, is_whole

_MAX_STATES: Final = 2**32
"""The most states and the most actions that steps over states number."""
NUMBERS: Final[Mapping[int, str]] = {
    Pb.TYPE_DOUBLE: "<f8",
    Pb.TYPE_SFIXED64: "<i8",
    Pb.TYPE_FIXED64: "<u8",
    Pb.TYPE_FIXED32: "<u4",
    Pb.TYPE_BOOL: "?",
}
"""The dtypes of numbers by their types."""


@dataclass(frozen=True)
class Layout:
    """What the messages of a run depend on."""

    kind: str
    """A key of `schema.KINDS`."""
    learners: int
    events: int
    spaces: str = ""
    """The descriptions of the `observation` and the `action` space as JSON; empty for a job."""
    has_turns: bool = False
    """Whether environments take turns, so that steps and episodes name theirs."""

    @property
    def topics(self) -> tuple[Topic, ...]:
        """The topics of its recordings."""
        return schema.KINDS[self.kind]

    @cached_property
    def has_states(self) -> bool:
        """Whether its steps are over states: both spaces are `Discrete`; else over values of its spaces."""
        spaces = json.loads(self.spaces or "null")
        return not spaces or all(
            spaces[name].get("type") == "Discrete" and is_whole(spaces[name].get("n"), 1, _MAX_STATES)
            for name in ("observation", "action")
        )

    @cached_property
    def varies(self) -> bool:
        """Whether values of its spaces vary in size."""
        return any(self.dtype(topic) is None for topic in self._messages)

    def message(self, topic: Topic) -> MessageType:
        """Return the type of a topic's messages."""
        return self._messages.get(topic, topic.message)

    def dtype(self, topic: Topic) -> RecordDType | None:
        """Return the dtype of a topic's message records in the file; None if they vary in size."""
        return record_dtype(self.message(topic))

    def rows(self, topic: Topic) -> RecordDType:
        """Return the dtype in which the messages of one of `schema.ROW_TOPICS` are put down and read."""
        return row_dtype(self.message(topic))

    @cached_property
    def _messages(self) -> dict[Topic, MessageType]:
        """The messages of the topics that are put down as rows."""
        types = {"step": schema.STEP, "episode": schema.EPISODE, "reset": schema.RESET}
        if self.spaces:
            spaces: Json = json.loads(self.spaces)
            observation = space_field(1, "observation", spaces["observation"])
            types["reset"] = _with_values(schema.RESET, observation)
            if not self.has_states:
                after = space_field(3, "next_observation", spaces["observation"])
                types["step"] = _with_values(schema.STEP, space_field(2, "action", spaces["action"]), after)
                more = schema.MORE_FIELDS.get(self.kind, ())
                types["step"] = replace(types["step"], fields=types["step"].fields + more)
        if self.has_turns:
            turns = schema.ENVIRONMENT_OF_STEP, *types["step"].fields, schema.TAKEN
            episodes = *types["episode"].fields, schema.ENVIRONMENT_OF_EPISODE
            types["step"] = replace(types["step"], fields=turns)
            types["episode"] = replace(types["episode"], fields=episodes)
        sizes = {"rewards": self.learners, "returns": self.learners, "events": self.events}
        types = {name: sized(message, sizes) for name, message in types.items()}
        if not all(field.has_one_size for message in types.values() for field in message.values):
            for name, message in types.items():
                if message.values:  # they come last, so that the rest has one size
                    fields = tuple(sorted(message.fields, key=lambda field: field.is_value))
                    types[name] = replace(message, fields=fields, varies=True)
        return {
            topic: types[topic.name.rpartition("/")[2]] for topic in self.topics if topic in schema.ROW_TOPICS
        }


@lru_cache(64)
def layout_of(kind: str, learners: int, events: int, spaces: str = "", has_turns: bool = False) -> Layout:
    """Return a layout, the same one each time: what follows from it is computed once."""
    return Layout(kind, learners, events, spaces, has_turns)


def _with_values(message: MessageType, *values: Field) -> MessageType:
    """Return a message with values of spaces in place of states."""
    left_out = schema.OF_STATES | {"observation"}
    others = tuple(field for field in message.fields if field.name not in left_out)
    return replace(message, fields=(*values, *others))


def sized(message: MessageType, sizes: Mapping[str, int | DType]) -> MessageType:
    """Return a message with the dtypes of its numbers.

    Args:
        sizes: of each repeated field the number of elements, of each field of bytes its dtype.
    """

    def with_dtype(field: Field) -> Field:
        size = sizes.get(field.name)
        if isinstance(size, np.dtype):
            return replace(field, dtype=size)
        if field.is_value or field.kind not in NUMBERS:
            return field
        number = NUMBERS[field.kind]
        return replace(field, dtype=np.dtype((number, (size,)) if field.repeated else number))

    return replace(message, fields=tuple(map(with_dtype, message.fields)))
