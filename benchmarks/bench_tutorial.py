"""The whole cooperative tutorial as one command, every step recorded: time and size."""

from __future__ import annotations

from benchmarks.figures import Figure, figure
from benchmarks.processes import run_config

CONFIG = "tutorial_cooperative"


def measure(quick: bool) -> list[Figure]:
    """Return the time of the whole process, and the size of the file per step."""
    run_config("quick")  # compiles
    runs = [run_config(CONFIG) for _ in range(3 if quick else 5)]
    steps = runs[0].steps
    return [
        figure(
            "tutorial, whole process",
            [run.process.seconds for run in runs],
            "s",
            (4, 2),
            higher_is_better=False,
            detail=f"{steps / 1e6:.2f} M steps, all recorded; kernels compiled before",
        ),
        figure("  processor time", [run.process.cpu_seconds for run in runs], "s", higher_is_better=False),
        figure(
            "file size per step",
            [run.file_bytes / run.steps for run in runs],
            "bytes",
            (34, 28),
            higher_is_better=False,
            detail=f"{runs[0].file_bytes / 1e6:.0f} MB with message index, snapshots, episodes and metrics",
        ),
    ]
