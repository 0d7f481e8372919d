"""Peak memory of the cooperative tutorial, and with ten times the episodes."""

from __future__ import annotations

from benchmarks.figures import Figure, figure
from benchmarks.processes import run_config

CONFIG = "tutorial_cooperative"
EPISODES = 50_000


def measure(quick: bool) -> list[Figure]:
    """Return the peaks and their growth; the longer run has ten times the episodes, or two if quick."""
    times = 2 if quick else 10
    run_config("quick")  # compiles
    short = [run_config(CONFIG).process.peak_megabytes for _ in range(3)]
    longer = run_config(CONFIG, f"episodes={times * EPISODES}")
    long = [longer.process.peak_megabytes]
    growth = [100 * (long[0] / figure("", short, "").value - 1)]
    return [
        figure(
            "peak memory, tutorial",
            short,
            "MB",
            (400, 250),
            higher_is_better=False,
            detail="resident",
        ),
        figure(
            f"peak memory, {times} times as long",
            long,
            "MB",
            (400, 250),
            higher_is_better=False,
            detail=f"{longer.steps / 1e6:.1f} M steps, {longer.file_bytes / 1e9:.2f} GB, "
            f"{longer.process.seconds:.1f} s",
        ),
        figure("  growth", growth, "%", (10, 10), higher_is_better=False),
    ]
