"""Start-up time of the command line."""

from __future__ import annotations

import sys
import tempfile

from benchmarks.figures import Figure, figure
from benchmarks.processes import run, run_command

RUNS = 5


def measure(quick: bool) -> list[Figure]:
    """Return the time of `dualtaxi --help`, and of `dualtaxi ls` in a folder with a few runs."""
    repetitions = 3 if quick else 10
    with tempfile.TemporaryDirectory() as recordings:
        for _ in range(RUNS):
            run(run_command("quick", recordings))
        helps = [run(command("--help")).seconds for _ in range(repetitions)]
        lists = [run(command("ls", "--recordings", recordings)).seconds for _ in range(repetitions)]
    bare = [run([sys.executable, "-c", ""]).seconds for _ in range(repetitions)]
    return [
        figure("dualtaxi --help", helps, "s", (0.4, 0.2), higher_is_better=False),
        figure(
            "dualtaxi ls", lists, "s", (0.6, 0.2), higher_is_better=False, detail=f"{RUNS} runs in the folder"
        ),
        figure("  Python itself", bare, "s", higher_is_better=False),
    ]


def command(*arguments: str) -> list[str]:
    """Return the command line with these arguments."""
    return [sys.executable, "-m", "runner", *arguments]
