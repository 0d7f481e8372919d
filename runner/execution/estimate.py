"""Estimate the steps and the disk space of a run before it has learned.

At most, every episode lasts until the step limit. A typical agent soon learns to reach the end: the typical
figure assumes half the limit for each evaluation trial and for the first 500 training episodes, and a tenth
of it for the others; for random actions half of it throughout. These are rules of thumb from the shipped
experiments, whose steps were between a sixth of the typical figure and all of it.
"""

from __future__ import annotations

import contextlib
import importlib
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from runner.config import ExperimentConfig
from runner.util.packing import CODECS

CLUMSY_EPISODES: Final = 500
CLUMSY: Final = 0.5
"""Typical length of an episode as a share of the step limit, at first and in trials."""
SKILLED: Final = 0.1
"""The same share for later episodes."""
LEAST: Final = 1 / 6
"""The steps of an agent that learns quickly, as a share of the typical figure."""
INDEX_BYTES: Final = 16
"""Bytes of the message index for a step."""
OTHER_BYTES: Final = 2
"""Bytes of everything else, spread over the steps."""


@dataclass(frozen=True)
class RunEstimate:
    """The estimated evaluations, snapshots, steps and bytes of one run."""

    evaluations: int
    snapshots: int
    typical_steps: int
    typical_bytes: int
    max_steps: int
    max_bytes: int


def estimate(config: ExperimentConfig, step_limit: int) -> RunEstimate:
    """Return the estimate of one seed of an experiment; `step_limit` of its environment must not be 0."""
    evaluations = 0
    trials = 0
    if config.evaluation is not None:
        evaluations = _occasions(config.episodes, config.evaluation.every)
        trials = evaluations * config.evaluation.trials
    snapshots = _occasions(config.episodes, config.snapshots.every or max(config.episodes, 1))
    learns = config.algorithm != "random"
    clumsy = min(config.episodes, CLUMSY_EPISODES) if learns else config.episodes
    typical = round(step_limit * (CLUMSY * (clumsy + trials) + SKILLED * (config.episodes - clumsy)))
    longest = step_limit * (config.episodes + trials)
    rate = bytes_per_step(config)
    return RunEstimate(evaluations, snapshots, typical, typical * rate, longest, longest * rate)


def _occasions(episodes: int, every: int) -> int:
    """Return how often something happens that is due at the start, every `every` episodes, and at the end."""
    return -(-episodes // every) + 1


def bytes_per_step(config: ExperimentConfig) -> int:
    """Return the typical number of bytes of a step in a recording."""
    plan = config.recording
    if plan.steps == "none":
        return OTHER_BYTES
    return (
        CODECS[plan.compression].bytes_per_step
        + (INDEX_BYTES if plan.index == "message" else 0)
        + OTHER_BYTES
    )


def step_limit(config: ExperimentConfig) -> int | None:
    """Return the step limit of the environment; 0 if it has none, None if the environment is unknown."""
    import gymnasium

    given = config.env.kwargs.get("max_episode_steps")
    if isinstance(given, int):
        return max(given, 0)
    module, _, name = config.env.id.rpartition(":")
    if module:
        with contextlib.suppress(ImportError):
            importlib.import_module(module)
    spec = gymnasium.registry.get(name)
    return (spec.max_episode_steps or 0) if spec else None


def free_bytes(folder: Path) -> int:
    """Return the free bytes on the disk of a folder, which need not exist."""
    existing = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    return shutil.disk_usage(existing).free
