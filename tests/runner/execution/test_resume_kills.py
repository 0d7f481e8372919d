"""Killed runs are resumed as if never killed; only one of two processes resumes a run."""

from __future__ import annotations

import json
import signal
import time

import pytest

from runner.config import from_mapping
from runner.config.model import Job
from runner.errors import RunnerError
from runner.execution import verify
from runner.execution.resume import resume
from runner.execution.session import run_job
from runner.recording.reader import open_recording
from runner.recording.schema import BLOCK_TOPICS
from runner.runs.resolve import find_run
from runner.runs.run import create_run, list_runs
from tests.runner.killing import LONG, kill_when, posix, start
from tests.runner.recording.making import make_run, stopping_after

MOSTLY_EVALUATION = LONG | {"episodes": 40, "evaluation": {"every": 20, "trials": 4000}}


@posix
@pytest.mark.parametrize(
    ("mode", "config", "sizes"),
    [
        pytest.param("cooperative", LONG, [0, 1_000_000, 3_000_000], id="at the start, in training"),
        pytest.param("competitive", LONG, [1_500_000, 3_500_000], id="in training, two learners"),
        pytest.param("competitive", MOSTLY_EVALUATION, [1_500_000], id="in an evaluation"),
    ],
)
def test_killed_again_and_again(tmp_path, mode, config, sizes):
    whole = make_run(tmp_path / "whole", config, mode=mode, seed=5)
    recordings = tmp_path / "killed"
    path = tmp_path / "experiment.yaml"
    path.write_text(json.dumps(config | {"mode": mode, "seed": 5}))  # JSON is YAML
    words: tuple[object, ...] = ("run", path)
    for size in sizes:
        kill_when(start(*words, "--recordings", recordings), recordings, size)
        (run,) = list_runs(recordings)
        assert run.status == "interrupted"
        words = ("resume", run.run_id)
    with open_recording(run.recording) as recording:
        assert not recording.file.finished
        for topic in BLOCK_TOPICS:
            assert recording.table(topic).count() == sum(
                len(block) for block in recording.table(topic).blocks()
            )
        assert recording.train.steps.count() + recording.eval.steps.count() > 0
    done = resume(run)
    assert done.status == find_run(run.run_id, recordings).status == "finished"
    assert done.summary["content_digest"] == whole.summary["content_digest"]
    assert done.summary["messages"] == whole.summary["messages"]
    assert verify.verify(done.recording).sound


@posix
def test_one_of_two_processes_may_resume(tmp_path):
    recordings = tmp_path / "runs"
    config = from_mapping(LONG | {"episodes": 10**8, "evaluation": None})
    run = run_job(Job(config, 0), create_run(recordings, config, 0), stop=stopping_after(3))
    process = start("resume", run.run_id, "--recordings", recordings)
    while find_run(run.run_id, recordings).status != "running":
        assert process.poll() is None, process.communicate()
        time.sleep(0.005)
    with pytest.raises(RunnerError, match="is locked by another process"):
        resume(run)
    second = start("resume", run.run_id, "--recordings", recordings)
    _, errors = second.communicate(timeout=60)
    assert second.returncode == 2
    assert "another process" in errors
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Interrupted again" in errors
    assert find_run(run.run_id, recordings).status == "interrupted"
