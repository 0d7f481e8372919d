"""Loops that are not closed: forked children, uncaught exceptions."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
import threading
import time

import pytest

from runner.loops.loop import Flusher, open_loops
from runner.recording.integrity import check_integrity
from runner.recording.reader import open_recording
from runner.runs.run import list_runs

FORKED = """
import os, sys, warnings
import numpy as np
import gymnasium, runner
{setup}
rec.reset(seed=1)
rec.step({action})
child = os.fork()
if not child:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(40_000 // {n}):
            _, _, terminated, truncated, _ = rec.step({action})
            if np.any(terminated | truncated):
                rec.reset()
        rec.log("x", 1.0)
        rec.snapshot("q", [1.0])
    with rec.phase("eval"):
        rec.reset(seed=1)
        rec.step({action})
    own = runner.record(gymnasium.make("FrozenLake-v1"), sys.argv[1], name="child")
    own.reset(seed=1)
    own.step(0)
    own.close()
    print(len(caught), caught[0].message if caught else "", flush=True)
    rec.close()
    sys.exit(0)
_, status = os.waitpid(child, 0)
rec.step({action})
rec.close()
print("child", status, rec.run.summary["train_steps"])
"""
SINGLE = 'rec = runner.record(gymnasium.make("CartPole-v1"), sys.argv[1], name="parent")'
VECTOR = 'rec = runner.record_vector(gymnasium.make_vec("CartPole-v1", 2), sys.argv[1], name="parent")'


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork on this system")
@pytest.mark.parametrize(
    ("setup", "action", "n"), [(SINGLE, "0", 1), (VECTOR, "np.zeros(2, int)", 2)], ids=["single", "vector"]
)
def test_a_forked_child_steps_unrecorded_with_one_warning(tmp_path, setup, action, n):
    script = FORKED.format(setup=setup, action=action, n=n)
    ended = subprocess.run(
        [sys.executable, "-c", script, str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    child, parent = ended.stdout.splitlines()
    assert child.startswith("1 run ")
    assert "is recorded by the process that this one was forked from" in child
    assert parent == f"child 0 {2 * n}"
    runs = {run.name: run for run in list_runs(tmp_path)}
    assert {name: run.status for name, run in runs.items()} == {"parent": "finished", "child": "finished"}
    for run in runs.values():
        check_integrity(run.recording)


BUSY = """
import os, sys, threading, warnings
import gymnasium, runner
rec = runner.record(gymnasium.make("CartPole-v1"), sys.argv[1], chunk_steps=256)
rec.reset(seed=1)
over = threading.Event()
def play():
    while not over.is_set():
        if any(rec.step(0)[2:4]):
            rec.reset()
thread = threading.Thread(target=play)
thread.start()
for _ in range(30):
    child = os.fork()
    if not child:
        warnings.simplefilter("ignore")
        rec.step(0)  # no reset: the environment's generator has a lock of its own
        os._exit(0)
    os.waitpid(child, 0)
over.set()
thread.join()
rec.close()
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork on this system")
def test_a_child_that_is_forked_while_another_thread_records_does_not_hang(tmp_path):
    """The other thread may hold the recording's lock at the moment of the fork."""
    subprocess.run([sys.executable, "-c", BUSY, str(tmp_path)], timeout=120, check=True)
    (run,) = list_runs(tmp_path)
    check_integrity(run.recording)


UNCAUGHT = """
import sys, gymnasium, runner
def main():
    env = runner.record(gymnasium.make("CartPole-v1"), sys.argv[1])
    env.reset(seed=0)
    env.step(0)
    {end}
main()
"""


@pytest.mark.parametrize(
    ("end", "status", "text"),
    [
        ("1 / 0", "failed", "ZeroDivisionError: division by zero"),
        ("raise KeyboardInterrupt", "interrupted", None),
        ("sys.exit(0)", "interrupted", None),
        ("pass", "interrupted", None),
    ],
)
def test_an_uncaught_exception_is_the_error_of_the_run(tmp_path, end, status, text):
    script = textwrap.dedent(UNCAUGHT.format(end=end))
    subprocess.run(
        [sys.executable, "-c", script, str(tmp_path)], timeout=60, check=False, capture_output=True
    )
    (run,) = list_runs(tmp_path)
    assert (run.status, run.summary.get("error")) == (status, text)
    with open_recording(run.recording) as recording:
        assert len(list(recording.train.transitions())) == 1
    check_integrity(run.recording)


class Idle:
    """A loop that needs no flush."""

    closed = is_foreign = False
    started = 0.0

    def flush(self) -> bool:
        return False


def test_loops_can_be_listed_while_others_begin(monkeypatch):
    """Another thread adds a loop in the middle of the list."""
    interval = sys.getswitchinterval()
    flusher = Flusher()
    monkeypatch.setattr("runner.loops.loop.FLUSHER", flusher)
    kept, is_over = [], threading.Event()

    def begin_loops():
        while not is_over.is_set():
            kept.append(Idle())
            flusher.add(kept[-1])
            del kept[:-1000]

    thread = threading.Thread(target=begin_loops)
    sys.setswitchinterval(1e-6)
    thread.start()
    try:
        end = time.monotonic() + 0.5
        while time.monotonic() < end:
            open_loops()
    finally:
        sys.setswitchinterval(interval)
        is_over.set()
        thread.join()
