"""The tables of docs/recording-format.md list the messages and channels that recordings have."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Pb

from runner.recording import schema
from runner.recording.extras import ExtraLayout, box_of
from runner.recording.layout import layout_of

TEXT = (Path(__file__).parents[3] / "docs" / "recording-format.md").read_text()
SPACES = '{"observation": {"type": "Box", "dtype": "<f4", "shape": [4], "low": null, "high": null}, '
SPACES += '"action": {"type": "Box", "dtype": "<f4", "shape": [], "low": null, "high": null}}'
TYPES = {
    Pb.TYPE_DOUBLE: "double",
    Pb.TYPE_SFIXED64: "sfixed64",
    Pb.TYPE_FIXED64: "fixed64",
    Pb.TYPE_FIXED32: "fixed32",
    Pb.TYPE_BOOL: "bool",
    Pb.TYPE_STRING: "string",
    Pb.TYPE_BYTES: "bytes",
    Pb.TYPE_MESSAGE: "message",
}
FOLLOWING = {"EvalMetrics": 10}
"""Messages whose first fields are stated in a sentence, and how many."""


def tables(heading: str) -> dict[str, list[list[str]]]:
    """Return the rows of the first table under each section that has one with these headings."""
    found = {}
    for section in re.split(r"^#{2,3} ", TEXT, flags=re.MULTILINE)[1:]:
        title, _, body = section.partition("\n")
        if heading in body:
            rows = body.partition(heading)[2].splitlines()[2:]
            lines = [row for row in rows[: rows.index("")] if row.startswith("|")]
            found[title] = [[cell.strip() for cell in line.strip("| ").split(" | ")] for line in lines]
    return found


MESSAGES = tables("| no. | field | type | meaning |")


def message_of(title: str) -> schema.MessageType:
    """Return the message that a section is about."""
    if title.endswith("over values"):
        return layout_of("game", 2, 0, SPACES, has_turns=True).message(schema.TRAIN_STEP)
    if title == "dualtaxi.Episode":
        return layout_of("game", 2, 0, SPACES, has_turns=True).message(schema.TRAIN_EPISODE)
    if title == "dualtaxi.Extra":
        columns = {"value": box_of(np.dtype("<f4"), ()), "said": {"type": "Text"}}
        return ExtraLayout(0, 0, columns).message
    name = title.removeprefix("dualtaxi.")
    return next(topic.message for topic in schema.ALL_TOPICS if topic.message.name == name)


@pytest.mark.parametrize("title", MESSAGES)
def test_a_message_has_the_fields_of_its_table(title):
    message, stated = message_of(title), []
    for cells in MESSAGES[title]:
        numbers, names = cells[0].split(", "), re.findall("`(.+?)`", cells[1])
        kinds = cells[2].split(", ")
        kinds = kinds if len(kinds) == len(names) else kinds[:1] * len(names)
        stated += zip(map(int, numbers), names, kinds, strict=True)
    fields = message.fields[FOLLOWING.get(message.name, 0) :]
    assert [(number, name) for number, name, _ in stated] == [(each.number, each.name) for each in fields]
    for field, (_, _, kind) in zip(fields, stated, strict=True):
        assert kind in ("as its space", f"{'repeated ' * field.repeated}{TYPES.get(field.kind)}"), field.name


def test_every_message_of_recordings_is_described():
    described = {title.removeprefix("dualtaxi.").partition(",")[0] for title in MESSAGES}
    other = set(re.findall(r"`?(?:dualtaxi|foxglove)\.(\w+)", TEXT))
    assert {topic.message.name for topic in schema.ALL_TOPICS} <= described | other


@pytest.mark.parametrize("section", tables("| channel | topic | schema | one message per |"))
def test_the_channels_are_those_of_the_table(section):
    stated = {}
    for cells in tables("| channel | topic | schema | one message per |")[section]:
        for channel, topic in zip(cells[0].split(", "), re.findall("`(.+?)`", cells[1]), strict=True):
            stated[topic] = (int(channel), re.findall("`(.+?)`", cells[2])[0])
    kind = "job" if section == "The file" else "loop"
    topics = layout_of(kind, 1, 0, SPACES if kind == "loop" else "").topics
    assert stated == {
        topic.name: (topic.channel, f"{topic.message.package}.{topic.message.name}") for topic in topics
    }


def test_a_step_over_states_has_the_size_of_the_table():
    for learners, size in ((1, 88), (2, 96)):
        dtype = np.dtype(layout_of("job", learners, 11).dtype(schema.TRAIN_STEP))
        assert dtype.itemsize == size
        assert f"**{size}**" in TEXT
