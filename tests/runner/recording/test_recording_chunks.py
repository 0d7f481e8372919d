"""Which chunks hold which messages, where there is no message index."""

from __future__ import annotations

import numpy as np
import pytest

from runner.recording import topic_chunks
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


def test_few_chunks_of_a_long_recording_are_unpacked_to_learn_their_topic(run, monkeypatch):
    monkeypatch.setattr(topic_chunks, "_MANY", 2**62)
    expected = places(run)
    monkeypatch.undo()
    probed, first_channel = [], RecordStore.first_channel

    def probe(store, entry):
        probed.append(entry.offset)
        return first_channel(store, entry)

    monkeypatch.setattr(RecordStore, "first_channel", probe)
    assert places(run) == expected
    steps = len(expected["/train/step"]) + len(expected["/eval/step"])
    total = sum(map(len, expected.values()))
    assert steps > 70
    assert len(probed) < total - steps + steps // 4


def test_counts_that_the_inferred_chunks_do_not_give_make_all_be_unpacked(run, monkeypatch):
    expected = places(run)
    with open_recording(run.recording) as recording:
        counts = recording._index.message_counts
        for channel in counts:
            counts[channel] += 7
        found = in_chunks(recording)
    assert found == expected


def test_the_steps_are_those_of_the_run(run):
    with open_recording(run.recording) as recording:
        for phase in ("train", "eval"):
            steps = np.concatenate([b["step"] for b in recording.phase(phase).steps.blocks()])
            assert np.array_equal(steps, np.arange(run.summary[f"{phase}_steps"]))
