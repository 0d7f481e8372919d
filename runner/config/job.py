"""A job: a configuration with one seed. Equal jobs give equal content."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass

from blake3 import blake3

from runner.config import ExperimentConfig
from runner.util.values import Json, JsonView

NOT_CONTENT = ("name", "seeds", "recording")
"""Keys of a configuration that change neither what is learned nor what is recorded."""


@dataclass(frozen=True)
class Job:
    """One seed of an experiment."""

    config: ExperimentConfig
    seed: int

    def content(self) -> Json:
        """Return the values that determine the content of the job's recording."""
        return _content(self.config.to_mapping(), self.seed)

    @property
    def identity(self) -> str:
        """A hash of `content()`, which does not depend on the name."""
        return identity_of(self.config.to_mapping(), self.seed)


def identity_of(config: JsonView, seed: int) -> str:
    """Return the identity of the job of a resolved configuration, given as plain values, and a seed."""
    text = json.dumps(_content(config, seed), sort_keys=True, separators=(",", ":"))
    return blake3(text.encode()).hexdigest()[:32]


def _content(config: JsonView, seed: int) -> Json:
    return {key: value for key, value in config.items() if key not in NOT_CONTENT} | {"seed": seed}


def jobs_of(config: ExperimentConfig) -> Iterator[Job]:
    """Yield the jobs of an experiment, one per seed."""
    for seed in config.seeds:
        yield Job(config, seed)
