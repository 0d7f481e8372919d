"""A sweep of many short runs: the whole study, the overhead per run, one worker against two."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import psutil

from benchmarks.figures import Figure, figure, seconds
from runner.runs.run import list_runs
from runner.sweep import state
from runner.sweep.model import Sweep, from_values
from runner.sweep.running import run_sweep
from runner.sweep.workers import LocalWorkers, RayWorkers

STUDY = 1000


def measure(quick: bool) -> list[Figure]:
    """Return the time of the study, the overhead per run, and the speed-up of a second worker."""
    runs, few, repetitions = (40, 10, 1) if quick else (STUDY, 60, 3)
    pairs = [(_study(2 * few, 1), _study(2 * few, 2)) for _ in range(repetitions)]  # the first one compiles
    whole = _study(runs, 2)
    here = [_besides(few, LocalWorkers(1)) for _ in range(repetitions)]
    remote = [_besides(few, RayWorkers(1, None, few)) for _ in range(repetitions)]
    detail = "(time of a study with one worker - recorded times of its runs) / number of runs"
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
        figure("  overhead per run", here, "ms", (50, 10), higher_is_better=False, detail=detail),
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
    """Time and memory of a study."""

    seconds: float
    processor_seconds: float
    """Processor time of the workers and the main process, which other processes hardly disturb."""
    peak_megabytes: list[float]
    """Peak resident memory of each worker, in units of 10**6 bytes."""


def _study(runs: int, workers: int) -> Study:
    """Run a study with local workers that have been started and have loaded their modules before."""
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
    """Return the overhead per run in milliseconds, on a worker that has loaded its modules."""
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
    """Return the peak resident memory of a process, in units of 10**6 bytes."""
    status = Path(f"/proc/{pid}/status").read_text(encoding="utf-8")
    (line,) = (line for line in status.splitlines() if line.startswith("VmHWM:"))
    return int(line.split()[1]) * 1024 / 1e6
