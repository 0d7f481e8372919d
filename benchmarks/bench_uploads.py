"""Uploads to the service over loopback: speed, compared with a plain copy, and memory of the server.

Each repetition uploads the same bytes and copies the file; neither is synced. The verification that follows,
and syncs what it stores, is reported separately. To measure memory, a large recording is uploaded, verified
and downloaded while processes record and push loops; every digest is compared at the end.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import psutil
from blake3 import blake3

from benchmarks.figures import Figure, figure, seconds
from benchmarks.processes import run, run_command
from benchmarks.serving import Service, serving
from runner.client.client import Client, append_upload, put_upload
from runner.execution.verify import verify
from runner.runs.resolve import find_run
from runner.runs.run import Run

LOOP = """
import sys, gymnasium, runner
with runner.record(gymnasium.make("Taxi-v4"), sys.argv[1], name="loop", seed=int(sys.argv[2])) as rec:
    rec.action_space.seed(int(sys.argv[2]))
    rec.reset(seed=int(sys.argv[2]))
    for _ in range(int(sys.argv[3])):
        _, _, terminated, truncated, _ = rec.step(rec.action_space.sample())
        if terminated or truncated:
            rec.reset()
print(rec.run.run_id, rec.run.summary["content_digest"])
"""
PROCESSES = 20


def measure(quick: bool) -> list[Figure]:
    """Return the speed of an upload, and the server's memory under load."""
    megabytes, repetitions, steps = (100, 2, 20_000) if quick else (1000, 3, 50_000)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        recording = _large_recording(folder / "mine", megabytes)
        with serving(folder / "theirs") as service:
            figures = _speed(recording, folder, service.url, repetitions)
            return [*figures, *_memory(recording, folder, service, steps)]


def _large_recording(folder: Path, megabytes: int) -> Run:
    """Return a run of this size: uncompressed, with random steps."""
    sets = ["recording.compression=none", f"episodes={megabytes * 13}", "epsilon=1"]
    sets += ["evaluation.every=1000000", "snapshots.every=1000000"]
    run(run_command("quick", str(folder), *sets))
    return find_run("@latest", folder)


def _speed(source: Run, folder: Path, url: str, repetitions: int) -> list[Figure]:
    size, uploaded, copied = source.recording.stat().st_size, [], []
    digest, begin = _digest(source.recording), 0.0
    with Client(url) as client:
        for number in range(repetitions):
            copied.append(size / seconds(lambda: _copy(source.recording, folder / "copy")) / 1e6)
            (folder / "copy").unlink()
            begin = time.perf_counter()
            last = number == repetitions - 1
            known = {"digest": digest if last else "0" * 64, "size": size}
            sent = put_upload(client, secrets.token_hex(32), **known)
            while sent.offset < size:
                sent = append_upload(client, sent, source.recording, size)
            uploaded.append(size / (time.perf_counter() - begin) / 1e6)
            begin = time.perf_counter()
            while sent.state == "verifying":
                time.sleep(0.05)
                sent = put_upload(client, sent.id, **known)
        assert sent.state == "stored", sent.problem
    checked = size / (time.perf_counter() - begin) / 1e6
    return [
        figure(
            f"upload until the last byte is received, {size / 1e6:,.0f} MB",
            uploaded,
            "MB/s",
            (100, 300),
            detail="one client, on loopback; all but the last are then refused, for a wrong digest",
        ),
        figure("  a plain copy", copied, "MB/s"),
        figure("  its verification, by another process", [checked], "MB/s"),
    ]


def _copy(source: Path, target: Path) -> None:
    with source.open("rb") as reading, target.open("xb") as writing:
        shutil.copyfileobj(reading, writing, 1 << 20)


def _digest(path: Path) -> str:
    return blake3().update_mmap(path).hexdigest()


def _memory(source: Run, folder: Path, service: Service, steps: int) -> list[Figure]:
    """Return the server's memory under load, and check that nothing was lost."""
    shutil.rmtree(folder / "theirs" / source.run_id)
    own, children, over = [], [], threading.Event()
    server = psutil.Process(service.process)

    def watch() -> None:
        while not over.wait(0.1):
            own.append(server.memory_info().rss / 1e6)
            with contextlib.suppress(psutil.NoSuchProcess):
                children.append(sum(child.memory_info().rss for child in server.children(True)) / 1e6)

    watcher = threading.Thread(target=watch)
    watcher.start()
    begin = time.perf_counter()
    pushed = _load(source, folder, service.url, steps)
    took = time.perf_counter() - begin
    over.set()
    watcher.join()
    for run_id, digest in pushed:
        stored = find_run(run_id, folder / "theirs")
        assert verify(stored.recording).content_digest == digest == stored.summary["content_digest"], run_id
    early, late = max(own[: len(own) // 2]), max(own[len(own) // 2 :])
    return [
        figure(
            f"server's memory, {PROCESSES} processes pushing",
            [max(own)],
            "MB",
            (400, 250),
            higher_is_better=False,
            detail=f"with {(source.summary.bytes or 0) / 1e6:,.0f} MB uploaded and downloaded; {took:.0f} s; "
            f"at most {early:.0f} MB in the first half and {late:.0f} MB in the second; "
            f"its child processes at most {max(children):.0f} MB",
        ),
        figure("  runs recorded and pushed, digests equal", [len(pushed)], f"of {PROCESSES}"),
    ]


def _load(source: Run, folder: Path, url: str, steps: int) -> list[tuple[str, str]]:
    """Record and push in many processes, upload and download a large recording; return the digests."""
    with contextlib.ExitStack() as stack:
        environment = os.environ | {"XDG_STATE_HOME": str(folder / "state")}
        loops = [
            stack.enter_context(
                subprocess.Popen(
                    [sys.executable, "-c", LOOP, url, str(seed), str(steps)],
                    stdout=subprocess.PIPE,
                    text=True,
                    env=environment,
                )
            )
            for seed in range(PROCESSES)
        ]
        with Client(url, retry_timeout=600) as client:
            client.push(source)
            pulled = client.pull(source.run_id, folder / "back")
        assert pulled.content_digest == source.summary.content_digest
        outputs = [loop.communicate()[0].split() for loop in loops]
    assert not list((folder / "state").rglob("recording.mcap")), "a run was left in the outbox"
    return [(run_id, digest) for run_id, digest in outputs]
