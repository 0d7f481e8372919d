"""A sweep of many short runs: the whole study, what a run costs besides learning, one worker against two."""

from __future__ import annotations

import multiprocessing
import statistics
import tempfile
import time
from pathlib import Path

from benchmarks.figures import Figure, figure, seconds
from runner.execution import Session, recorder_for
from runner.job import Job
from runner.learning.learner import Learner
from runner.mdp import load_mdp
from runner.runs import list_runs
from runner.sweep import state
from runner.sweep.cluster import RayWorkers
from runner.sweep.loading import from_values
from runner.sweep.local import LocalWorkers
from runner.sweep.model import Sweep
from runner.sweep.task import Task, do
from runner.sweep.trials import Trials, run_sweep

STUDY = 1000


def measure(quick: bool) -> list[Figure]:
    """Return seconds of the study, milliseconds a run besides learning, and the gain of a second worker."""
    runs = 40 if quick else STUDY
    overheads, own = _overheads(10 if quick else 40)
    pairs = [
        (_study(20 if quick else 100, 1), _study(20 if quick else 100, 2)) for _ in range(1 if quick else 3)
    ]
    memory: list[float] = []
    whole = _study(runs, 2, memory)
    remote = [_on_ray(10 if quick else 40) for _ in range(1 if quick else 3)]
    return [
        figure(
            f"a study of {runs:,} runs, two workers",
            [whole],
            "s",
            None if quick else (90, 30),
            higher_is_better=False,
            detail=f"5,000 cooperative episodes each, no steps recorded; {runs / whole:.1f} runs/s",
        ),
        figure(
            "  a run besides learning",
            overheads,
            "ms",
            (50, 10),
            higher_is_better=False,
            detail="processor time of the task in a warm worker, less that of learning, evaluating and\n"
            f"hashing in it: {own:.0f} ms",
        ),
        figure("  two workers against one", [one / two for one, two in pairs], "x", (1.7, 1.9)),
        figure("  memory of a worker, the most", memory, "MB", (400, 250), higher_is_better=False),
        figure(
            "  a run on Ray besides its own time, one worker",
            remote,
            "ms",
            (200, 100),
            higher_is_better=False,
            detail="the time of a study on Ray, less what its runs say that they took, over their number",
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


def _study(runs: int, workers: int, memory: list[float] | None = None) -> float:
    """Return the seconds of a study whose workers are started, and have loaded what they need, before.

    Args:
        runs: how many.
        workers: processes of this machine.
        memory: takes in the megabytes that each worker had at most.
    """
    sweep, warm = _sweep(runs), _sweep(2 * workers)
    with tempfile.TemporaryDirectory() as folder, LocalWorkers(workers) as those:
        _begin(Path(folder), sweep, warm)
        run_sweep(warm, Path(folder), those)
        elapsed = seconds(lambda: run_sweep(sweep, Path(folder), those))
        if memory is not None:
            workers_of_ours = [p for p in multiprocessing.active_children() if p.name == "sweep-worker"]
            memory += [_peak_megabytes(process.pid) for process in workers_of_ours]
        return elapsed


def _on_ray(runs: int) -> float:
    """Return the milliseconds that a run on Ray takes besides its own time, on one worker."""
    sweep, warm = _sweep(runs), _sweep(2)
    with tempfile.TemporaryDirectory() as folder, RayWorkers(1, None, runs) as those:
        _begin(Path(folder), sweep, warm)
        run_sweep(warm, Path(folder), those)
        elapsed = seconds(lambda: run_sweep(sweep, Path(folder), those))
        made = [run for run in list_runs(Path(folder)) if run.name == sweep.name]
        return 1e3 * (elapsed - sum(run.summary["seconds"] for run in made)) / len(made)


def _begin(folder: Path, *sweeps: Sweep) -> None:
    for each in sweeps:
        state.begin(each, folder, resume=False, accept_changes=False)


def _peak_megabytes(pid: int | None) -> float:
    """Return the most memory that a process had resident at once, in units of 10**6 bytes."""
    status = Path(f"/proc/{pid}/status").read_text(encoding="utf-8")
    (line,) = (line for line in status.splitlines() if line.startswith("VmHWM:"))
    return int(line.split()[1]) * 1024 / 1e6


def _overheads(repetitions: int) -> tuple[list[float], float]:
    """Return milliseconds of processor time a run besides its own, and its own."""
    sweep = _sweep(repetitions)
    (trial,) = Trials(sweep).ask()
    config = sweep.config(trial.values)
    mdp = load_mdp(config.env.id, config.env.kwargs, config.rewards)
    own, whole = [], []
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(-1, repetitions):
            job = Job(config, max(seed, 0))
            task = Task(
                identity=trial.identities[job.seed],
                seed=job.seed,
                config=trial.config,
                name=sweep.name,
                tags=(),
                recordings=folder,
                objective=sweep.objective,
            )
            begin = time.process_time()
            do(task, lambda: False)
            between = time.process_time()
            learner = Learner(config, mdp, job.seed)
            session = Session(job, learner, recorder_for(job, learner, None))
            session.run()
            session.recorder.drain()
            if seed >= 0:  # the first one loads and compiles
                whole.append(1e3 * (between - begin))
                own.append(1e3 * (time.process_time() - between))
    return [a - b for a, b in zip(whole, own, strict=True)], statistics.median(own)
