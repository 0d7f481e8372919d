"""Finished loops are synced to disk by threads, and lose nothing before that when their process is killed."""

import errno
import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import gymnasium
import pytest

import runner
from runner.recording import writer
from runner.runs.run import run_at

RECORD = """
import os, signal, sys, time
from pathlib import Path
import gymnasium
import runner
from runner.recording import writer

def record():
    env = runner.record(gymnasium.make("CartPole-v1"), sys.argv[1])
    env.reset(seed=0)
    env.step(0)
    return env
"""


def script(folder: Path, text: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", RECORD + textwrap.dedent(text), str(folder)],
        capture_output=True,
        text=True,
        check=False,
    )


def test_a_process_killed_after_close_loses_nothing(tmp_path: Path) -> None:
    done = script(
        tmp_path,
        """
        writer.sync = lambda path: time.sleep(3600)
        for _ in range(3):
            record().close()
        os.kill(os.getpid(), signal.SIGKILL)
        """,
    )
    assert done.returncode == -signal.SIGKILL, done.stderr
    runs = runner.list_runs(tmp_path)
    assert [run.status for run in runs] == ["finished"] * 3
    for run in runs:
        found = runner.verify(run.recording)
        assert found.sound
        assert found.content_digest


def test_the_interpreter_ends_when_all_is_on_disk(tmp_path: Path) -> None:
    done = script(
        tmp_path,
        """
        writer.sync = lambda path: os.write(1, f"{path.parent.name}\\n".encode())
        closed = [record() for _ in range(20)]
        for env in closed:
            env.close()
        abandoned = record()
        """,
    )
    assert done.returncode == 0, done.stderr
    assert sorted(done.stdout.split()) == sorted(path.name for path in tmp_path.iterdir() if path.is_dir())
    assert len(done.stdout.split()) == 21


def test_a_forked_worker_ends_when_its_loops_are_on_disk(tmp_path: Path) -> None:
    done = script(
        tmp_path,
        """
        import multiprocessing
        writer.sync = lambda path: os.write(1, f"{path.parent.name}\\n".encode())
        worker = multiprocessing.get_context("fork").Process(target=lambda: record().close())
        worker.start()
        worker.join()
        """,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == [path.name for path in tmp_path.iterdir() if path.is_dir()]


def test_a_recording_that_does_not_reach_the_disk_is_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(path: Path) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))

    monkeypatch.setattr(writer, "sync", fail)
    env = runner.record(gymnasium.make("CartPole-v1"), tmp_path)
    env.close()
    writer.SYNCER.sync()
    run = run_at(env.run.folder)
    assert run.status == "failed"
    assert "could not be written to disk (Input/output error)" in run.facts["summary"]["error"]
    assert run.run_id in capsys.readouterr().err


def test_a_run_that_was_removed_is_no_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    env = runner.record(gymnasium.make("CartPole-v1"), tmp_path)
    env.close()
    env.run.recording.unlink()
    writer.SYNCER.sync()
    assert run_at(env.run.folder).status == "finished"
    assert not capsys.readouterr().err
