"""Runs to compare, recorded once for a module."""

from __future__ import annotations

from pathlib import Path

import pytest

from runner.config import from_mapping
from runner.config.model import Job
from runner.execution.session import run_job
from runner.runs import run as runs

BASE = {
    "name": "base",
    "mode": "competitive",
    "exploration": "shared",
    "episodes": 120,
    "discount": 0.8,
    "epsilon": 0.6,
    "evaluation": {"every": 60, "trials": 10},
    "snapshots": {"every": 60},
    "quirks": {"second_table_uses_first_action": True},
    "recording": {"chunk_steps": 1024},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("recordings")


@pytest.fixture(scope="module")
def record(folder):
    """Record the base run with some other values, once for each."""
    known: dict[str, Path] = {}

    def recorded(*overrides: str) -> Path:
        key = " ".join(overrides)
        if key not in known:
            config = from_mapping(BASE, overrides)
            run = runs.create_run(folder, config, config.seeds[0])
            known[key] = run_job(Job(config, config.seeds[0]), run).recording
        return known[key]

    return recorded
