"""The content of shipped experiments, pinned on x86-64: neither learning nor the format has changed.

A digest here changes if, and only if, learning or the format changes. If that is intended, enter the digest
that the failing test found, and note it in CHANGELOG.md: older recordings cannot be resumed or verified any
more. If it is not, the twin's tests (tests/runner/learning) show whether learning changed.
"""

from __future__ import annotations

import platform
from pathlib import Path

import pytest

from runner.config import load
from runner.config.model import Job
from runner.execution.session import run_job
from runner.runs.run import create_run

CONFIGS = Path(__file__).parents[3] / "configs"
SHORT = (
    "episodes=40",
    "evaluation.every=20",
    "evaluation.trials=4",
    "log.every_steps=5000",
    "snapshots.every=20",
)
GOLDEN = {
    "quick": "312018be0c83505c4f198df8de3abbf9862b1e4b70eab6c67de11191e47ea1d2",
    "tutorial_cooperative": "84351b27ae9b50a6f8a977491f74932ee442d5afcd7fa13475166f5a1f504f2f",
    "tutorial_competitive": "a534ec5203d1c198e894b841db3f21a3831f5b41a06fd8ea688032fd6eccc2f0",
}
"""Content digest by configuration, of seed 0; the tutorial's are shortened by SHORT."""


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="pinned for x86-64")
@pytest.mark.parametrize("name", GOLDEN)
def test_shipped_experiments_give_the_pinned_content(name, tmp_path):
    config = load(CONFIGS / f"{name}.yaml", () if name == "quick" else SHORT)
    run = run_job(Job(config, 0), create_run(tmp_path, config, 0))
    assert run.summary["content_digest"] == GOLDEN[name]
