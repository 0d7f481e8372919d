"""Runs of several processes, killed and damaged, six of them; `tests.reliability.shards` does 200."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[2]


@pytest.mark.skipif(sys.platform == "win32", reason="kills by signal")
def test_no_whole_step_is_lost_or_its_loss_hidden():
    """In a process of its own, which forks: nothing else may run in it."""
    command = [sys.executable, "-m", "tests.reliability.shards", "--rounds", "6", "--seed", "2"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=240)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "none failed" in done.stdout
