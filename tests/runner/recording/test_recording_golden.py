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
from runner.config.job import Job
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
    "quick": "173332b641308c759f84f827eadcd5436723d3040d3150664d18d9ffff7f14f8",
    "tutorial_cooperative": "883f96a7481559fdc831c8bae091d6f2a586667e2e3ab51daedb2a399d79fcbc",
    "tutorial_competitive": "4c32436f6b150a7e9625619125d2354f35185bfc625142646a00ca6e97d8e6de",
}
"""Content digest by configuration, of seed 0; the tutorial's are shortened by SHORT."""


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="pinned for x86-64")
@pytest.mark.parametrize("name", GOLDEN)
def test_shipped_experiments_give_the_pinned_content(name, tmp_path):
    config = load(CONFIGS / f"{name}.yaml", () if name == "quick" else SHORT)
    run = run_job(Job(config, 0), create_run(tmp_path, config, 0))
    assert run.summary["content_digest"] == GOLDEN[name]
