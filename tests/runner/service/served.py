"""A real server process, to be asked, stopped and killed."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx2
import psutil


class Served:
    """A server of a recordings folder that can be killed and started again."""

    def __init__(self, recordings: Path, *options: str) -> None:
        self.recordings, self.options = recordings, options
        self.log = recordings.with_name(f"{recordings.name}.log")
        self.start()

    def start(self, port: str = "0") -> None:
        """Start it, and wait until it can be asked."""
        words = ["-m", "runner", "serve", "--port", port, "--recordings", str(self.recordings), *self.options]
        # Its log goes to a file: a pipe that nobody empties would stop it after 64 KiB.
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                [sys.executable, *words], stdout=subprocess.PIPE, stderr=log, text=True
            )
        assert self.process.stdout is not None
        self.url = self.process.stdout.readline().strip()
        assert self.url, self.log.read_text()
        self.client = httpx2.Client(
            base_url=f"{self.url}api/v1", headers={"Origin": self.url.rstrip("/")}, timeout=60
        )

    def workers(self) -> list[psutil.Process]:
        """Return the processes that it has started, and theirs."""
        return psutil.Process(self.process.pid).children(recursive=True)

    def kill(self, with_workers: bool = False) -> list[psutil.Process]:
        """End it without warning, its workers too if that is asked for; return those that it had."""
        workers = self.workers()
        os.kill(self.process.pid, signal.SIGKILL)
        for worker in workers if with_workers else ():
            with contextlib.suppress(psutil.NoSuchProcess):
                worker.kill()
        self._forget()
        return workers

    def stop(self) -> int:
        """Have it end properly; return its exit code."""
        self.process.terminate()
        code = self.process.wait(60)
        self._forget()
        return code

    def _forget(self) -> None:
        self.process.wait(60)
        self.client.close()
        if self.process.stdout is not None:
            self.process.stdout.close()

    def get(self, path: str) -> Any:
        """Return what is at a path."""
        return self.client.get(path).raise_for_status().json()

    def post(self, path: str, text: str = "") -> Any:
        """Return the answer to a text that is sent to a path."""
        return self.client.post(path, content=text.encode()).raise_for_status().json()

    def until(self, is_so: Any, seconds: float = 90) -> dict[int, dict[str, Any]]:
        """Wait until the jobs, by number, are so; return them."""
        deadline = time.monotonic() + seconds
        while not is_so(jobs := {job["number"]: job for job in self.get("/jobs")["jobs"]}):
            assert time.monotonic() < deadline, json.dumps(jobs, indent=1)
            time.sleep(0.05)
        return jobs


@contextlib.contextmanager
def served(recordings: Path, *options: str) -> Iterator[Served]:
    """Give a server; it is ended at the end."""
    server = Served(recordings, *options)
    try:
        yield server
    finally:
        if server.process.poll() is None:
            server.stop()
