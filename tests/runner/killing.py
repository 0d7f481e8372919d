"""Runs of a process of their own, killed by tests in their midst."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from runner.runs.run import list_runs
from tests.runner.recording.making import SMALL_MAP

REPOSITORY = Path(__file__).parents[2]
LONG = {
    "name": "long",
    "env": {"kwargs": {"map": SMALL_MAP, "max_episode_steps": 200}},
    "episodes": 5000,
    "epsilon": {"schedule": "linear", "start": 1.0, "end": 0.3, "over": 5000},
    "step_size": {"schedule": "exponential", "start": 0.5, "factor": 0.9999, "floor": 0.1},
    "evaluation": {"every": 2000, "trials": 300},
    "log": {"every_steps": 20_000},
    "snapshots": {"every": 3000},
}
"""Long enough to be killed in: a second, some 10 MB."""

posix = pytest.mark.skipif(sys.platform == "win32", reason="kills by signal")


def start(*words: object) -> subprocess.Popen[str]:
    """Start the command line in a process of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "runner", *map(str, words)],
        cwd=REPOSITORY,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def recorded_bytes(recordings: Path) -> int:
    """Return the size of the one run's recording; -1 before there is a run."""
    found = list_runs(recordings)
    if not found:
        return -1
    return found[0].recording.stat().st_size if found[0].recording.exists() else 0


def kill_when(process: subprocess.Popen[str], recordings: Path, size: int) -> None:
    """Kill a process, with no warning, when the recording has grown to a size."""
    deadline = time.monotonic() + 60
    while recorded_bytes(recordings) < size:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.002)
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL
