"""The clock: how much time had passed after how many steps, of jobs and loops, also of resumed ones."""

from __future__ import annotations

import itertools
import time
from types import SimpleNamespace

import numpy as np
import pytest

import runner
from runner.config.model import Job
from runner.errors import RecordingError
from runner.execution.resume import resume
from runner.execution.session import run_job
from runner.execution.verify import verify
from runner.recording import machine as clocks
from runner.recording import schema
from runner.recording.machine import Clock, read_clock
from runner.recording.messages import encode
from runner.recording.reader import open_recording
from runner.runs.run import create_run
from tests.runner.altering import altered
from tests.runner.loops.making import make, play
from tests.runner.recording.making import TAXIS, experiment, make_run, stopping_after


def clock_of(run) -> Clock:
    with open_recording(run.recording) as recording:
        found = read_clock(recording)
    assert found is not None
    return found


@pytest.fixture
def ticking(monkeypatch):
    """Make every look at the clock take a tenth of a second, so that samples are due often."""
    seconds = (k / 10 for k in itertools.count())
    monkeypatch.setattr(clocks, "time", SimpleNamespace(monotonic=lambda: next(seconds), time=time.time))


def test_a_job_begins_at_zero_and_ends_with_its_last_step(tmp_path):
    run = make_run(tmp_path, TAXIS)
    clock = clock_of(run)
    steps = run.summary["train_steps"] + run.summary["eval_steps"]
    assert (clock.positions[0], clock.positions[-1]) == (0, steps)
    assert clock.seconds[0] < 1
    assert 0 < clock.duration <= run.summary["seconds"]
    assert clock.steps_a_second == pytest.approx(steps / clock.duration)


def test_a_loop_begins_at_zero_and_ends_with_its_last_step(tmp_path):
    with runner.record(make("CartPole-v1"), tmp_path) as env:
        for _ in play(env, 300):
            pass
    clock = clock_of(env.run)
    assert (clock.positions[0], clock.positions[-1]) == (0, 300)
    assert 0 < clock.duration <= env.run.summary["seconds"]


def test_samples_come_about_once_a_second_and_later_less_often(ticking):
    watch = clocks.Stopwatch()
    assert watch.seconds == 0
    assert watch.begin()
    assert not watch.begin()
    due = [watch.is_due() for _ in range(200)]
    assert 0 < sum(due) < 50
    for _ in range(72_000):  # two hours
        watch.is_due()
    assert sum(watch.is_due() for _ in range(200)) < sum(due)


def test_a_resumed_run_has_no_time_of_its_pause(tmp_path):
    config = experiment(TAXIS)
    run = run_job(Job(config, 0), create_run(tmp_path, config, 0), stop=stopping_after(9))
    before = clock_of(run)
    done = resume(run)
    clock = clock_of(done)
    n = len(before.positions)
    assert clock.seconds[:n].tolist() == before.seconds.tolist()
    assert len(set(clock.started)) == 2
    assert clock.positions[n] >= clock.positions[n - 1]
    assert clock.seconds[n] - clock.seconds[n - 1] < 0.1, "the second session begins where the first ended"
    assert clock.positions[-1] == done.summary["train_steps"] + done.summary["eval_steps"]
    assert verify(done.recording).sound
    whole = make_run(tmp_path, TAXIS)
    assert done.summary["content_digest"] == whole.summary["content_digest"]
    assert done.summary["messages"] == whole.summary["messages"]


def test_seconds_at_any_step_are_interpolated():
    clock = Clock(
        np.array([0, 10, 10, 30]), np.array([0.0, 1.0, 5.0, 7.0]), np.array([100.0, 100.0, 100.0, 100.0])
    )
    found = clock.seconds_at(np.array([0, 5, 10, 11, 20, 30, 99]))
    assert found.tolist() == pytest.approx([0.0, 0.5, 1.0, 5.1, 6.0, 7.0, 7.0])
    assert (np.diff(clock.seconds_at(np.arange(40))) >= 0).all()


def test_a_recording_of_an_earlier_version_has_none(tmp_path):
    run = make_run(tmp_path, TAXIS)
    with open_recording(
        altered(run.recording, tmp_path / "none.mcap", schema.CLOCK_TOPIC, lambda _: [])
    ) as recording:
        assert read_clock(recording) is None


@pytest.mark.parametrize(
    ("seconds", "message"),
    [([0.0, np.inf], "inf seconds"), ([0.0, -1.0], "-1.0 seconds"), ([5.0, 1.0], "goes back")],
)
def test_an_impossible_clock_is_refused(tmp_path, seconds, message):
    run = make_run(tmp_path, TAXIS)
    samples = [(0, encode(schema.CLOCK, {"started": 1.0, "seconds": value})) for value in seconds]
    path = altered(run.recording, tmp_path / "forged.mcap", schema.CLOCK_TOPIC, lambda _: samples)
    with open_recording(path) as recording, pytest.raises(RecordingError, match=message):
        read_clock(recording)
