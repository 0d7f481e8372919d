"""Runs killed at random moments, twelve of them; `make soak` kills two hundred."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[2]


@pytest.mark.skipif(sys.platform == "win32", reason="kills by signal")
def test_a_killed_run_is_read_repaired_resumed_and_ends_as_if_nothing_had_happened():
    """In a process of its own, which forks: nothing else may run in it."""
    command = [sys.executable, "-W", "error", "-m", "tests.reliability.soak", "--kills", "12", "--seed", "3"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=240)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "none failed" in done.stdout
    assert "in the middle" in done.stdout
