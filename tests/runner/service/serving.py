"""A service in a process of its own, as `dualtaxi serve` is."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

SECONDS = 30


@dataclass
class Served:
    """A service that runs."""

    process: subprocess.Popen[str]
    url: str
    log: Path

    @property
    def port(self) -> int:
        return int(self.url.rstrip("/").rpartition(":")[2])

    @property
    def origin(self) -> dict[str, str]:
        return {"Origin": self.url.rstrip("/")}

    def stop(self, how: int = signal.SIGTERM) -> int:
        """Tell it to stop, and return its exit code."""
        self.process.send_signal(how)
        return self.process.wait(SECONDS)


@contextlib.contextmanager
def serving(recordings: Path, *words: str, environment: Mapping[str, str] | None = None) -> Iterator[Served]:
    """Run a service on a free port until the block is left."""
    log = recordings.parent / "service.log"
    line = [sys.executable, "-m", "runner", "serve", "--port", "0", "--recordings", str(recordings)]
    process = subprocess.Popen(
        [*line, "--log", str(log), *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | (environment or {}),
    )
    try:
        yield Served(process, process.stdout.readline().strip(), log)
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate()
