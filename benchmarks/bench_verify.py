"""Verification of the tutorial's recording, the exact table at a random step, and memory of reading."""

from __future__ import annotations

import random
import sys
import tempfile
from pathlib import Path

from benchmarks.bench_reader import tutorial
from benchmarks.figures import Figure, figure, seconds
from benchmarks.processes import run, run_command
from runner.execution.verify import verify
from runner.recording.reader import open_recording
from runner.replay.tables import tables_at

READ = "import sys; from pathlib import Path; from benchmarks.bench_reader import read_all, read_episode; \
path = Path(sys.argv[1]); read_all(path); read_episode(path)"
VERIFY = "import sys; from pathlib import Path; from runner.execution.verify import verify; \
assert verify(Path(sys.argv[1])).sound"


def measure(quick: bool) -> list[Figure]:
    """Return times and peak memory, also for a recording ten times as long."""
    repetitions, times = (3, 2) if quick else (7, 10)
    rng = random.Random(0)
    with tempfile.TemporaryDirectory() as folder:
        path = tutorial(folder)
        table_at(path, 1)  # compiles
        with open_recording(path) as recording:
            steps = recording.train.steps.count()
        tables = [seconds(lambda: table_at(path, rng.randrange(steps))) for _ in range(3 * repetitions)]
        verified = [seconds(lambda: sound(path)) for _ in range(repetitions)]
        memory = [peak(READ, path), peak(VERIFY, path)]
    with tempfile.TemporaryDirectory() as folder:
        run(run_command("tutorial_cooperative", folder, f"episodes={times * 50_000}"))
        (path,) = Path(folder).glob("*/recording.mcap")
        longer = [peak(READ, path), peak(VERIFY, path)]
    return [
        figure("verify of the tutorial", verified, "s", (10, 4), higher_is_better=False),
        figure(
            "the exact table at a random step",
            tables,
            "s",
            (0.6, 0.2),
            higher_is_better=False,
            detail="including opening; with the shipped snapshots, every 10,000 episodes",
        ),
        figure("peak memory, full read and verify", [max(memory)], "MB", (400, 200), higher_is_better=False),
        figure(
            f"  for a recording {times} times as long",
            [max(longer)],
            "MB",
            (400, 200),
            higher_is_better=False,
            detail="resident; about 170 MB are Python, NumPy and the compiled kernels",
        ),
    ]


def table_at(path: Path, step: int) -> None:
    """Open the recording and compute the table at a step."""
    with open_recording(path) as recording:
        tables_at(recording, step)


def sound(path: Path) -> None:
    """Verify the recording."""
    assert verify(path).sound


def peak(program: str, path: Path) -> float:
    """Return the peak memory of a program that reads a recording, in MB."""
    return run([sys.executable, "-c", program, str(path)]).peak_megabytes
