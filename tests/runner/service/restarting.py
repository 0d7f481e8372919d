"""A service as a process of its own, which can be killed."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path


class Server:
    """`dualtaxi serve` over a folder, always at the same port."""

    def __init__(self, recordings: Path, *options: str) -> None:
        self.recordings, self.options = recordings, options
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        self.url = f"http://127.0.0.1:{self.port}"
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start it, and wait until it listens."""
        command = [sys.executable, "-m", "runner", "serve", "--port", str(self.port)]
        command += ["--recordings", str(self.recordings), *self.options]
        with (self.recordings.parent / "server.log").open("ab") as log:
            self.process = subprocess.Popen(command, stdout=log, stderr=log, env=os.environ)
        for _ in range(600):
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", self.port), 1):
                return
            assert self.process.poll() is None, (self.recordings.parent / "server.log").read_text()
            time.sleep(0.05)
        raise AssertionError("the server does not listen")

    def end(self, how: int = signal.SIGTERM) -> None:
        """End it, if it runs."""
        if self.process is not None:
            self.process.send_signal(how)
            self.process.wait(30)
            self.process = None
