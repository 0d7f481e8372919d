"""Run commands in separate processes and measure them.

A small launcher starts each command: on Linux a process inherits the peak memory of its parent, which
therefore must be smaller than the measured process. The launcher measures the time of the command alone.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

ROOT: Final = Path(__file__).resolve().parent.parent

_LAUNCHER: Final = """
import json, os, sys, time
begin = time.perf_counter()
child = os.posix_spawnp(sys.argv[1], sys.argv[1:], os.environ)
_, status, usage = os.wait4(child, 0)
elapsed = time.perf_counter() - begin
unit = 1 if sys.platform == "darwin" else 1024
print(json.dumps([elapsed, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * unit]))
code = os.waitstatus_to_exitcode(status)
sys.exit(code if code >= 0 else 128 - code)
"""


@dataclass(frozen=True)
class Process:
    """Time and memory of a finished process."""

    seconds: float
    """Elapsed time."""
    cpu_seconds: float
    """User and system time of all threads."""
    peak_megabytes: float
    """Peak resident memory in units of 10**6 bytes."""


@dataclass(frozen=True)
class JobRun:
    """A job run by the command line, and its recording."""

    process: Process
    seconds: float
    """From the creation of its folder to its end, as stored in `run.json`."""
    steps: int
    """Recorded training and evaluation steps."""
    file_bytes: int
    """Size of the recording."""


def run(command: Sequence[str], environment: Mapping[str, str] | None = None, exit_code: int = 0) -> Process:
    """Run a command and return its time and memory.

    Raises:
        RuntimeError: it ended with another exit code; the message has its output.
    """
    inherited = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    done = subprocess.run(
        [sys.executable, "-I", "-S", "-c", _LAUNCHER, *command],
        cwd=ROOT,
        env=inherited | dict(environment or {}),
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != exit_code:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stdout}{done.stderr}")
    elapsed, cpu, peak = json.loads(done.stdout.splitlines()[-1])
    return Process(elapsed, cpu, peak / 1e6)


def run_config(
    config: str,
    *overrides: str,
    environment: Mapping[str, str] | None = None,
) -> JobRun:
    """Run a shipped configuration in a temporary folder and return the measurements."""
    with tempfile.TemporaryDirectory() as recordings:
        process = run(run_command(config, recordings, *overrides), environment)
        (facts_file,) = Path(recordings).glob("*/run.json")
        facts: dict[str, Any] = json.loads(facts_file.read_bytes())
        summary = facts["summary"]
        size = (facts_file.parent / "recording.mcap").stat().st_size
        return JobRun(process, summary["seconds"], summary["train_steps"] + summary["eval_steps"], size)


def dualtaxi(recordings: str, *words: str, exit_code: int = 0) -> Process:
    """Run a command of the program over a folder of runs, and return its time and memory."""
    return run([sys.executable, "-m", "runner", *words, "--recordings", recordings], exit_code=exit_code)


def run_command(config: str, recordings: str, *overrides: str) -> list[str]:
    """Return the command that runs a shipped configuration."""
    sets = [part for override in overrides for part in ("--set", override)]
    begin = [sys.executable, "-m", "runner", "run", f"configs/{config}.yaml"]
    return [*begin, "--recordings", recordings, "--json", *sets]
