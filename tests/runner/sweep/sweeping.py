"""A small sweep, and workers that run in this process."""

from __future__ import annotations

from pathlib import Path

from runner.sweep import state
from runner.sweep.running import run_sweep

BASE = {
    "env": {"id": "FrozenLake-v1", "kwargs": {"is_slippery": False}},
    "episodes": 60,
    "evaluation": {"every": 20, "trials": 5},
    "snapshots": {"every": None},
    "epsilon": 0.3,
}


def described(**changes):
    """Return the contents of a sweep file, with changes."""
    return {
        "name": "small",
        "base": BASE,
        "strategy": "tpe",
        "trials": 6,
        "batch": 2,
        "parameters": {"step_size": {"low": 0.1, "high": 1.0}, "discount": [0.5, 0.9]},
        "seeds": [0, 1],
        "objective": {"metric": "training.mean_reward", "at": "last"},
    } | changes


class Here:
    """Does each task at once; stops after `most` tasks, and behaves as if workers had died at `dying`."""

    def __init__(self, most=10**9, dying=()):
        self.done, self.most, self.dying, self.answers, self.given = 0, most, set(dying), [], []

    @property
    def idle(self):
        return 1 - len(self.answers)

    def submit(self, task):
        self.given.append(task)
        self.done += 1
        died = self.done in self.dying
        self.answers.append((task, None if died else task.run(lambda: self.done > self.most)))

    def collect(self, seconds):
        answers, self.answers = self.answers, []
        return answers

    def stop(self):
        pass


def swept(folder: Path, sweep, workers=None, **options):
    """Run a sweep and return its trials and status."""
    state.begin(sweep, folder, resume=True, accept_changes=False)
    return run_sweep(sweep, folder, workers or Here(), **options)


def digests(trials):
    """Return the values, states and run digests of trials, for comparison."""
    return [
        (t.values, t.state, t.value, {seed: t.results[seed].digest for seed in sorted(t.results)})
        for t in trials.done
    ]
