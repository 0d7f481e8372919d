"""Runs for tests: small, quick, with every kind of message."""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runner.config import ExperimentConfig, from_mapping
from runner.config.model import Job
from runner.execution.session import run_job
from runner.recording.reader import open_recording
from runner.recording.rewriting import rewrite
from runner.runs.run import Run, create_run

SMALL_MAP = ["+---+", "|A: |", "| |B|", "+---+"]
TAXIS: dict[str, Any] = {
    "name": "taxis",
    "mode": "competitive",
    "env": {"kwargs": {"map": SMALL_MAP, "max_episode_steps": 90}},
    "episodes": 60,
    "epsilon": 0.4,
    "step_size": 0.3,
    "evaluation": {"every": 20, "trials": 3, "exact": True},
    "log": {"every_steps": 500, "window": 200},
    "snapshots": {"every": 30},
}
"""Two learners, a dozen events; about 3,000 training and 700 evaluation steps."""
LAKE: dict[str, Any] = {
    "name": "lake",
    "env": {"id": "FrozenLake-v1", "kwargs": {"max_episode_steps": 20}},
    "episodes": 12,
    "epsilon": 1.0,
    "evaluation": {"every": 6, "trials": 2, "exact": True},
    "log": {"every_steps": 30},
    "snapshots": {"every": 6},
}
"""One learner, no events; the smallest recording that has every topic."""


SAMPLED: dict[str, Any] = {"evaluation": {"every": 20, "trials": 3}}
"""Evaluations without exact measures."""


def experiment(*parts: dict[str, Any], **values: Any) -> ExperimentConfig:
    """Return the experiment of merged parts; later ones take precedence."""
    merged: dict[str, Any] = {}
    for part in (*parts, values):
        merged |= part
    return from_mapping(merged)


def stopping_after(times: int) -> Callable[[], bool]:
    """Return a function that returns True from call number `times` on."""
    calls = itertools.count()
    return lambda: next(calls) >= times


def with_id(run_id: str, source: Path, target: Path) -> Path:
    """Copy a recording, with another run id and no other change, and return the copy's path."""
    rewrite(source, target, lambda name, entries: entries | {"run_id": run_id} if name == "run" else entries)
    return target


def make_run(folder: Path, *parts: dict[str, Any], seed: int = 0, **values: Any) -> Run:
    """Return a finished run of an experiment."""
    config = experiment(*parts, **values)
    return run_job(Job(config, seed), create_run(folder, config, seed))


def copy_of(run: Run, folder: Path, status: str = "interrupted", **facts: object) -> Run:
    """Return a copy of a run in a recordings folder, with another status."""
    shutil.copytree(run.folder, folder / run.run_id)
    return Run(folder / run.run_id, run.facts).update(status=status, **facts)


def training(run: Run, start: int = 0, stop: int | None = None) -> NDArray[np.void]:
    """Return recorded training steps of a run."""
    with open_recording(run.recording) as recording:
        blocks = recording.train.steps.blocks(start, stop)
        return np.concatenate([np.empty(0, recording.train.steps.row_dtype), *blocks])


def middle_of(run: Run, share: float = 0.5) -> int:
    """Return a training step of a run, within an episode."""
    steps = training(run)
    return int(next(step["step"] for step in steps[int(len(steps) * share) :] if step["t"] > 2))
