"""Messages of variable size as rows: metrics, log lines, snapshots, and what only loops record."""

from __future__ import annotations

from typing import Final

from runner.archive import layout
from runner.archive.columns import Shape
from runner.recording import schema
from runner.recording.messages import Message, decode, encode, encode_image, encode_log, log_level
from runner.recording.schema import STEP_NANOSECONDS, Topic
from runner.util.values import JsonView

_WITH_SPACES: Final = (schema.TRANSITION, schema.RESET)
"""The messages with values of spaces, whose columns differ between runs."""


def message_row(topic: Topic, payload: bytes, shape: Shape) -> Message:
    """Return a message as the values of its columns, but run and position.

    Raises:
        ValueError: it has a value outside its space.
    """
    values = decode(topic.message, payload)
    if topic.message is schema.LOG:
        return {"name": values["name"], "level": log_level(values["level"]), "message": values["message"]}
    if topic.message is schema.IMAGE:
        return {"phase": topic.phase, **{name: values[name] for name in ("format", "data", layout.FRAME_ID)}}
    if topic.message in _WITH_SPACES:
        for field in values.keys() & shape.spaces.keys():
            values |= shape.spaces[field].row(values.pop(field))
        if topic.message is schema.TRANSITION:
            rewards = values.pop("rewards")
            values["t"] -= values["t"] >> 31 << 32  # -1 for a reset alone, as in tables of fixed width
            values |= {"reward": sum(rewards[1:], rewards[0])}
            values |= zip(shape.per_learner("reward"), rewards, strict=False)
        elif not values.pop("seeded"):
            values["seed"] = None
    stored = {field.name: field.stored_name for field in topic.message.fields}
    values = {stored.get(name, name): value for name, value in values.items()}
    return ({"phase": topic.phase} if topic.phase else {}) | values


def message_payload(topic: Topic, position: int, row: JsonView, shape: Shape) -> bytes:
    """Return the message of a row."""
    if topic.message is schema.LOG:
        return encode_log(row["message"], position * STEP_NANOSECONDS / 1e9, row["level"], row["name"])
    if topic.message is schema.IMAGE:
        return encode_image(row["data"], row["format"], position, row.get(layout.FRAME_ID, topic.phase))
    of_message = topic.message.fields
    fields = {field.name: row[field.stored_name] for field in of_message if field.stored_name in row}
    if topic.message in _WITH_SPACES:
        names = {field.name for field in of_message} & shape.spaces.keys()
        fields |= {name: shape.spaces[name].value(row) for name in names}
        if topic.message is schema.TRANSITION:
            fields["t"] %= 1 << 32
            fields["rewards"] = [row[name] for name in shape.per_learner("reward") or ["reward"]]
        elif row["seed"] is None:
            del fields["seed"]
        else:
            fields["seeded"] = True
    return encode(topic.message, fields)
