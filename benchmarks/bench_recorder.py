"""The recorder, from blocks to file, against `mcap.writer.Writer` with the same messages."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from benchmarks.figures import Figure, figure, seconds
from benchmarks.learners import NO_LIMIT, blocks, tutorial_learner
from runner.recording import schema
from runner.recording.layout import HEADER_BYTES, layout_of
from runner.recording.messages import file_descriptor_set
from runner.recording.recorder import Recorder
from runner.recording.writer import RecordingFile
from runner.util.packing import Packing


def measure(quick: bool) -> list[Figure]:
    """Return messages per second of both, and their ratio, for the training steps of the tutorial.

    The library always compresses with zstd level 3, ours with the options of a run. So both sizes are
    reported too.
    """
    repetitions, ours, theirs = (3, 500_000, 50_000) if quick else (5, 4_000_000, 200_000)
    packing = tutorial_learner().config.recording.packing
    records = training_steps(ours)
    messages = wire_messages(records[:theirs])
    recorder, writer = [], []
    with tempfile.TemporaryDirectory() as folder:
        our_file, their_file = Path(folder, "recorder.mcap"), Path(folder, "writer.mcap")
        for _ in range(repetitions):
            our_file.unlink(missing_ok=True)
            writer.append(theirs / seconds(lambda: write(their_file, messages)) / 1e6)
            recorder.append(ours / seconds(lambda: record(our_file, records, packing)) / 1e6)
        our_bytes, their_bytes = our_file.stat().st_size / ours, their_file.stat().st_size / theirs
    return [
        figure(
            "recorder against mcap.writer.Writer",
            [fast / slow for fast, slow in zip(recorder, writer, strict=True)],
            "x",
            (15, 30),
            detail="both with zstd, message index and checksums; ours digests besides, and uses threads",
        ),
        figure(
            "  recorder",
            recorder,
            "M messages/s",
            detail=f"zstd level {packing.level}: {our_bytes:.1f} bytes each, with the index",
        ),
        figure(
            "  mcap.writer.Writer",
            writer,
            "M messages/s",
            detail=f"zstd level 3: {their_bytes:.1f} bytes each; it is given the messages ready-made",
        ),
    ]


def training_steps(n: int) -> NDArray[Any]:
    """Return the message records of the first n training steps of the cooperative tutorial."""
    learner = tutorial_learner()
    records, _ = blocks(learner, "train", n)
    _, episodes = blocks(learner, "train", 1)
    filled = 0
    while filled < n:
        filled += learner.train(records[filled:], episodes, NO_LIMIT, n)[0]
    records["log_time"] = records["publish_time"] = np.arange(1, n + 1) * schema.STEP_NANOSECONDS
    return records


def wire_messages(records: NDArray[Any]) -> list[tuple[int, bytes]]:
    """Return (log time, payload) of each message record."""
    size, data = records.itemsize, records.tobytes()
    payloads = (data[at + HEADER_BYTES : at + size] for at in range(0, len(data), size))
    return list(zip(records["log_time"].tolist(), payloads, strict=True))


def record(path: Path, records: NDArray[Any], packing: Packing) -> None:
    """Hand step records to the recorder, block by block, as a learner does."""
    raw, size = records.view(np.uint8), records.itemsize
    with RecordingFile(path, layout_of("job", 1, 0)) as file:
        recorder = Recorder(file, layout_of("job", 1, 0), packing)
        done = 0
        while done < len(records):
            block = recorder.block(schema.TRAIN_STEP)
            n = min(len(block), len(records) - done)
            block[:n].view(np.uint8)[:] = raw[done * size : (done + n) * size]
            recorder.commit("train", n, 0)
            done += n
        recorder.drain()
        file.finish()


def write(path: Path, messages: list[tuple[int, bytes]]) -> None:
    """Write the same messages by the official library."""
    writer = Writer(str(path), compression=CompressionType.ZSTD)
    writer.start(profile=schema.PROFILE)
    schema_id = writer.register_schema(schema.STEP.full_name, "protobuf", file_descriptor_set(schema.STEP))
    channel_id = writer.register_channel(schema.TRAIN_STEP.name, "protobuf", schema_id)
    for log_time, payload in messages:
        writer.add_message(channel_id, log_time, payload, log_time)
    writer.finish()
