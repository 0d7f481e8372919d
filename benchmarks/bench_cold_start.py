"""Start-up time of the command line."""

from __future__ import annotations

import sys
import tempfile

from benchmarks.figures import Figure, figure
from benchmarks.processes import run, run_command

RUNS = 5


def measure(quick: bool) -> list[Figure]:
    """Return the times of commands that start, do little and end, and of Python itself."""
    repetitions = 3 if quick else 10
    with tempfile.TemporaryDirectory() as recordings:
        for _ in range(RUNS):
            run(run_command("quick", recordings))
        measured = {
            "dualtaxi --help": (["--help"], (0.4, 0.06), ""),
            "dualtaxi when --help": (["when", "--help"], (0.4, 0.13), ""),
            "dualtaxi ls": (["ls", "--recordings", recordings], (0.6, 0.1), f"{RUNS} runs in the folder"),
            "dualtaxi show": (["show", "@latest", "--recordings", recordings], (0.6, 0.3), ""),
        }
        seconds = {
            name: [run(command(*arguments)).seconds for _ in range(repetitions)]
            for name, (arguments, _, _) in measured.items()
        }
    bare = [run([sys.executable, "-c", ""]).seconds for _ in range(repetitions)]
    return [
        *(
            figure(name, seconds[name], "s", limits, higher_is_better=False, detail=detail)
            for name, (_, limits, detail) in measured.items()
        ),
        figure("  Python itself", bare, "s", higher_is_better=False),
    ]


def command(*arguments: str) -> list[str]:
    """Return the command line with these arguments."""
    return [sys.executable, "-m", "runner", *arguments]
