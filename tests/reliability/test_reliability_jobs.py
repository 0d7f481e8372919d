"""A server, its workers or both killed at random moments, three times; `tests.reliability.jobs` does more."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[2]


@pytest.mark.skipif(sys.platform == "win32", reason="kills by signal")
def test_no_job_is_lost_repeated_or_stands_still():
    command = [sys.executable, "-m", "tests.reliability.jobs", "--kills", "3", "--seed", "4"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=280)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "none failed" in done.stdout
