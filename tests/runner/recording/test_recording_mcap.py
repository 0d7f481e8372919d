"""Others read our files: the official MCAP reader, its protobuf decoder, and Rerun's own loader."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from mcap.exceptions import InvalidMagic
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Chunk, ChunkIndex, DataEnd, Message, MessageIndex
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from mcap_protobuf.decoder import DecoderFactory

from runner.recording import schema
from runner.recording.messages import message_class
from runner.recording.reader import open_recording
from tests.runner.recording.making import LAKE, TAXIS, make_run

PACKINGS = [
    {"compression": "zstd"},
    {"compression": "zstd", "level": 19, "index": "chunk"},
    {"compression": "lz4"},
    {"compression": "none"},
    {"compression": "none", "index": "chunk", "chunk_steps": 256},
]
RERUN = Path(sys.executable).with_name("rerun")


@pytest.fixture(scope="module", params=PACKINGS, ids=lambda packing: "-".join(map(str, packing.values())))
def run(request, tmp_path_factory):
    """Return a run recorded in one of the ways there are."""
    return make_run(tmp_path_factory.mktemp("packed"), TAXIS, recording=request.param)


def official_messages(path: Path) -> dict[str, list]:
    """Return (message record, decoded) by topic, as the official reader gives them, checksums compared."""
    messages: dict[str, list] = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages(log_time_order=False):
            messages.setdefault(channel.topic, []).append((message, decoded))
    return messages


def plain(value):
    """Return a repeated field as a list, anything else as it is."""
    return value if isinstance(value, int | float | str | bytes) else list(value)


def test_the_official_reader_gives_every_message_as_ours_does(run):
    messages = official_messages(run.recording)
    assert set(messages) == {"/clock", *(topic.name for topic in schema.JOB_TOPICS)}
    with open_recording(run.recording) as recording:
        for topic in schema.BLOCK_TOPICS:
            theirs = messages[topic.name]
            ours = recording.table(topic).array()
            assert len(theirs) == len(ours) == recording.table(topic).count() > 0
            assert [message.log_time for message, _ in theirs] == ours["log_time"].tolist()
            for field in topic.message.fields:
                found = [plain(getattr(decoded, field.name)) for _, decoded in theirs]
                assert found == ours[field.name].tolist(), f"{topic.name} {field.name}"
        kinds = {topic.name: topic for topic in schema.KINDS["job"]}
        for phase, name in (("train", "/train/metrics"), ("eval", "/eval/metrics")):
            ours = recording.phase(phase).all_metrics()
            assert len(ours) == len(messages[name])
            for mine, (message, decoded) in zip(ours, messages[name], strict=True):
                assert mine.pop("log_time") == message.log_time
                # As text: a mean of nothing is NaN, which equals nothing.
                names = {field.name: field.stored_name for field in kinds[name].message.fields}
                assert repr(mine) == repr({key: plain(getattr(decoded, names[key])) for key in mine})
        snapshots = list(recording.snapshots())
        assert len(snapshots) == len(messages["/q_table"])
        for mine, (_, decoded) in zip(snapshots, messages["/q_table"], strict=True):
            assert (mine.step, mine.episode) == (decoded.step, decoded.episode)
            assert (mine.agent, mine.table) == (decoded.agent, decoded.table)
            assert decoded.dtype == "<f8"
            table = np.frombuffer(decoded.data, decoded.dtype).reshape(list(decoded.shape))
            assert mine.values.tobytes() == table.tobytes()
        assert [decoded.message for _, decoded in messages["/log"]][-1] == "finished"


def test_messages_of_the_million_kind_have_one_size_each(run):
    for topic in schema.BLOCK_TOPICS:
        sizes = {len(message.data) for message, _ in official_messages(run.recording)[topic.name]}
        assert len(sizes) == 1
    values = message_class(schema.STEP)(step=2**62, state=2**31, rewards=[1e300, -0.0], explored=3)
    zeros = message_class(schema.STEP)()
    assert values.ByteSize() != zeros.ByteSize(), "what protobuf would have left out is what we write"


def test_every_record_of_the_file_passes_the_official_checks(run):
    with run.recording.open("rb") as stream:
        records = list(StreamReader(stream, emit_chunks=True, validate_crcs=True).records)
    ends = [record for record in records if isinstance(record, DataEnd)]
    data = run.recording.read_bytes()
    end = data.rindex(struct.pack("<BQI", Opcode.DATA_END, 4, ends[0].data_section_crc))
    assert ends == [DataEnd(zlib.crc32(data[:end]))]
    chunks = [record for record in records if isinstance(record, Chunk)]
    assert all(chunk.uncompressed_crc for chunk in chunks)
    recorded = run.facts["config"]["recording"]
    expected = "" if recorded["compression"] == "none" else recorded["compression"]
    assert {chunk.compression for chunk in chunks} == {expected}
    indexes = [record for record in records if isinstance(record, MessageIndex)]
    assert len(indexes) == len(chunks)
    assert any(index.records for index in indexes) == (recorded["index"] == "message")
    assert len([record for record in records if isinstance(record, ChunkIndex)]) == len(chunks)


def test_the_summary_counts_what_is_there(run):
    messages = official_messages(run.recording)
    with run.recording.open("rb") as stream:
        summary = make_reader(stream, validate_crcs=True).get_summary()
    counts = {
        summary.channels[channel].topic: count
        for channel, count in summary.statistics.channel_message_counts.items()
    }
    assert counts == {topic: len(found) for topic, found in messages.items()}
    assert counts.pop("/clock") >= 2  # where it began, and where it ended
    assert counts == run.summary["messages"]
    assert summary.statistics.message_count == sum(map(len, messages.values()))
    times = [message.log_time for found in messages.values() for message, _ in found]
    assert (summary.statistics.message_start_time, summary.statistics.message_end_time) == (
        min(times),
        max(times),
    )


def test_official_tools_find_messages_by_their_time(taxis):
    everything = official_messages(taxis.recording)["/train/step"]
    low, high = everything[700][0].log_time, everything[900][0].log_time
    with taxis.recording.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        found = list(reader.iter_messages(topics=["/train/step"], starting_at=low, ending_before=high))
    assert [message.data for _, _, message in found] == [message.data for message, _ in everything[700:900]]


def test_each_message_index_leads_to_the_messages_of_the_chunk_before_it(taxis):
    with taxis.recording.open("rb") as stream:
        records = [
            record
            for record in StreamReader(stream, emit_chunks=True).records
            if isinstance(record, Chunk | MessageIndex)
        ]
    assert len(records) > 20
    for chunk, index in zip(records[::2], records[1::2], strict=True):
        data, length = get_chunk_data_stream(chunk, validate_crc=True)
        places = []
        while data.count < length:
            at = data.count
            assert data.read1() == Opcode.MESSAGE
            message = Message.read(data, data.read8())
            assert message.channel_id == index.channel_id
            places.append((message.log_time, at))
        assert index.records == places
        times = [time for time, _ in places]
        assert (chunk.message_start_time, chunk.message_end_time) == (min(times), max(times))


def test_attachments_and_metadata_are_found_by_the_official_reader(taxis):
    with taxis.recording.open("rb") as stream, open_recording(taxis.recording) as recording:
        reader = make_reader(stream, validate_crcs=True)
        attachments = {attachment.name: attachment.data for attachment in reader.iter_attachments()}
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        assert {"environment.json", "environment/next_state.npy.zst"} <= set(attachments)
        assert attachments == {name: recording.file.attachment(name) for name in attachments}
        assert set(metadata) == {"run", "config", "provenance", "result"}
        assert metadata == {name: recording.file.metadata(name) for name in metadata}


@pytest.mark.skipif(not RERUN.exists(), reason="the rerun command is not installed")
@pytest.mark.parametrize("experiment", [TAXIS, LAKE], ids=["taxis", "lake"])
def test_rerun_finds_nothing_wrong(experiment, tmp_path):
    path = make_run(tmp_path, experiment).recording
    command = [RERUN, "mcap", "check", "--full", path]
    quiet = os.environ | {"RERUN_ANALYTICS": "0", "HOME": str(tmp_path), "XDG_CONFIG_HOME": str(tmp_path)}
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, env=quiet)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = [line.split() for line in done.stdout.splitlines() if "/" in line and ".mcap" not in line]
    assert {row[3] for row in rows} == {"/clock", *(topic.name for topic in schema.JOB_TOPICS)}
    assert {row[0] for row in rows} == {"ok"}


def test_the_tools_used_here_do_refuse_a_damaged_file(lake, tmp_path):
    damaged = tmp_path / "damaged.mcap"
    data = bytearray(lake.recording.read_bytes())
    data[0] ^= 1
    damaged.write_bytes(data)
    with pytest.raises(InvalidMagic):
        official_messages(damaged)
