"""What a training uses of its machine, next to its steps."""

from __future__ import annotations

import os
import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

import runner
from runner.errors import RecordingError
from runner.execution.verify import verify
from runner.recording import machine, observer, schema
from runner.recording.console import read_console
from runner.recording.machine import HostMetrics, HostSampler, read_clock, read_host
from runner.recording.messages import encode
from runner.recording.reader import open_recording
from tests.runner.altering import altered
from tests.runner.loops.making import make, play
from tests.runner.recording.making import TAXIS, make_run
from tests.waiting import until


@pytest.fixture
def often(monkeypatch):
    """Watch fifty times a second."""
    monkeypatch.setattr(observer, "SAMPLE_SECONDS", 0.02)
    monkeypatch.setattr(machine, "SAMPLE_SECONDS", 0.02)


def samples_in(run):
    with open_recording(run.recording) as recording:
        return len(list(recording.table(schema.HOST_TOPIC).messages()))


def test_a_loop_has_what_its_process_and_its_host_used(tmp_path, often):
    with runner.record(make("CartPole-v1"), tmp_path) as env:
        for _ in play(env, 100):
            pass
        until(lambda n: n > 3, lambda: samples_in(env.run))
    with open_recording(env.run.recording) as recording:
        host = read_host(recording, read_clock(recording))
    assert host is not None
    assert host.positions[-1] == 100
    assert (np.diff(host.seconds) >= 0).all()
    values = host.values
    assert (values["memory_bytes"] > 10 << 20).all()
    assert (values["host_memory_total"] > values["host_memory_bytes"]).all()
    assert (values["disk_free_bytes"] > 0).all()
    assert ((values["host_cpu_percent"] >= 0) & (values["host_cpu_percent"] <= 100)).all()
    assert host.values["gpu_percent"].shape == (len(host.positions), host.gpus)
    assert verify(env.run.recording).sound


def test_two_loops_of_a_process_have_the_same_samples(tmp_path, often):
    with (
        runner.record(make("CartPole-v1"), tmp_path) as one,
        runner.record(make("Taxi-v4"), tmp_path) as other,
    ):
        until(lambda n: n > 3, lambda: min(samples_in(one.run), samples_in(other.run)))
        names = [thread.name for thread in threading.enumerate()]
        assert names.count("recording-observer") == 1
    memory = []
    for run in (one.run, other.run):
        with open_recording(run.recording) as recording:
            host = read_host(recording, None)
            assert host is not None
            memory.append(set(host.values["disk_written_bytes"]))
    assert memory[0] & memory[1]
    assert "recording-observer" not in [thread.name for thread in threading.enumerate()]


def test_neither_is_recorded_where_it_is_off(tmp_path, often):
    write = vars(sys.stdout).get("write")
    with runner.record(make("CartPole-v1"), tmp_path, system=False, console=False) as env:
        assert vars(sys.stdout).get("write") is write
        print("nothing")
        time.sleep(0.6)
        assert "recording-observer" not in [thread.name for thread in threading.enumerate()]
    with open_recording(env.run.recording) as recording:
        assert read_host(recording, None) is None
        assert read_console(recording, None) == []
        assert read_clock(recording) is not None


def test_a_child_process_counts_with_its_parent():
    sampler = HostSampler()
    own = sampler.sample()["memory_bytes"]
    pid = os.fork()
    if pid == 0:
        time.sleep(60)
        os._exit(0)
    try:
        sampler._looked = -np.inf  # it looks for children every ten seconds only
        assert sampler.sample()["memory_bytes"] > 1.2 * own
    finally:
        os.kill(pid, 9)
        os.waitpid(pid, 0)


def test_gpus_are_measured_by_their_library(monkeypatch):
    library = SimpleNamespace(
        nvmlInit=lambda: None,
        nvmlDeviceGetCount=lambda: 2,
        nvmlDeviceGetHandleByIndex=lambda k: k,
        nvmlDeviceGetMemoryInfo=lambda k: SimpleNamespace(used=k * 100, total=1000),
        nvmlDeviceGetUtilizationRates=lambda k: SimpleNamespace(gpu=50 + k),
    )
    monkeypatch.setitem(sys.modules, "pynvml", library)
    found = HostSampler().sample()
    assert (found["gpu_percent"], found["gpu_memory_bytes"]) == ([50.0, 51.0], [0.0, 100.0])
    assert found["gpu_memory_total"] == [1000.0, 1000.0]


@pytest.mark.parametrize("library", [None, SimpleNamespace(nvmlInit=lambda: 1 / 0)])
def test_without_a_gpu_or_its_library_there_are_none(monkeypatch, library):
    monkeypatch.setitem(sys.modules, "pynvml", library)
    assert HostSampler().sample()["gpu_percent"] == []


def test_rates_begin_again_with_each_session():
    sent = np.array([100.0, 300.0, 0.0, 50.0])
    host = HostMetrics(
        np.arange(4),
        np.array([1.0, 2.0, 3.0, 3.5]),
        {"network_sent_bytes": sent},
        np.array([1.0, 1.0, 9.0, 9.0]),
    )
    np.testing.assert_equal(host.rate("network_sent_bytes"), [np.nan, 200.0, np.nan, 100.0])


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"gpu_percent": [1.0]}, "values of GPUs"),
        ({name: [1.0] * 65 for name in ("gpu_percent", "gpu_memory_bytes", "gpu_memory_total")}, "GPUs"),
        ({"seconds": float("nan")}, "not finite"),
    ],
)
def test_impossible_samples_are_refused(tmp_path, fields, message):
    run = make_run(tmp_path, TAXIS)
    path = altered(
        run.recording,
        tmp_path / "forged.mcap",
        schema.HOST_TOPIC,
        lambda _: [(0, encode(schema.HOST, fields))],
    )
    with open_recording(path) as recording, pytest.raises(RecordingError, match=message):
        read_host(recording, None)
