"""A sweep of many short runs: the whole study, what a run costs besides learning, one worker against two."""

from __future__ import annotations

import statistics
import tempfile
import time
from pathlib import Path

from benchmarks.figures import Figure, figure, seconds
from runner.execution import Session, recorder_for
from runner.job import Job
from runner.learning.learner import Learner
from runner.mdp import load_mdp
from runner.sweep import state
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
    whole = _study(runs, 2)
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


def _study(runs: int, workers: int) -> float:
    """Return the seconds of a study whose workers are started, and have loaded what they need, before."""
    sweep, warm = _sweep(runs), _sweep(2 * workers)
    with tempfile.TemporaryDirectory() as folder, LocalWorkers(workers) as those:
        for each in (warm, sweep):
            state.begin(each, Path(folder), resume=False, accept_changes=False)
        run_sweep(warm, Path(folder), those)
        return seconds(lambda: run_sweep(sweep, Path(folder), those))


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
