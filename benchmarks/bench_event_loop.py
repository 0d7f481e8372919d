"""How free the event loop of the service is while pages poll and jobs come and go, and with slow clients."""

from __future__ import annotations

import contextlib
import json
import socket
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import httpx2

from benchmarks.figures import Figure
from benchmarks.processes import run, run_command
from benchmarks.serving import Service, percentile, response_times, serving
from benchmarks.watched import VARIABLE

CLIENTS: Final = 20
POLL_SECONDS: Final = 0.25
"""Pause of a client between two requests; pages poll every 1.5 s."""
WORKERS: Final = 4
JOB: Final[dict[str, Any]] = {"env": {"id": "FrozenLake-v1"}, "episodes": 500, "evaluation": None}
UNREAD: Final = 400
TARGET: Final = (50, 20)
"""Targets in milliseconds: at least, and aim."""
DELAY: Final = (200, 100)


def measure(quick: bool) -> list[Figure]:
    """Return the longest callback, the lateness of a ticker, and the delay of a page, in milliseconds."""
    seconds = 5 if quick else 20
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        run(run_command("quick", str(folder / "runs"), "recording.compression=none", "episodes=3000"))
        watched = folder / "watched.json"
        with serving(
            folder / "runs",
            "--workers",
            str(WORKERS),
            module="benchmarks.watched",
            environment={VARIABLE: str(watched)},
        ) as service:
            (job,) = httpx2.get(f"{service.url}/api/v1/runs").json()["runs"]
            page = f"/runs/{job['run_id']}"
            response_times(service, [page, "/runs", "/queue"], clients=2, seconds=1)
            with submitting(service):
                time.sleep(2)
                begin = time.monotonic()
                paths = [page, "/runs", "/queue", "/queue/status", "/api/v1/jobs", "/api/v1/runs"]
                times = response_times(service, paths, CLIENTS, seconds, warm=0, pause=POLL_SECONDS)
                end = time.monotonic()
            delay = page_delay(service, page, job["run_id"], seconds / 4)
        seen = json.loads(watched.read_text())
    long, late = (
        [(1000 * (taken - waited), 1000 * taken) for at, taken, waited in seen[kind] if begin < at < end]
        for kind in ("callbacks", "ticks")
    )
    load = f"{CLIENTS} clients poll {len(times) / seconds:.0f} times a second, {WORKERS} jobs start and end"
    what = f"{load}; without the time that the thread waited for a processor"
    return [
        Figure(
            "longest callback of the event loop",
            max(long, default=(0.0, 0.0))[0],
            "ms",
            *TARGET,
            higher_is_better=False,
            detail=f"{what}: with it {max((whole for _, whole in long), default=0.0):.0f} ms",
        ),
        Figure(
            "lateness of a 10 ms ticker, 99th percentile",
            percentile([alone for alone, _ in late], 99),
            "ms",
            *TARGET,
            higher_is_better=False,
            detail=f"the same: with it {percentile([whole for _, whole in late], 99):.0f} ms",
        ),
        Figure("a page meanwhile, 99th percentile", 1000 * percentile(times, 99), "ms"),
        Figure(f"delay of a page by {UNREAD} clients that do not read", delay, "ms", *DELAY, False),
    ]


@contextlib.contextmanager
def submitting(service: Service) -> Iterator[None]:
    """Keep some small jobs in the queue, from another thread."""
    is_over = threading.Event()

    def submit() -> None:
        with httpx2.Client(
            base_url=f"{service.url}/api/v1", headers={"Origin": service.url}, timeout=60
        ) as client:
            seed = 0
            while not is_over.wait(0.1):
                queue = client.get("/jobs?limit=0").json()["queue"]
                for _ in range(2 * WORKERS - queue["queued"]):
                    seed += 1
                    client.post("/jobs", content=json.dumps(JOB | {"seed": seed})).raise_for_status()

    thread = threading.Thread(target=submit)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join()


def page_delay(service: Service, page: str, run_id: str, seconds: float) -> float:
    """Return by how much clients that request a recording and do not read it delay a page at most."""
    with httpx2.Client(base_url=service.url) as client:
        while client.get("/api/v1/jobs?limit=0").json()["queue"]["queued"]:
            time.sleep(0.5)
    usual = percentile(response_times(service, [page], 1, seconds), 50)
    request = f"GET /api/v1/runs/{run_id}/recording HTTP/1.1\r\nHost: {service.host}\r\n\r\n".encode()
    with contextlib.ExitStack() as unread:
        for _ in range(UNREAD):
            client = unread.enter_context(socket.create_connection((service.host, service.port)))
            client.sendall(request)
        times = response_times(service, [page], 1, seconds, warm=0)
    return 1000 * (max(times) - usual)
