"""`dualtaxi diff` of two tutorial runs: time of the whole command, and memory for longer runs."""

from __future__ import annotations

import tempfile

from benchmarks.figures import Figure, command_seconds, peak_memory
from benchmarks.processes import Process, dualtaxi, run, run_command

CONFIG = "tutorial_cooperative"
OTHERS = {"another discount": "discount=0.8", "another seed": "seed=1"}
MEMORY = (500, 250)


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
                command_seconds(f"diff, {name}", whole, (8, 3)),
                command_seconds(f"diff --first, {name}", first, (0.7, 0.3)),
                peak_memory(f"  peak memory, {name}", whole, MEMORY),
            ]
    with tempfile.TemporaryDirectory() as folder:
        record(folder, f"episodes={50_000 * times}")
        longer = [compared(folder, other) for other in OTHERS.values()]
    return [*figures, peak_memory(f"  for runs {times} times as long", longer, MEMORY)]


def record(folder: str, *overrides: str) -> None:
    """Record the tutorial's run and those to compare it with, and compile what compares them."""
    run(run_command(CONFIG, folder, *overrides, "name=base"))
    for other in OTHERS.values():
        run(run_command(CONFIG, folder, *overrides, other, f"name={named(other)}"))
    compared(folder, OTHERS["another discount"])


def named(override: str) -> str:
    """Return the name of the run with an override."""
    return override.replace("=", "_")


def compared(folder: str, other: str, *options: str) -> Process:
    """Compare the base run with another, which differs, and return time and memory."""
    return dualtaxi(folder, "diff", "base", named(other), *options, exit_code=1)
