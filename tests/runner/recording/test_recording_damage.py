"""Damaged, cut off, foreign and hostile files: good records are read, anything else is a RecordingError."""

from __future__ import annotations

import json
import os
import struct
import tracemalloc
import zlib
from collections.abc import Iterator
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from runner.errors import RecordingError, RunnerError, StorageError
from runner.execution.verify import verify
from runner.recording import schema
from runner.recording.description import recorded_facts
from runner.recording.integrity import check_integrity, may_be_cut, survey
from runner.recording.messages import decode_array, decode_reset_options, encode
from runner.recording.reader import open_recording
from runner.recording.repair import repair
from runner.recording.rewriting import rewrite
from tests.runner.recording.making import LAKE, TAXIS, make_run

CHUNK, MESSAGE_INDEX, DATA_END = 6, 7, 15
VERSION = str(schema.FORMAT_VERSION)


def records_of(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, start, end) of the records of a whole file, the footer's included."""
    at = len(MCAP0_MAGIC)
    while at < len(data) - len(MCAP0_MAGIC):
        opcode, length = struct.unpack_from("<BQ", data, at)
        yield opcode, at, at + 9 + length
        at += 9 + length


def all_messages(recording) -> dict[str, list]:
    """Return every message of every topic, those of fixed width as blocks."""
    found = {}
    for topic in schema.KINDS["job"]:
        found[topic.name] = list(recording.table(topic).messages())
        if topic in schema.BLOCK_TOPICS:
            blocks = list(recording.table(topic).blocks())
            rows = np.concatenate(blocks) if blocks else np.empty(0, recording.table(topic).row_dtype)
            assert rows["log_time"].tolist() == [time for time, _ in found[topic.name]]
            assert recording.table(topic).count() == len(rows)
    return found


def everything(path: Path) -> dict[str, list]:
    """Read all there is in a recording, and return its messages."""
    with open_recording(path) as recording:
        recorded_facts(recording)
        assert recording.config
        assert recording.provenance
        assert recording.mdp.states
        recording.train.all_metrics()
        recording.eval.all_metrics()
        list(recording.snapshots())
        return all_messages(recording)


@pytest.fixture(scope="module")
def whole(lake):
    """Return the messages of the undamaged recording, by topic."""
    return everything(lake.recording)


@pytest.fixture(scope="module", params=["message", "chunk"])
def cuttable(request, tmp_path_factory):
    """Return the bytes of a recording with and without message indexes, and its messages."""
    run = make_run(tmp_path_factory.mktemp("cut"), LAKE, recording={"index": request.param})
    return run.recording.read_bytes(), everything(run.recording)


def test_a_file_cut_off_at_any_byte_gives_the_messages_before_the_cut(cuttable, tmp_path):
    data, messages = cuttable
    records = list(records_of(data))
    end_of_description = next(start for opcode, start, _ in records if opcode == CHUNK)
    near = {cut + k for _, start, end in records for cut in (start, end) for k in (-1, 0, 1, 9, 40)}
    cuts = sorted(cut for cut in near | set(range(0, len(data), 97)) if 0 <= cut < len(data))
    path = tmp_path / "cut.mcap"
    unusable = [cut for cut in cuts if cut < end_of_description]
    for cut in cuts:
        path.write_bytes(data[:cut])
        try:
            recording = open_recording(path)
        except RecordingError:
            unusable.remove(cut)  # raises ValueError, and fails, if what is described there should open
            continue
        with recording:
            assert not recording.file.finished
            found = all_messages(recording)
        for topic, expected in messages.items():
            assert found[topic] == expected[: len(found[topic])], f"{topic} of a file cut at {cut}"
        chunks = [end for opcode, _, end in records if opcode == CHUNK and end <= cut]
        many = sum(map(len, found.values()))
        if len(chunks) == sum(opcode == CHUNK for opcode, _, _ in records):
            assert many == sum(map(len, messages.values()))
        assert bool(many) == bool(chunks)
        assert many >= len(chunks)
    assert len(cuts) - len(unusable) > 500


def test_a_cut_file_has_the_status_interrupted(lake, tmp_path):
    path = tmp_path / "cut.mcap"
    data = lake.recording.read_bytes()
    last_chunk = max(start for opcode, start, _ in records_of(data) if opcode == CHUNK)
    path.write_bytes(data[: last_chunk + 5])
    with open_recording(path) as recording:
        facts = recorded_facts(recording)
        assert (facts["status"], facts["summary"]) == ("interrupted", {})
        assert (facts["run_id"], facts["config"]) == (lake.run_id, lake.facts["config"])
        assert recording.result == {}
        assert recording.mdp.states == 16


def test_episodes_are_found_by_their_steps_where_their_ends_are_lost(tmp_path):
    """The last chunk of episodes is lost, but none of the steps."""
    run = make_run(tmp_path, LAKE, evaluation=None, log=None)
    with open_recording(run.recording) as recording:
        lengths = recording.train.episodes.array()["length"].tolist()
    data = run.recording.read_bytes()
    channels = {start: _channel(data, start) for opcode, start, _ in records_of(data) if opcode == CHUNK}
    cut = next(start for start, channel in channels.items() if channel == schema.TRAIN_EPISODE.channel)
    path = tmp_path / "cut.mcap"
    path.write_bytes(data[:cut])
    with open_recording(path) as recording:
        assert recording.train.episodes.count() == 0
        steps = [recording.train.episode_steps(number) for number in range(len(lengths))]
        assert list(map(len, steps)) == lengths
        assert sum(lengths) == recording.train.steps.count() > 100
        with pytest.raises(RecordingError, match=f"no training episode {len(lengths)}; there are"):
            recording.train.episode_steps(len(lengths))
        with pytest.raises(RecordingError, match="no evaluation steps"):
            recording.eval.episode_steps(0)


def _channel(data: bytes, chunk: int) -> int:
    """Return the channel of the message index after a chunk."""
    end = chunk + 9 + struct.unpack_from("<Q", data, chunk + 1)[0]
    return struct.unpack_from("<H", data, end + 9)[0]


def places_to_change(data: bytes) -> list[int]:
    """Return places all over a file, and the beginning of one record of each kind byte by byte."""
    first = {opcode: start for opcode, start, _ in reversed(list(records_of(data)))}
    places = {place for start in first.values() for place in range(start, start + 45)}
    places |= {*range(0, len(data), 97), *range(len(data) - 40, len(data))}
    return sorted(place for place in places if place < len(data))


@pytest.mark.parametrize("end", [None, -300], ids=["finished", "unfinished"])
def test_a_changed_byte_is_refused_or_changes_no_message(end, lake, whole, tmp_path):
    original = lake.recording.read_bytes()[:end]
    path = tmp_path / "changed.mcap"
    rng = np.random.default_rng(3)
    refused = 0
    for place in places_to_change(original):
        data = bytearray(original)
        data[place] ^= int(rng.integers(1, 256))
        path.write_bytes(data)
        try:
            found = everything(path)
        except RunnerError:
            refused += 1
            continue
        for topic, messages in whole.items():
            assert found[topic] == messages[: len(found[topic])], f"{topic}, changed at {place}"
    assert refused > 300


def test_no_changed_byte_gets_past_the_integrity_check(lake, tmp_path):
    check_integrity(lake.recording)
    original = lake.recording.read_bytes()
    library = slice(original.index(b"dualtaxi 0"), original.index(b"dualtaxi 0") + len("dualtaxi 0.1.0"))
    path = tmp_path / "changed.mcap"
    rng = np.random.default_rng(5)
    for place in places_to_change(original):
        if library.start <= place < library.stop:
            continue  # which version wrote it is the one thing that may differ
        data = bytearray(original)
        data[place] ^= int(rng.integers(1, 256))
        path.write_bytes(data)
        with pytest.raises(RecordingError):
            check_integrity(path)


@pytest.mark.parametrize(
    "change", [lambda data: data + b"\0", lambda data: data[:-1], lambda data: data[:-200]]
)
def test_bytes_too_many_or_too_few_do_not_get_past_the_integrity_check(change, lake, tmp_path):
    path = tmp_path / "changed.mcap"
    path.write_bytes(change(lake.recording.read_bytes()))
    with pytest.raises(RecordingError):
        check_integrity(path)


@pytest.mark.parametrize("made_of", [TAXIS, LAKE])
@pytest.mark.parametrize("packing", [{"compression": "lz4"}, {"compression": "none", "index": "chunk"}])
def test_a_written_recording_passes_the_integrity_check(made_of, packing, tmp_path):
    check_integrity(make_run(tmp_path, made_of, recording=packing).recording)


FOREIGN = {
    "empty": (b"", "empty file, expected a recording"),
    "text": (b"episodes: 100\n", "found another kind of file, expected an MCAP file"),
    "a piece of the magic": (MCAP0_MAGIC[:5], "expected an MCAP file"),
    "only the magic": (MCAP0_MAGIC, "cannot be read|cut off"),
    "magic and rubbish": (MCAP0_MAGIC + b"\x01" + b"\xff" * 200, "cannot be read"),
    "zeros": (bytes(1000), "found another kind of file, expected an MCAP file"),
}


@pytest.mark.parametrize("kind", FOREIGN)
def test_a_file_that_is_no_recording_is_refused_by_name(kind, tmp_path):
    content, message = FOREIGN[kind]
    path = tmp_path / "foreign.mcap"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=message) as caught:
        open_recording(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("where", ["nothing.mcap", "."])
def test_a_path_without_a_file_is_refused_by_name(where, tmp_path):
    with pytest.raises(RecordingError, match="cannot be read"):
        open_recording(tmp_path / where)


@pytest.mark.parametrize("profile", ["", "ros2", "dualtaxi"])
@pytest.mark.parametrize("finished", [True, False])
def test_another_writers_mcap_is_refused(profile, finished, tmp_path):
    path = tmp_path / "other.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD)
        writer.start(profile=profile, library="another")
        schema_id = writer.register_schema("Pose", "jsonschema", b"{}")
        channel = writer.register_channel("/pose", "json", schema_id)
        writer.add_message(channel, log_time=1, data=b"{}", publish_time=1)
        writer.finish()
    if not finished:
        path.write_bytes(path.read_bytes()[:-8])
    unlike = "not written by dualtaxi|cut off before"
    with pytest.raises(RecordingError, match=unlike if profile == "dualtaxi" else "not a dualtaxi recording"):
        open_recording(path)


def test_a_recording_of_another_version_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(schema, "FORMAT_VERSION", 99)
    path = make_run(tmp_path, LAKE).recording
    monkeypatch.undo()
    with pytest.raises(RecordingError, match="version 99, expected"):
        open_recording(path)


def with_chunk(data: bytes, body: bytes, size: int, compression: str, crc: int | None = None) -> bytes:
    """Return an unfinished recording whose first chunk is this one."""
    start = next(start for opcode, start, _ in records_of(data) if opcode == CHUNK)
    name = compression.encode()
    head = struct.pack("<QQQII", 0, 0, size, zlib.crc32(body) if crc is None else crc, len(name)) + name
    chunk = head + struct.pack("<Q", len(body)) + body
    return data[:start] + struct.pack("<BQ", CHUNK, len(chunk)) + chunk


HOSTILE = {
    "declares more memory than there is": (b"x" * 50, 2**60, "zstd"),
    "declares the largest number": (b"x" * 50, 2**64 - 1, ""),
    "unpacks to much more than it declares": (zstandard.compress(bytes(1 << 28)), 200, "zstd"),
    "unpacks to more, by lz4": (lz4.frame.compress(bytes(1 << 26)), 200, "lz4"),
    "unpacks to less": (zstandard.compress(bytes(100)), 200, "zstd"),
    "is no zstd": (b"x" * 50, 200, "zstd"),
    "is no lz4": (b"x" * 50, 200, "lz4"),
    "is packed by something unknown": (b"x" * 50, 50, "brotli"),
    "is packed by what is no text": (b"x" * 50, 50, "\u00e9"),
    "holds nothing": (b"", 0, ""),
    "holds less than a message": (b"x" * 20, 20, ""),
    "holds rubbish": (b"x" * 200, 200, ""),
    "holds a message without end": (struct.pack("<BQHIQQ", 5, 2**63, 1, 0, 0, 0) + bytes(90), 121, ""),
    "holds messages of no known channel": (struct.pack("<BQHIQQ", 5, 22, 99, 0, 0, 0), 31, ""),
    "holds messages of another size": (struct.pack("<BQHIQQ", 5, 23, 1, 0, 0, 0) + b"x", 32, ""),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_a_hostile_chunk_is_refused(kind, lake, tmp_path):
    body, size, compression = HOSTILE[kind]
    unpacked = None if compression else zlib.crc32(body)
    path = tmp_path / "hostile.mcap"
    path.write_bytes(with_chunk(lake.recording.read_bytes(), body, size, compression, unpacked))
    with pytest.raises(RecordingError) as caught:
        everything(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    "entries",
    [
        {},
        {"format_version": VERSION},
        {"format_version": VERSION, "learners": "many", "events": "0"},
        {"format_version": VERSION, "learners": "-1", "events": "0"},
        {"format_version": VERSION, "learners": "1000000000000", "events": "0"},
        {
            "format_version": VERSION,
            "learners": "1",
            "events": "0",
            "run_id": "x",
            "name": "x",
            "seed": "one",
        },
    ],
    ids=str,
)
def test_a_description_that_makes_no_sense_is_refused(entries, lake, tmp_path):
    """The description has no checksum of its own: only its values can reveal the damage."""
    data = lake.recording.read_bytes()
    opcode, start, end = next(record for record in records_of(data) if record[0] == 12)
    body = _text("run") + _mapping(entries)
    damaged = data[:start] + struct.pack("<BQ", opcode, len(body)) + body + data[end:]
    path = tmp_path / "senseless.mcap"
    path.write_bytes(damaged[: max(end for _, _, end in records_of(damaged[: len(damaged) - 500]))])
    with pytest.raises(RecordingError):
        everything(path)


@pytest.mark.parametrize(
    "agents", ["nonsense", "{}", "[]", '["a", "b"]', "[null]", "[" * 100_000], ids=range(6)
)
def test_learners_without_names_are_refused(agents, lake, tmp_path):
    path = tmp_path / "nameless.mcap"
    rewrite(
        lake.recording, path, lambda name, entries: entries | ({"agents": agents} if name == "run" else {})
    )
    with pytest.raises(RecordingError, match="its run has agents"):
        everything(path)


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text.encode())) + text.encode()


def _mapping(entries: dict[str, str]) -> bytes:
    body = b"".join(_text(key) + _text(value) for key, value in entries.items())
    return struct.pack("<I", len(body)) + body


def bomb(data: bytes, messages: int, chunks: int) -> bytes:
    """Return an unfinished recording of equal chunks of equal steps."""
    start = next(start for opcode, start, _ in records_of(data) if opcode == CHUNK)
    step = struct.pack("<BQHIQQ", 5, 22 + 60, 1, 0, 0, 0) + bytes(60)
    body = zstandard.compress(step * messages)
    head = struct.pack("<QQQII", 0, 0, len(step) * messages, zlib.crc32(step * messages), 4) + b"zstd"
    chunk = head + struct.pack("<Q", len(body)) + body
    return data[:start] + (struct.pack("<BQ", CHUNK, len(chunk)) + chunk) * chunks


def test_chunks_of_more_messages_than_any_recorder_writes_are_refused_unpacked(lake, tmp_path):
    path = tmp_path / "bomb.mcap"
    path.write_bytes(bomb(lake.recording.read_bytes(), 700_000, 2))
    with pytest.raises(RecordingError, match="declares 700,000 messages, expected 65,536 at most"):
        check_integrity(path)
    assert repair(path).kept.get("/train/step") is None


def test_a_file_that_declares_far_more_than_it_can_hold_is_refused_before_it_is_unpacked(lake, tmp_path):
    path = tmp_path / "bomb.mcap"
    path.write_bytes(bomb(lake.recording.read_bytes(), 700_000, 100))
    with pytest.raises(RecordingError, match="made to exhaust memory"):
        check_integrity(path)
    assert "made to exhaust memory" in verify(path).finding


def test_a_record_longer_than_any_chunk_is_not_read_to_find_out_whether_a_file_was_cut(lake, tmp_path):
    path = tmp_path / "long.mcap"
    data = lake.recording.read_bytes()
    end = next(start for opcode, start, _ in records_of(data) if opcode == CHUNK)
    length = 256 << 20
    path.write_bytes(data[:end] + struct.pack("<BQ", CHUNK, length))
    os.truncate(path, end + 9 + length)  # zeros that take no room on the disk
    tracemalloc.start()
    try:
        assert not may_be_cut(path, survey(path))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < length / 2


@pytest.mark.parametrize("shape", [[1] * 70, [0] + [2**32 - 1] * 5], ids=["70 axes", "too large"])
def test_an_array_of_an_impossible_shape_is_refused(shape):
    data = b"" if 0 in shape else bytes(8)
    with pytest.raises(RecordingError, match="found an array of shape"):
        decode_array(encode(schema.ARRAY, {"name": "w", "shape": shape, "dtype": "<f8", "data": data}))


@pytest.mark.parametrize(
    "options",
    [{"$float": 10**400}, {"$array": {"dtype": ",", "shape": [], "base64": ""}}],
    ids=["a large number", "no dtype"],
)
def test_options_that_cannot_be_restored_are_refused(options):
    with pytest.raises(RecordingError, match="options of a reset"):
        decode_reset_options(encode(schema.RESET_OPTIONS, {"json": json.dumps(options), "resets": 1}))


def test_a_repair_that_cannot_replace_the_file_leaves_it_where_it_was(lake, tmp_path, monkeypatch):
    path = tmp_path / "recording.mcap"
    data = bytearray(lake.recording.read_bytes())
    chunks = [(start, end) for opcode, start, end in records_of(bytes(data)) if opcode == CHUNK]
    start, end = chunks[len(chunks) // 2]
    data[start + 20 : end] = bytes(end - start - 20)
    path.write_bytes(data)

    def fail(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(StorageError, match="is as it was"):
        repair(path)
    assert path.read_bytes() == data
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]
