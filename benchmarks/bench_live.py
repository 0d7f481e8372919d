"""The cost of watching a run in the viewer while it trains."""

from __future__ import annotations

from benchmarks.figures import Figure, figure
from benchmarks.processes import JobRun, run_config
from runner.export.rerun import viewer

CONFIG = "tutorial_cooperative"
LONGER = "episodes=500000"
"""Ten times the tutorial's episodes, because starting takes two seconds of one core regardless of length."""


def measure(quick: bool) -> list[Figure]:
    """Return the slowdown of a watched job in percent, alternating between watched and alone."""
    port = viewer.free_port()
    watched = ("--live-url", f"rerun+http://{viewer.LOOPBACK}:{port}/proxy")
    with viewer.viewer(port, "--serve-grpc"):
        run_config("quick")  # compiles
        pairs = [
            (run_config(CONFIG, LONGER), run_config(CONFIG, LONGER, options=watched))
            for _ in range(3 if quick else 5)
        ]
    return [
        figure(
            "slowdown by watching live",
            [_percent(with_view.seconds, alone.seconds) for alone, with_view in pairs],
            "%",
            (5, 5),
            higher_is_better=False,
            detail=f"{_steps(pairs[0][0])}, a viewer without window on the same machine",
        ),
        figure(
            "  processor time",
            [
                _percent(with_view.process.cpu_seconds, alone.process.cpu_seconds)
                for alone, with_view in pairs
            ],
            "%",
            higher_is_better=False,
            detail="including the loading of Rerun",
        ),
    ]


def _percent(with_view: float, alone: float) -> float:
    return 100 * (with_view / alone - 1)


def _steps(run: JobRun) -> str:
    return f"{run.steps / 1e6:.1f} M steps in {run.seconds:.1f} s alone"
