"""Runs that a signal ended are interrupted: everything up to their end is compared, in real processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest

from runner.execution.verify import verify
from runner.recording.reader import open_recording
from runner.runs.run import list_runs
from tests.runner.killing import posix
from tests.runner.loops.making import dualtaxi

SCRIPT = """
import multiprocessing
import os
import signal
import sys
import time

import gymnasium
import numpy as np

import runner

def pole(**options):
    return runner.record(gymnasium.make("CartPole-v1"), "recordings", **options)

def play(env, steps=float("inf"), seed=0):
    env.reset(seed=seed)
    parent, step = os.getppid(), 0
    while step < steps and parent == os.getppid():
        step += 1
        if any(env.step(step % 2)[2:4]):
            env.reset()
        time.sleep(0.0002)

def vectors():
    return gymnasium.make_vec("CartPole-v1", 3, vectorization_mode="sync")

def vector():
    envs = runner.record_vector(vectors(), "recordings")
    envs.reset(seed=0)
    while True:
        envs.step(np.zeros(3, np.int64))
        time.sleep(0.0005)

def batches():
    envs = vectors()
    rec = runner.record_batches(envs, "recordings", autoreset_mode="NextStep")
    last, _ = envs.reset(seed=0)
    while True:
        rows = [(last, *envs.step(np.ones(3, np.int64))) for _ in range(8)]
        last = rows[-1][1]
        observations = np.stack([rows[0][0], *(row[1] for row in rows)])
        rewards, terminated, truncated = (np.stack([row[k] for row in rows]) for k in (2, 3, 4))
        rec.batch(observations, np.ones((8, 3), np.int64), rewards, terminated, truncated)
        time.sleep(0.002)

def join():
    play(runner.record(gymnasium.make("CartPole-v1"), join=True), seed=9)

def joined():
    env = pole()
    multiprocessing.get_context("spawn").Process(target=join, daemon=True).start()
    play(env)

def handled():
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(7))
    play(pole())

def forked():
    env = pole()
    play(env, 50)
    child = os.fork()
    if child == 0:
        time.sleep(60)
    os.kill(child, signal.SIGTERM)
    _, status = os.waitpid(child, 0)
    play(env, 50)
    env.close()
    sys.exit(os.waitstatus_to_exitcode(status) == -signal.SIGTERM and 5)

def job():
    runner.run("tutorial_cooperative", recordings="recordings")

if __name__ == "__main__":
    globals()[sys.argv[1]]()
"""


def start(kind, folder):
    """Start a script that records until it is ended."""
    (folder / "script.py").write_text(SCRIPT)
    return subprocess.Popen([sys.executable, "script.py", kind], cwd=folder, stderr=subprocess.PIPE)


def end(process, kind, folder, number):
    """Send a signal when something was recorded, by all processes; return the run and the exit code."""
    deadline = time.monotonic() + 100
    pattern = "*/shards/*/recording.mcap" if kind == "joined" else "*/recording.mcap"
    size = 500_000 if kind == "job" else 30_000  # a job's description is larger
    while not any(path.stat().st_size > size for path in (folder / "recordings").glob(pattern)):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.send_signal(number)
    process.communicate()
    (run,) = list_runs(folder / "recordings")
    return run, process.returncode


@posix
@pytest.mark.parametrize("kind", ["handled", "joined", "vector"])
def test_sigterm_ends_a_recording_properly(kind, tmp_path):
    run, code = end(start(kind, tmp_path), kind, tmp_path, signal.SIGTERM)
    assert code == (7 if kind == "handled" else -signal.SIGTERM)
    found = verify(run.recording)
    assert (run.status, found.verdict, found.finding) == ("interrupted", "interrupted", "")
    with open_recording(run.recording) as recording:
        assert "content_digest" in recording.result
        assert found.steps > 0.8 * recording.train.steps.total()  # a vector's resets take a step each
        assert (found.left_out, found.cut_off) == (0, 0)
        assert found.content_digest == recording.result.content_digest


@posix
@pytest.mark.parametrize("kind", ["vector", "joined"])
def test_a_loop_that_was_killed_is_rerun_up_to_its_end(kind, tmp_path):
    run, code = end(start(kind, tmp_path), kind, tmp_path, signal.SIGKILL)
    assert code == -signal.SIGKILL
    if kind == "joined":  # its processes end with their parent
        deadline = time.monotonic() + 60
        while '"running"' in dualtaxi(tmp_path / "recordings", "show", run.run_id, "--json").stdout:
            assert time.monotonic() < deadline
            time.sleep(0.1)
    found = verify(run.recording)
    assert (found.verdict, found.act, found.finding, found.reason) == ("interrupted", "rerun", "", "")
    assert found.steps > 0.8 * found.train_steps  # a vector's resets take a step each
    done = dualtaxi(tmp_path / "recordings", "verify", run.run_id)
    assert done.exit_code == 0
    assert f"{found.steps:,} steps, every byte" in done.output


@posix
def test_batches_that_were_killed_are_checked_up_to_their_end(tmp_path):
    run, _ = end(start("batches", tmp_path), "batches", tmp_path, signal.SIGKILL)
    found = verify(run.recording)
    assert (found.verdict, found.act, found.finding) == ("interrupted", "checked", "")
    assert found.train_steps > 0
    assert "No reset had a seed" in found.reason
    done = dualtaxi(tmp_path / "recordings", "verify", run.run_id)
    assert done.exit_code == 0
    assert "interrupted: only the file was checked, which agrees with itself" in done.output


@posix
def test_a_job_that_was_killed_is_retrained_up_to_its_end(tmp_path):
    run, code = end(start("job", tmp_path), "job", tmp_path, signal.SIGKILL)
    assert code == -signal.SIGKILL
    found = verify(run.recording)
    assert (found.verdict, found.act, found.finding) == ("interrupted", "retrained", "")
    assert found.steps == found.train_steps + found.eval_steps > 0
    done = dualtaxi(tmp_path / "recordings", "verify", run.run_id)
    assert done.exit_code == 0
    assert f"{found.steps:,} steps with evaluations, every byte" in done.output
    assert f"resume {run.run_id}" in done.output


@posix
def test_a_signal_for_a_forked_process_does_not_close_the_recording_of_its_parent(tmp_path):
    process = start("forked", tmp_path)
    _, error = process.communicate()
    assert process.returncode == 5, error
    (run,) = list_runs(tmp_path / "recordings")
    assert (run.status, verify(run.recording).steps) == ("finished", 100)


def test_a_finished_run_whose_file_was_cut_is_damaged(run, tmp_path):
    import shutil

    folder = tmp_path / run.run_id
    shutil.copytree(run.folder, folder)
    os.truncate(folder / "recording.mcap", run.recording.stat().st_size // 2)
    assert verify(folder / "recording.mcap").verdict == "damaged"
    (folder / "run.json").unlink()
    assert verify(folder / "recording.mcap").verdict == "interrupted"
