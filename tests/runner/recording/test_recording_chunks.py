"""Which chunks hold which messages, where message indexes have no entries."""

from __future__ import annotations

import numpy as np
import pytest

from runner.recording.reader import open_recording
from runner.recording.record_store import RecordStore
from tests.runner.recording.making import LAKE, make_run

CHUNKED = {"recording": {"index": "chunk", "chunk_steps": 256}}
LONG = {
    "few evaluations": {"episodes": 3_000, "evaluation": {"every": 1_500, "trials": 20}},
    "evaluations of many chunks": {"episodes": 3_000, "evaluation": {"every": 1_000, "trials": 800}},
}


@pytest.fixture(params=LONG.values(), ids=LONG)
def run(request, tmp_path):
    return make_run(tmp_path, LAKE, request.param, CHUNKED, snapshots={"every": None})


def in_chunks(recording):
    tables = [recording.table(topic) for topic in recording.topics]
    return {table.topic.name: table.places.tolist() for table in tables if table}


def places(run):
    """Return what each topic's chunks are."""
    with open_recording(run.recording) as recording:
        return in_chunks(recording)


def test_no_chunk_is_unpacked_to_learn_its_topic(run, monkeypatch):
    monkeypatch.setattr(RecordStore, "chunk_body", lambda *_: pytest.fail("a chunk was read"))
    found = places(run)
    assert len(found["/train/step"]) + len(found["/eval/step"]) > 70


def test_a_chunk_without_its_index_at_the_end_of_a_cut_file_has_its_topic(run, tmp_path):
    data = run.recording.read_bytes()
    with open_recording(run.recording) as recording:
        last = recording.train.steps.entry(len(recording.train.steps) - 1)
        numbers = recording.train.steps.count()
    path = tmp_path / "cut.mcap"
    path.write_bytes(data[: last.offset + last.length])
    with open_recording(path) as recording:
        assert recording.train.steps.count() == numbers


def test_the_steps_are_those_of_the_run(run):
    with open_recording(run.recording) as recording:
        for phase in ("train", "eval"):
            steps = np.concatenate([b["step"] for b in recording.phase(phase).steps.blocks()])
            assert np.array_equal(steps, np.arange(run.summary[f"{phase}_steps"]))
