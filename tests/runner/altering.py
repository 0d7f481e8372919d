"""Recordings altered as someone would who knows the format: every checksum and index fits what they say."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from runner.recording.integrity import survey
from runner.recording.layout import HEADER, HEADER_BYTES, blank_records
from runner.recording.reader import open_recording
from runner.recording.records import encode_chunk
from runner.recording.repair import repair
from runner.recording.schema import Topic
from runner.recording.writer import RecordingFile
from runner.util.packing import Packing

Change = Callable[[Any], Any]


def altered(source: Path, target: Path, topic: Topic | None, change: Change, **metadata: Change) -> Path:
    """Write a copy of a recording in which messages of a topic or metadata differ; return its path.

    Args:
        source: a finished recording.
        target: the new file.
        topic: the topic whose messages are changed; None for none.
        change: maps all of its messages, one array or a list of (log time, payload), to the new ones.
        metadata: by the name of a metadata record, a function from its entries to the new ones.
    """
    with open_recording(source) as recording, RecordingFile(target, recording.layout) as file:
        contents = survey(source, keep_result=True)
        names = list(contents.metadata)
        entries = {name: recording.file.metadata(name) for name in names}
        entries |= {name: turn(entries[name]) for name, turn in metadata.items()}
        for name in names:
            if name != "result":
                file.add_metadata(name, entries[name])
        for name, media_type, data in recording.file.attachments():
            file.add_attachment(name, media_type, data)
        for one in recording.topics:
            turn = change if one is topic else lambda messages: messages
            _write(file, one, *_records(recording, one, turn))
        file.finish(entries["result"])
    return target


def without_chunk(path: Path, topic: Topic, number: int) -> int:
    """Damage a chunk of a topic, counted from 0, and repair the recording, so that it is lost.

    Returns:
        how many messages it held.
    """
    chunks = [part for part in survey(path).chunks if part.channel == topic.channel]
    data = bytearray(path.read_bytes())
    data[chunks[number].offset + 150] ^= 1
    path.write_bytes(data)
    repair(path)
    return chunks[number].messages


def _records(recording: Any, topic: Topic, change: Change) -> tuple[list[bytes], list[int]]:
    """Return the bytes and the log time of each message of a topic, changed."""
    if (dtype := recording.layout.dtype(topic)) is not None:
        if not (stored := bytearray(b"".join(recording.table(topic).records()))):
            return [], []
        records = np.frombuffer(stored, dtype)
        whole = change(records)
        if whole.base is not records and whole is not records:  # NumPy copies no bytes between nested fields
            copied, whole = whole, blank_records(topic, recording.layout.message(topic), len(whole))
            for name in dtype.names or ():
                whole[name] = copied[name]
        return [record.tobytes() for record in whole], whole["log_time"].tolist()
    messages = change(list(recording.table(topic).messages()))
    return [_record(topic, *message) for message in messages], [time for time, _ in messages]


def _record(topic: Topic, log_time: int, payload: bytes) -> bytes:
    header = np.zeros((), HEADER)
    header["opcode"], header["channel_id"] = 5, topic.channel
    header["record_length"] = HEADER_BYTES - 9 + len(payload)
    header["log_time"] = header["publish_time"] = log_time
    return header.tobytes() + payload


def _write(file: RecordingFile, topic: Topic, records: list[bytes], times: list[int]) -> None:
    for start in range(0, len(records), 300):
        part = records[start : start + 300]
        offsets = np.cumsum([0, *map(len, part[:-1])], dtype=np.uint64)
        log_times = np.array(times[start : start + 300], dtype=np.uint64)
        file.add_chunk(encode_chunk(topic, b"".join(part), log_times, offsets, Packing()))


def without_digest(entries):
    """Return a result with another digest; otherwise the two would be equal by it."""
    return {"json": json.dumps(json.loads(entries["json"]) | {"content_digest": "altered"})}
