"""The reader: a full read against the official library, and one episode in the middle of a recording."""

from __future__ import annotations

import tempfile
from pathlib import Path

from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from benchmarks.figures import Figure, figure, seconds
from benchmarks.processes import run, run_command
from runner.recording import schema
from runner.recording.reader import open_recording

STEP_TOPICS = (schema.TRAIN_STEP, schema.EVAL_STEP)
FIELDS = tuple(field.name for field in schema.STEP.fields)


def measure(quick: bool) -> list[Figure]:
    """Return steps per second of both, their ratio, and milliseconds for an episode."""
    repetitions, theirs = (3, 20_000) if quick else (7, 100_000)
    with tempfile.TemporaryDirectory() as folder:
        path = tutorial(folder)
        rates, official, episodes = [], [], []
        steps = read_all(path)
        for _ in range(repetitions):
            official.append(theirs / seconds(lambda: read_officially(path, theirs)))
            rates.append(steps / seconds(lambda: read_all(path)))
            episodes.append(1e3 * seconds(lambda: read_episode(path)))
        size = path.stat().st_size
    ratios = [fast / slow for fast, slow in zip(rates, official, strict=True)]
    return [
        figure(
            "full read against the official reader",
            ratios,
            "x",
            (50, 100),
            detail="sum of every field of every step; both check checksums, and theirs decodes Protobuf",
        ),
        figure(
            "  full read, every field summed",
            [rate / 1e6 for rate in rates],
            "M steps/s",
            (8, 15),
            detail=f"{steps / 1e6:.2f} M steps, {size / 1e6:.0f} MB, in the page cache",
        ),
        figure("  official reader", [rate / 1e6 for rate in official], "M steps/s"),
        figure(
            "open, and read an episode in the middle",
            episodes,
            "ms",
            (50, 10),
            higher_is_better=False,
            detail=f"of {steps / 1e6:.1f} M steps; nothing cached",
        ),
    ]


def tutorial(folder: str) -> Path:
    """Record the cooperative tutorial and return the recording."""
    run(run_command("tutorial_cooperative", folder))
    (path,) = Path(folder).glob("*/recording.mcap")
    return path


def read_all(path: Path) -> int:
    """Sum every field of every step, block by block; return the number of steps."""
    steps, total = 0, 0.0
    with open_recording(path) as recording:
        for topic in STEP_TOPICS:
            for block in recording.table(topic).blocks():
                steps += len(block)
                for name in FIELDS:
                    total += block[name].sum()
    return steps


def read_officially(path: Path, steps: int) -> None:
    """Sum every field of the first steps with the official library."""
    total = 0.0
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        topics = [topic.name for topic in STEP_TOPICS]
        messages = reader.iter_decoded_messages(topics=topics, log_time_order=False)
        for (_, _, _, step), _ in zip(messages, range(steps), strict=False):
            for name in FIELDS:
                value = getattr(step, name)
                total += sum(value) if name == "rewards" else value


def read_episode(path: Path) -> None:
    """Open the recording and read one episode in its middle."""
    with open_recording(path) as recording:
        recording.train.episode_steps(recording.train.episodes.count() // 2)
