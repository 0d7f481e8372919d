"""The recorder, blocks in and file out, against `mcap.writer.Writer` given the same messages."""

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
from runner.recording.chunks import Packing
from runner.recording.recorder import Recorder
from runner.recording.writer import RecordingFile

WRITER_LEVEL = 3
"""What `mcap.writer.Writer` compresses with: it cannot be told otherwise."""
DEFAULT_LEVEL = 1
"""What a run compresses with, unless its configuration says otherwise."""


def measure(quick: bool) -> list[Figure]:
    """Return messages a second of both, and their ratio, for the steps of the tutorial's training."""
    repetitions, ours, theirs = (3, 500_000, 50_000) if quick else (5, 4_000_000, 200_000)
    records = training_steps(ours)
    messages = wire_messages(records[:theirs])
    rates: dict[str, list[float]] = {"writer": [], "same": [], "default": []}
    sizes: dict[str, float] = {}
    for _ in range(repetitions):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "writer.mcap")
            rates["writer"].append(theirs / seconds(lambda: write(path, messages)))  # noqa: B023 - called at once
            sizes["writer"] = path.stat().st_size / theirs
            for name, level in (("same", WRITER_LEVEL), ("default", DEFAULT_LEVEL)):
                path = Path(folder, f"{name}.mcap")
                elapsed = seconds(lambda: record(path, records, Packing(level=level)))  # noqa: B023
                rates[name].append(ours / elapsed)
                sizes[name] = path.stat().st_size / ours
    ratios = {
        name: [fast / slow for fast, slow in zip(rates[name], rates["writer"], strict=True)]
        for name in ("same", "default")
    }
    return [
        figure(
            "recorder against mcap.writer.Writer",
            ratios["same"],
            "x",
            (15, 30),
            detail=f"both zstd level {WRITER_LEVEL}, message index, checksums; "
            "ours digests besides, and uses threads",
        ),
        figure(f"  at the default, zstd level {DEFAULT_LEVEL}", ratios["default"], "x"),
        *(
            figure(
                f"  {what}",
                [rate / 1e6 for rate in rates[name]],
                "M messages/s",
                detail=f"{sizes[name]:.1f} bytes each",
            )
            for name, what in (
                ("same", f"recorder, zstd level {WRITER_LEVEL}"),
                ("default", f"recorder, zstd level {DEFAULT_LEVEL}"),
                ("writer", "mcap.writer.Writer, messages ready-made"),
            )
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
    payloads = (data[at + schema.HEADER_BYTES : at + size] for at in range(0, len(data), size))
    return list(zip(records["log_time"].tolist(), payloads, strict=True))


def record(path: Path, records: NDArray[Any], packing: Packing) -> None:
    """Hand step records to the recorder, block by block, as a learner does."""
    raw, size = records.view(np.uint8), records.itemsize
    with RecordingFile(path) as file:
        recorder = Recorder(file, learners=1, events=0, packing=packing)
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
    schema_id = writer.register_schema(
        schema.STEP.full_name, "protobuf", schema.file_descriptor_set(schema.STEP)
    )
    channel_id = writer.register_channel(schema.TRAIN_STEP.name, "protobuf", schema_id)
    for log_time, payload in messages:
        writer.add_message(channel_id, log_time, payload, log_time)
    writer.finish()
