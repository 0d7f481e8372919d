"""The reader's blocks: any piece of a topic is that piece of the whole, read without the rest."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runner.analysis.evaluations import evaluation_records
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.description import recorded_facts
from runner.recording.reader import open_recording
from runner.recording.record_store import RecordStore
from tests.runner.recording.making import LAKE, make_run

topics = st.sampled_from(schema.BLOCK_TOPICS)
places = st.integers(0, 2200)


@pytest.fixture(scope="module")
def recording(taxis):
    with open_recording(taxis.recording) as opened:
        yield opened


@pytest.fixture(scope="module")
def whole(recording):
    """Return all messages of each topic of fixed width."""
    return {topic: recording.table(topic).array() for topic in schema.BLOCK_TOPICS}


@settings(deadline=None, max_examples=60)
@given(topic=topics, start=places, stop=places | st.none())
def test_a_piece_is_that_piece_of_the_whole(topic, start, stop, recording, whole):
    blocks = list(recording.table(topic).blocks(start, stop))
    expected = whole[topic][start:stop]
    assert b"".join(block.tobytes() for block in blocks) == expected.tobytes()
    assert all(len(block) for block in blocks) or start >= (len(whole[topic]) if stop is None else stop)


def test_messages_are_numbered_from_0_without_a_gap(whole, recording):
    for topic, messages in whole.items():
        assert recording.table(topic).count() == len(messages) > 0
        number = "step" if topic.message is schema.STEP else "episode"
        assert messages[number].tolist() == list(range(len(messages)))


def test_blocks_are_chunks_and_cannot_be_written_to(recording, whole):
    blocks = list(recording.train.steps.blocks())
    assert len(blocks) > 5
    assert max(len(block) for block in blocks) == 256
    with pytest.raises(ValueError, match="read-only"):
        blocks[0]["state"] = 0


def test_a_piece_is_read_from_its_own_chunks_alone(taxis, monkeypatch):
    with open_recording(taxis.recording) as recording:
        recording.train.steps.count()
        read = []
        original = RecordStore.chunk_body
        monkeypatch.setattr(
            RecordStore, "chunk_body", lambda self, *at: read.append(at) or original(self, *at)
        )
        assert len(list(recording.train.steps.blocks(1000, 1010))) == 1
        assert len(read) == 1


@pytest.mark.parametrize("phase", ["train", "eval"])
def test_the_steps_of_each_episode_are_its_own(phase, recording, whole):
    steps = whole[schema.TRAIN_STEP if phase == "train" else schema.EVAL_STEP]
    episodes = recording.phase(phase).episodes.array()
    assert len(episodes) >= 12
    for episode in episodes:
        own = recording.phase(phase).episode_steps(int(episode["episode"]))
        assert own.tobytes() == steps[steps["episode"] == episode["episode"]].tobytes()
        assert own["t"].tolist() == list(range(episode["length"]))
        assert own["rewards"].sum(axis=0).tolist() == episode["returns"].tolist()
        assert own[-1][["terminated", "truncated"]] == episode[["terminated", "truncated"]]
        assert not own[:-1]["terminated"].any()
        assert own["state"][1:].tolist() == own["next_state"][:-1].tolist()


@pytest.mark.parametrize("number", [-1, 60, 61, 10**12])
def test_an_episode_that_is_not_there_is_refused(number, recording):
    with pytest.raises(RecordingError, match=rf"no training episode {number:,}; there are 60"):
        recording.train.episode_steps(number)


def test_the_recording_describes_itself(recording, taxis):
    facts = recorded_facts(recording)
    for key in ("run_id", "name", "seed", "status", "created", "config"):
        assert facts[key] == taxis.facts[key], key
    assert facts["summary"] == {
        key: value for key, value in taxis.summary.items() if key not in ("seconds", "bytes")
    }
    assert recording.file.finished
    assert recording.file.size == taxis.recording.stat().st_size == taxis.summary["bytes"]
    assert recording.mdp.agents == ("taxi_1", "taxi_2")


def test_no_other_phase_is_read(tmp_path):
    with (
        open_recording(make_run(tmp_path, LAKE).recording) as opened,
        pytest.raises(ValueError, match="found phase 'bogus', expected one of: train, eval"),
    ):
        opened.phase("bogus")


def test_a_metric_that_the_recording_was_made_without_is_unknown(taxis, tmp_path):
    name_and_number = b"mean_penalties\x18\x10"
    old = tmp_path / "old.mcap"
    data = taxis.recording.read_bytes()[:-20]  # without its end it is read from its beginning
    assert name_and_number in data
    old.write_bytes(data.replace(name_and_number, b"mean_penalties\x18\x63"))
    with open_recording(taxis.recording) as now, open_recording(old) as then:
        for expected, found in zip(now.eval.all_metrics(), then.eval.all_metrics(), strict=True):
            assert np.isnan(found.pop("mean_penalties"))
            assert expected.pop("mean_penalties") >= 0
            assert repr(found) == repr(expected)  # as NaN is not equal to itself
        assert evaluation_records(then)[0].value("mean_penalties") is None
