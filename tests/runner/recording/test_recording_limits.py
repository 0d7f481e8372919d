"""Long runs and full disks: memory does not grow; what was written on a full disk can be read."""

from __future__ import annotations

import contextlib
import errno
import gc
import json
import os
import resource
import subprocess
import sys
import weakref
from pathlib import Path

import pytest

from runner.config.model import Job
from runner.errors import StorageError
from runner.execution.session import run_job
from runner.recording import pipeline, schema
from runner.recording.layout import layout_of, lone_message
from runner.recording.reader import open_recording
from runner.recording.writer import RecordingFile
from runner.runs.resolve import find_run
from runner.runs.run import create_run
from runner.util.packing import Packing
from tests.runner.recording.making import LAKE, TAXIS, experiment, make_run
from tests.waiting import until

LONG_RUN = """
import resource, sys
from pathlib import Path
from runner.recording.reader import open_recording, schema
from tests.runner.recording.making import make_run

def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024

def record_and_read(episodes):
    run = make_run(
        Path(sys.argv[1]), episodes=episodes, algorithm="random", evaluation=None, log=None,
        env={"id": "FrozenLake-v1"}, recording={"level": -7},
    )
    with open_recording(run.recording) as recording:
        steps = sum(len(block) for block in recording.train.steps.blocks())
        messages = sum(1 for _, _ in zip(recording.train.steps.messages(), range(100_000)))
    assert steps == run.summary["train_steps"]
    return steps

record_and_read(60_000)
before = peak()
steps = record_and_read(600_000)
print(steps, peak() - before)
"""


def test_memory_does_not_grow_with_the_number_of_steps(tmp_path):
    """In a process of its own: a peak, once reached, hides what comes below it."""
    root = Path(__file__).parents[3]
    command = [sys.executable, "-c", LONG_RUN, str(tmp_path)]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    steps, growth = map(int, done.stdout.split())
    record_bytes = layout_of("job", 1, 0).dtype(schema.TRAIN_STEP).itemsize
    assert steps > 4_000_000
    assert growth < steps * record_bytes / 10, "a tenth of the steps would not fit in what it grew by"


@contextlib.contextmanager
def disk_of(size: int):
    """Limit the size of files: as with a full disk, writing stops in the middle of a record."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def run_on_small_disk(folder: Path, size: int, *parts, **values):
    """Return the run that a full disk ended, and the error."""
    config = experiment(*parts, **values)
    run = create_run(folder, config, 0)
    with disk_of(size), pytest.raises(StorageError) as caught:
        run_job(Job(config, 0), run)
    return find_run(run.run_id, folder), caught.value


def train_steps(path: Path) -> bytes:
    """Return the training steps of a recording, as bytes."""
    with open_recording(path) as recording:
        return b"".join(block.tobytes() for block in recording.train.steps.blocks())


LARGE = LAKE | {"episodes": 400, "recording": {"chunk_steps": 256, "compression": "none", "index": "chunk"}}
"""About 300 kB, most of it training steps."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Return the training steps of a run on a disk with enough space."""
    return train_steps(make_run(tmp_path_factory.mktemp("whole"), LARGE).recording)


@pytest.mark.parametrize("size", [80_000, 120_001, 177_777])
def test_a_full_disk_ends_the_run_and_keeps_what_was_written(size, whole, tmp_path):
    run, error = run_on_small_disk(tmp_path, size, LARGE)
    assert error.exit_code == 1
    assert str(run.recording) in str(error)
    assert "free some disk" in str(error)
    assert run.status == "failed"
    assert run.summary["error"] == str(error)
    assert run.recording.stat().st_size <= size
    kept = train_steps(run.recording)
    assert len(kept) > 10_000
    assert whole.startswith(kept)


@pytest.mark.parametrize("missing", [80, 200, 3_000])  # the clock varies in size
def test_a_disk_that_is_full_at_the_very_end_loses_only_the_index(missing, tmp_path):
    whole = make_run(tmp_path, LAKE)
    run, _ = run_on_small_disk(tmp_path, whole.recording.stat().st_size - missing, LAKE)
    assert run.status == "failed"
    assert train_steps(run.recording) == train_steps(whole.recording)


@pytest.mark.parametrize("size", [700, 2_600, 3_000, 5_000])
def test_no_space_even_to_describe_the_run(size, tmp_path):
    """700 bytes do not even hold its `run.json`."""
    run, error = run_on_small_disk(tmp_path, size, LAKE)
    assert error.exit_code == 1
    assert run.status == ("failed" if size > 1_500 else "running")
    assert [path.name for path in run.folder.iterdir() if path.name.startswith(".")] == []


@pytest.mark.skipif(os.name != "posix" or os.geteuid() != 0, reason="only root may mount a disk")
@pytest.mark.parametrize(("kilobytes", "threads"), [(80, True), (120, True), (200, True), (120, False)])
def test_a_full_file_system_ends_the_run(kilobytes, threads, whole, tmp_path):
    """When no block is left for the recording, none is left for run.json."""
    mount = ["mount", "-t", "tmpfs", "-o", f"size={kilobytes}k", "tmpfs", str(tmp_path)]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("mounting is not allowed here")
    try:
        config = experiment(LARGE)
        run = create_run(tmp_path, config, 0)
        with pytest.raises(StorageError, match="No space left"):
            run_job(Job(config, 0), run, threads=threads)
        kept = train_steps(run.recording)
        assert len(kept) > 10_000
        assert whole.startswith(kept)
    finally:
        subprocess.run(["umount", str(tmp_path)], check=True)


@pytest.mark.parametrize("threads", [True, False])
def test_a_failed_sync_ends_the_run(threads, tmp_path, monkeypatch):
    """Some disks report that they are full only at a sync."""

    def full(self):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(RecordingFile, "sync", full)
    monkeypatch.setattr(pipeline, "SYNC_SECONDS", 0)
    config = experiment(LAKE, episodes=10**6, evaluation=None)
    run = create_run(tmp_path, config, 0)
    episodes = []
    with pytest.raises(StorageError, match="No space left on device"):
        run_job(Job(config, 0), run, lambda progress: episodes.append(progress.episode), threads=threads)
    assert find_run(run.run_id, tmp_path).status == "failed"
    assert max(episodes, default=0) < 900_000, "it is reported soon, not at the end"


@pytest.mark.parametrize("threads", [True, False])
def test_an_error_while_packing_ends_the_run(threads, tmp_path, monkeypatch):
    def broken(*_):
        raise MemoryError("no memory")

    monkeypatch.setattr(pipeline, "encode_chunk", broken)
    config = experiment(TAXIS, episodes=10**6)
    run = create_run(tmp_path, config, 0)
    with pytest.raises(MemoryError):
        run_job(Job(config, 0), run, threads=threads)
    assert json.loads((run.folder / "run.json").read_text())["status"] == "failed"


def test_an_error_of_what_is_called_every_second_is_raised_where_messages_are_sent(monkeypatch):
    def broken():
        raise ValueError("no heartbeat")

    monkeypatch.setattr(pipeline, "_BEAT_SECONDS", 0.01)
    sender = pipeline.Pipeline(None, Packing(), broken)
    until(bool, lambda: sender.failure, seconds=10)
    for _ in range(2 * pipeline.MAX_PENDING):  # the thread still takes them
        sender.send(schema.LOG_TOPIC, *lone_message(schema.LOG_TOPIC, 0, b""))
    sender.close()
    with pytest.raises(ValueError, match="no heartbeat"):
        sender.raise_failure()


def test_a_recording_is_never_overwritten(tmp_path):
    config = experiment(LAKE)
    run = create_run(tmp_path, config, 0)
    run.recording.write_bytes(b"precious")
    with pytest.raises(StorageError, match="cannot be created"):
        run_job(Job(config, 0), run)
    assert run.recording.read_bytes() == b"precious"


def test_a_closed_recording_leaves_memory_at_once(tmp_path):
    run = make_run(tmp_path, LAKE)
    gc.disable()
    try:
        with open_recording(run.recording) as recording:
            assert recording.train.steps.total()
            seen = weakref.ref(recording)
        del recording
        assert seen() is None
    finally:
        gc.enable()
