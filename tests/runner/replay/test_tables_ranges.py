"""Blocks of a recording by number, by time and by episode: three ways to the same messages."""

from __future__ import annotations

import os

import numpy as np
import pytest

from runner.recording import schema
from runner.recording.reader import open_recording
from tests.runner.recording.making import TAXIS, make_run


@pytest.fixture(scope="module", params=["finished", "cut off"])
def recording(request, tmp_path_factory):
    run = make_run(tmp_path_factory.mktemp("ranges"), TAXIS, recording={"chunk_steps": 256})
    if request.param == "cut off":
        os.truncate(run.recording, int(0.8 * run.recording.stat().st_size))
    with open_recording(run.recording) as opened:
        yield opened


def whole(recording, topic):
    return joined(recording, topic, recording.table(topic).blocks())


def joined(recording, topic, blocks):
    return np.concatenate([np.empty(0, recording.table(topic).row_dtype), *blocks])


@pytest.mark.parametrize("topic", schema.BLOCK_TOPICS, ids=lambda topic: topic.name)
def test_by_time(recording, topic):
    records = whole(recording, topic)
    times = records["log_time"]
    moments = [-1, 0, 1, 2**63]
    if len(times):
        moments += [int(times[len(times) // 3]), int(times[len(times) // 2]) + 1]
        moments += [int(times[-1]), int(times[-1]) + 1]
    for start in moments:
        for stop in moments:
            found = joined(recording, topic, recording.table(topic).rows(range(start, stop)))
            expected = records[(times >= max(start, 0)) & (times < max(stop, 0))]
            assert found.tobytes() == expected.tobytes()


@pytest.mark.parametrize("phase", ["train", "eval"])
def test_by_episode(recording, phase):
    topics = schema.topics_of(phase)
    records, ended = whole(recording, topics.steps), recording.table(topics.episodes).count()
    for start in (0, 1, ended // 2, ended - 1, ended, ended + 5):
        for stop in (0, 1, ended // 2, ended, ended + 5, None):
            found = joined(recording, topics.steps, recording.phase(phase).steps_of_episodes(start, stop))
            behind = 10**9 if stop is None else stop
            expected = records[(records["episode"] >= start) & (records["episode"] < behind)]
            assert found.tobytes() == expected.tobytes()


def test_where_there_is_nothing(tmp_path):
    run = make_run(tmp_path, TAXIS, recording={"steps": "none"})
    with open_recording(run.recording) as recording:
        assert not list(recording.train.steps.rows(range(2**62)))
        assert not list(recording.train.steps_of_episodes(0, None))
