"""Runs taken up again: their steps recorded later, their tables played in new episodes."""

from __future__ import annotations

import numpy as np
import pytest

from runner.config.model import Job
from runner.errors import Diverged, RecordingError, RunnerError
from runner.execution import rerecord as again
from runner.execution.rerecord import evaluate, rerecord
from runner.execution.session import run_job
from runner.execution.verify import verify
from runner.recording import schema
from runner.recording.reader import open_recording
from runner.replay.tables import tables_at
from runner.runs.resolve import find_run
from runner.runs.run import RUN_FILE, create_run, list_runs
from runner.util.files import write_object
from tests.runner.recording.making import TAXIS, experiment, make_run


@pytest.fixture
def measured(tmp_path):
    """A finished run without steps."""
    return make_run(tmp_path, TAXIS, recording={"steps": "none"})


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The same with steps, not to be changed."""
    return make_run(tmp_path_factory.mktemp("whole"), TAXIS)


def test_the_steps_recorded_later_are_those_that_were(measured, whole):
    size = measured.recording.stat().st_size
    with open_recording(measured.recording) as recording:
        before = [list(recording.table(topic).messages()) for topic in schema.MACHINE_TOPICS]
    done = rerecord(measured)
    assert done.recording == measured.recording
    assert done.recording.stat().st_size > 2 * size
    assert done.summary["content_digest"] == measured.summary["content_digest"]
    assert done.summary["content_digest"] == whole.summary["content_digest"]
    assert done.facts["config"]["recording"]["steps"] == "all"
    assert find_run(str(done.folder), done.folder).facts == done.facts
    with open_recording(done.recording) as later, open_recording(whole.recording) as at_once:
        for topic in schema.BLOCK_TOPICS:
            left, right = (one.table(topic).array() for one in (later, at_once))
            assert left.tobytes() == right.tobytes()
        assert later.file.metadata("rerecord")["dualtaxi"]
        circumstances = [list(later.table(topic).messages()) for topic in schema.MACHINE_TOPICS]
        assert circumstances == before, "the time that the training took"
        assert later.provenance == at_once.provenance
    assert verify(done.recording).sound
    assert rerecord(done).facts == done.facts  # nothing to do


def test_other_content_is_refused(measured, monkeypatch):
    before = measured.recording.read_bytes()
    load = again.load_mdp
    monkeypatch.setattr(
        again, "load_mdp", lambda env_id, kwargs, rewards: load(env_id, dict(kwargs) | {"slip": 0.5}, rewards)
    )
    with pytest.raises(Diverged, match="content digest"):
        rerecord(measured)
    assert measured.recording.read_bytes() == before
    assert not list(measured.folder.glob("*.rerecording"))


def test_stopped_it_is_as_it_was(measured):
    before = measured.recording.read_bytes()
    with pytest.raises(KeyboardInterrupt):
        rerecord(measured, stop=lambda: True)
    assert measured.recording.read_bytes() == before
    assert not list(measured.folder.glob("*.rerecording"))


def test_an_unfinished_run_is_finished_first(tmp_path):
    config = experiment(TAXIS, recording={"steps": "none"})
    run = run_job(Job(config, 0), create_run(tmp_path, config, 0), stop=lambda: True)
    with pytest.raises(RunnerError, match="`dualtaxi resume"):
        rerecord(run)
    facts = {key: value for key, value in run.facts.items() if key != "config"}
    write_object(run.folder / RUN_FILE, facts | {"status": "interrupted"})
    with pytest.raises(RunnerError):
        rerecord(find_run(run.run_id, tmp_path))


def test_the_last_table_plays_as_the_last_evaluation_did(whole, tmp_path):
    """In the same states it acts the same: only the draws of the start differ with the seed."""
    done = evaluate(whole, tmp_path, trials=30, seed=7)
    assert done.name == "taxis.evaluated"
    assert done.status == "finished"
    assert done.facts["config"]["initial_q"] == {
        "run": str(whole.recording.resolve()),
        "step": whole.summary["train_steps"],
    }
    with open_recording(done.recording) as recording, open_recording(whole.recording) as origin:
        assert recording.train.steps.count() == 0
        assert recording.eval.episodes.count() == 30
        expected = tables_at(origin, whole.summary["train_steps"])
        for table, snapshot in zip(expected, recording.snapshots(), strict=True):
            assert table.tobytes() == snapshot.values.tobytes()
    assert verify(done.recording).sound
    assert list_runs(tmp_path)[0].run_id == done.run_id


def test_the_table_of_a_moment(whole, tmp_path):
    done = evaluate(whole, tmp_path, step=700, trials=None)
    with open_recording(done.recording) as recording, open_recording(whole.recording) as origin:
        for table, snapshot in zip(tables_at(origin, 700), recording.snapshots(), strict=True):
            assert table.tobytes() == snapshot.values.tobytes()
        starts = np.flatnonzero(origin.mdp.start)
        steps = recording.eval.steps.array()
        assert sorted(steps["state"][steps["t"] == 0].tolist()) == starts.tolist()


def test_one_start_state_and_steps_even_if_the_run_had_none(measured):
    with open_recording(measured.recording) as recording:
        start = int(np.flatnonzero(recording.mdp.start)[3])
    done = evaluate(measured, measured.folder.parent, trials=4, start=start)
    assert done.facts["config"]["initial_q"]["run"] == measured.run_id
    with open_recording(done.recording) as recording:
        steps = recording.eval.steps.array()
    assert steps["state"][steps["t"] == 0].tolist() == [start] * 4


def test_the_same_evaluation_is_the_same(whole, tmp_path):
    digests = {evaluate(whole, tmp_path, trials=5, seed=seed).summary["content_digest"] for seed in (0, 0, 1)}
    assert len(digests) == 2


def test_an_evaluation_of_an_evaluation(whole, tmp_path):
    first = evaluate(whole, tmp_path, trials=5)
    second = evaluate(first, tmp_path, trials=5)
    assert second.summary["content_digest"] == first.summary["content_digest"]


def test_no_such_step_no_run(whole, tmp_path):
    with pytest.raises(RecordingError, match="expected at least 999,999"):
        evaluate(whole, tmp_path, step=999_999)
    with pytest.raises(RunnerError, match="start: found state 1000000"):
        evaluate(whole, tmp_path, start=10**6)
    assert not list(tmp_path.iterdir())
