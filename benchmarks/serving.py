"""A service in a separate process, concurrent clients, and its memory."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import psutil

_CLIENTS: Final = """
import asyncio, json, sys, time

async def client(host, port, paths, number, until, taken):
    reader, writer = await asyncio.open_connection(host, port)
    k = number
    while time.perf_counter() < until:
        path = paths[k % len(paths)]
        k += int(sys.argv[6])
        began = time.perf_counter()
        writer.write(f"GET {path} HTTP/1.1\\r\\nHost: {host}:{port}\\r\\n\\r\\n".encode())
        head = await reader.readuntil(b"\\r\\n\\r\\n")
        length = int(head.lower().partition(b"content-length:")[2].partition(b"\\r\\n")[0] or 0)
        await reader.readexactly(length)
        if not head.startswith((b"HTTP/1.1 200", b"HTTP/1.1 204")):
            raise SystemExit(f"{path}: {head.decode()}")
        taken.append(time.perf_counter() - began)
        await asyncio.sleep(float(sys.argv[7]))
    writer.close()

async def main():
    host, port, seconds, paths = sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), json.loads(sys.argv[4])
    count = int(sys.argv[6])
    for _ in range(2):  # once to warm up
        taken = []
        until = time.perf_counter() + (seconds if _ else min(seconds, float(sys.argv[5])))
        await asyncio.gather(*(client(host, port, paths, n, until, taken) for n in range(count)))
    print(json.dumps(taken))

asyncio.run(main())
"""


@dataclass(frozen=True)
class Service:
    """A running service."""

    host: str
    port: int
    process: int
    """Process id."""

    @property
    def url(self) -> str:
        """The address of its first page."""
        return f"http://{self.host}:{self.port}"


@contextlib.contextmanager
def serving(
    recordings: Path, *words: str, environment: Mapping[str, str] | None = None, module: str = "runner"
) -> Iterator[Service]:
    """Run `dualtaxi serve` over a folder on a free port, until the block is left."""
    line = [sys.executable, "-m", module, "serve", "--port", "0", "--recordings", str(recordings)]
    process = subprocess.Popen(
        [*line, "--log", os.devnull, *words],
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | dict(environment or {}),
    )
    try:
        assert process.stdout is not None
        url = process.stdout.readline().strip()
        host, _, port = url.removeprefix("http://").rstrip("/").rpartition(":")
        yield Service(host, int(port), process.pid)
    finally:
        process.terminate()
        process.wait(60)


def response_times(
    service: Service,
    paths: Sequence[str],
    clients: int = 20,
    seconds: float = 5,
    warm: float = 1,
    pause: float = 0,
) -> list[float]:
    """Return the response times, in seconds, of concurrent clients that each send one request after another.

    The clients are in a separate process; each cycles through the paths, starting at a different one.

    Args:
        service: the service.
        paths: the paths to request.
        clients: the number of clients, each with its own connection.
        seconds: duration of the measurement.
        warm: duration of the warm-up before it.
        pause: how long a client waits before its next request.
    """
    line = [service.host, str(service.port), str(seconds), json.dumps(list(paths)), str(warm), str(clients)]
    line.append(str(pause))
    done = subprocess.run(
        [sys.executable, "-I", "-S", "-c", _CLIENTS, *line], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(done.stderr)
    times: list[float] = json.loads(done.stdout)
    return times


def percentile(values: Sequence[float], percent: float) -> float:
    """Return a percentile of the values."""
    return sorted(values)[min(int(len(values) * percent / 100), len(values) - 1)]


def memory_of(process: int) -> float:
    """Return the memory of a process and its children in MB, with shared pages counted once."""
    whole = psutil.Process(process)
    total = 0
    for part in (whole, *whole.children(recursive=True)):
        with contextlib.suppress(psutil.Error):
            total += part.memory_full_info().pss
    return total / 1e6
