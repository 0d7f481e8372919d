"""A sweep of many short runs: the whole study, what a run costs besides learning, one worker against two."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import psutil

from benchmarks.figures import Figure, figure, seconds
from runner.runs.run import list_runs
from runner.sweep import state
from runner.sweep.cluster import RayWorkers
from runner.sweep.loading import from_values
from runner.sweep.local import LocalWorkers
from runner.sweep.model import Sweep
from runner.sweep.trials import run_sweep

STUDY = 1000


def measure(quick: bool) -> list[Figure]:
    """Return seconds of the study, what a run costs besides its own time, and the gain of a second worker."""
    runs, few, repetitions = (40, 10, 1) if quick else (STUDY, 60, 3)
    pairs = [(_study(2 * few, 1), _study(2 * few, 2)) for _ in range(repetitions)]  # the first one compiles
    whole = _study(runs, 2)
    here = [_besides(few, LocalWorkers(1)) for _ in range(repetitions)]
    remote = [_besides(few, RayWorkers(1, None, few)) for _ in range(repetitions)]
    told = "the time of a study by one worker, less what its runs say that they took, over their number"
    return [
        figure(
            f"a study of {runs:,} runs, two workers",
            [whole.seconds],
            "s",
            None if quick else (90, 30),
            higher_is_better=False,
            detail=f"5,000 cooperative episodes each, no steps recorded; {runs / whole.seconds:.1f} runs/s",
        ),
        figure(
            "  ... of which a run takes of a processor",
            [1e3 * whole.processor_seconds / runs],
            "ms",
            higher_is_better=False,
        ),
        figure(
            "  two workers against one", [one.seconds / two.seconds for one, two in pairs], "x", (1.7, 1.9)
        ),
        figure("  a run besides its own time", here, "ms", (50, 10), higher_is_better=False, detail=told),
        figure("  ... on Ray", remote, "ms", (200, 100), higher_is_better=False),
        figure(
            "  memory of a worker, the most", whole.peak_megabytes, "MB", (400, 250), higher_is_better=False
        ),
    ]


def _sweep(runs: int) -> Sweep:
    return from_values(
        {
            "name": f"study{runs}",
            "base": {
                "episodes": 5000,
                "step_size": 1.0,
                "discount": 0.99,
                "epsilon": {"schedule": "linear", "start": 1.0, "end": 0.1, "over": 5000},
                "evaluation": {"every": 500, "trials": 50},
                "snapshots": {"every": None},
            },
            "strategy": "grid",
            "parameters": {"discount": [0.99]},
            "seeds": {"count": runs},
        }
    )


@dataclass(frozen=True)
class Study:
    """What a study took."""

    seconds: float
    processor_seconds: float
    """Of its workers and of the process that leads them: what other work on the machine changes little."""
    peak_megabytes: list[float]
    """The most memory that each worker had resident at once, in units of 10**6 bytes."""


def _study(runs: int, workers: int) -> Study:
    """Do a study by workers of this machine that are started, and have loaded what they need, before."""
    sweep, warm = _sweep(runs), _sweep(2 * workers)
    with tempfile.TemporaryDirectory() as folder, LocalWorkers(workers) as those:
        _begin(Path(folder), sweep, warm)
        run_sweep(warm, Path(folder), those)
        children = [child for child in psutil.Process().children() if "spawn_main" in str(child.cmdline())]
        before = _processor_seconds(children)
        elapsed = seconds(lambda: run_sweep(sweep, Path(folder), those))
        used = _processor_seconds(children) - before
        return Study(elapsed, used, [_peak_megabytes(child.pid) for child in children])


def _processor_seconds(children: list[psutil.Process]) -> float:
    times = [process.cpu_times() for process in (psutil.Process(), *children)]
    return sum(time.user + time.system for time in times)


def _besides(runs: int, workers: LocalWorkers | RayWorkers) -> float:
    """Return the milliseconds that a run takes besides its own time, on a worker that has loaded all."""
    sweep, warm = _sweep(runs), _sweep(2)
    with tempfile.TemporaryDirectory() as folder, workers:
        _begin(Path(folder), sweep, warm)
        run_sweep(warm, Path(folder), workers)
        elapsed = seconds(lambda: run_sweep(sweep, Path(folder), workers))
        made = [run for run in list_runs(Path(folder)) if run.name == sweep.name]
        return 1e3 * (elapsed - sum(run.summary["seconds"] for run in made)) / len(made)


def _begin(folder: Path, *sweeps: Sweep) -> None:
    for each in sweeps:
        state.begin(each, folder, resume=False, accept_changes=False)


def _peak_megabytes(pid: int) -> float:
    """Return the most memory that a process had resident at once, in units of 10**6 bytes."""
    status = Path(f"/proc/{pid}/status").read_text(encoding="utf-8")
    (line,) = (line for line in status.splitlines() if line.startswith("VmHWM:"))
    return int(line.split()[1]) * 1024 / 1e6
