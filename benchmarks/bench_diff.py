"""`dualtaxi diff` of two tutorial runs: time of the whole command, and memory for longer runs."""

from __future__ import annotations

import statistics
import sys
import tempfile
from collections.abc import Sequence

from benchmarks.figures import Figure, figure
from benchmarks.processes import Process, run, run_command

CONFIG = "tutorial_cooperative"
OTHERS = {"another discount": "discount=0.8", "another seed": "seed=1"}


def measure(quick: bool) -> list[Figure]:
    """Return times and peak memory, also for runs ten times as long."""
    repetitions, times = (3, 2) if quick else (7, 10)
    figures = []
    with tempfile.TemporaryDirectory() as folder:
        record(folder)
        for name, other in OTHERS.items():
            whole = [compared(folder, other) for _ in range(repetitions)]
            first = [compared(folder, other, "--first") for _ in range(repetitions)]
            figures += [
                _seconds(f"diff, {name}", whole, (8, 3)),
                _seconds(f"diff --first, {name}", first, (0.7, 0.3)),
                _peak(f"  peak memory, {name}", whole),
            ]
    with tempfile.TemporaryDirectory() as folder:
        record(folder, f"episodes={50_000 * times}")
        longer = [compared(folder, other) for other in OTHERS.values()]
    return [*figures, _peak(f"  for runs {times} times as long", longer)]


def _seconds(what: str, processes: Sequence[Process], targets: tuple[float, float]) -> Figure:
    cpu = statistics.median(process.cpu_seconds for process in processes)
    seconds = [process.seconds for process in processes]
    detail = f"{cpu:.2f} s of processor time in all threads"
    return figure(what, seconds, "s", targets, higher_is_better=False, detail=detail)


def _peak(what: str, processes: Sequence[Process]) -> Figure:
    peak = max(process.peak_megabytes for process in processes)
    return figure(what, [peak], "MB", (500, 250), higher_is_better=False)


def record(folder: str, *overrides: str) -> None:
    """Record the tutorial's run and those to compare it with."""
    for other in ("name=base", *(f"name={named(other)}" for other in OTHERS.values())):
        sets = [text for text in OTHERS.values() if other == f"name={named(text)}"]
        run(run_command(CONFIG, folder, *overrides, *sets, other))
    compared(folder, OTHERS["another discount"])  # compiles


def named(override: str) -> str:
    """Return the name of the run with an override."""
    return override.replace("=", "_").replace(".", "_")


def compared(folder: str, other: str, *options: str) -> Process:
    """Compare the base run with another and return time and memory."""
    names = ["base", named(other)]
    return run([sys.executable, "-c", PROGRAM, "diff", *names, "--recordings", folder, *options])


PROGRAM = """
import sys
from runner.cli import cli
try:
    cli(sys.argv[1:])
except SystemExit as exit:
    sys.exit(exit.code != 1)
"""
"""Calls the command, whose expected exit code is 1: the runs differ."""
