"""The first run on a fresh machine: a short experiment, including compilation."""

from __future__ import annotations

import tempfile

from benchmarks.figures import Figure, figure
from benchmarks.processes import run_config


def measure(quick: bool) -> list[Figure]:
    """Return the time of the quick configuration without and with cached kernels."""
    repetitions = 1 if quick else 3
    fresh = []
    for _ in range(repetitions):
        with tempfile.TemporaryDirectory() as kernels:
            fresh.append(run_config("quick", environment={"NUMBA_CACHE_DIR": kernels}).process.seconds)
    run_config("quick")
    cached = [run_config("quick").process.seconds for _ in range(repetitions)]
    return [
        figure(
            "first run, compiling", fresh, "s", (15, 6), higher_is_better=False, detail="configs/quick.yaml"
        ),
        figure("  with cached kernels", cached, "s", higher_is_better=False),
    ]
