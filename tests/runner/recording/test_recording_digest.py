"""The content digest: recomputed from the file by the official reader, and moved by nothing but content."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from blake3 import blake3
from mcap.reader import make_reader

from runner.config.model import Job
from runner.environments.loading import load_mdp
from runner.execution.session import Session, recorder_for
from runner.learning.learner import Learner
from runner.recording import pipeline, recorder, schema
from runner.recording.digest import combined_digest
from runner.recording.reader import open_recording
from tests.runner.learning.twin import Twin
from tests.runner.recording.making import LAKE, SAMPLED, TAXIS, experiment, make_run

PACKINGS = [
    {"compression": "lz4"},
    {"compression": "none", "index": "chunk"},
    {"compression": "zstd", "level": 9, "index": "chunk", "chunk_steps": 256},
    {"chunk_steps": 65_536},
    {"steps": "none"},
]


def digest_of(path: Path) -> tuple[str, dict[str, str]]:
    """Return content digest and topic hashes by their definition, from what the official reader gives."""
    hashes = {}
    with path.open("rb") as stream:
        for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages(
            log_time_order=False
        ):
            record = struct.pack(
                "<BQHIQQ",
                5,
                22 + len(message.data),
                message.channel_id,
                0,
                message.log_time,
                message.log_time,
            )
            hashes.setdefault(channel.topic, blake3()).update(record + message.data)
    for topic in ("/log", "/clock", "/host", "/console"):
        hashes.pop(topic, None)
    topics = {topic: hashes[topic].hexdigest() for topic in sorted(hashes)}
    whole = blake3(b"dualtaxi content 0\n")
    for topic, found in topics.items():
        whole.update(struct.pack("<I", len(topic)) + topic.encode() + bytes.fromhex(found))
    return whole.hexdigest(), topics


def recorded_digests(run) -> tuple[str, dict[str, str]]:
    """Return the digests that a run's summary states."""
    return run.summary["content_digest"], run.summary["topic_digests"]


@pytest.mark.parametrize("made_of", [TAXIS, LAKE, LAKE | {"evaluation": None, "log": None}])
def test_the_digest_follows_its_definition(made_of, tmp_path):
    run = make_run(tmp_path, made_of)
    assert recorded_digests(run) == digest_of(run.recording)
    with open_recording(run.recording) as recording:
        assert (recording.result["content_digest"], recording.result["topic_digests"]) == recorded_digests(
            run
        )


def test_topics_have_no_order(taxis):
    content, topics = recorded_digests(taxis)
    assert combined_digest(dict(reversed(topics.items()))) == combined_digest(topics) == content


@pytest.mark.parametrize("packing", PACKINGS, ids=lambda packing: "-".join(map(str, packing.values())))
def test_how_it_is_packed_does_not_matter(packing, taxis, tmp_path):
    assert recorded_digests(make_run(tmp_path, TAXIS, recording=packing)) == recorded_digests(taxis)


def test_when_chunks_are_flushed_does_not_matter(taxis, tmp_path, monkeypatch):
    monkeypatch.setattr(recorder, "FLUSH_SECONDS", 0)
    monkeypatch.setattr(pipeline, "SYNC_SECONDS", 0)
    monkeypatch.setattr(recorder, "EPISODES_A_BLOCK", 2)
    run = make_run(tmp_path, TAXIS, recording={"chunk_steps": 256})
    assert recorded_digests(run) == recorded_digests(taxis) == digest_of(run.recording)
    assert run.summary["bytes"] > taxis.summary["bytes"], "there are more chunks than with the clock's"


def test_what_it_is_called_and_how_often_it_is_done_does_not_matter(taxis, tmp_path):
    assert recorded_digests(make_run(tmp_path, TAXIS, name="another")) == recorded_digests(taxis)
    assert recorded_digests(make_run(tmp_path, TAXIS, seeds=[5, 0])) == recorded_digests(taxis)


@pytest.mark.parametrize(
    "other", [{"episodes": 61}, {"epsilon": 0.41}, {"evaluation": {"every": 20, "trials": 4}}, {"log": None}]
)
def test_other_content_has_another_digest(other, taxis, tmp_path):
    assert recorded_digests(make_run(tmp_path, TAXIS, other))[0] != recorded_digests(taxis)[0]


def test_each_seed_has_its_own(tmp_path):
    assert len({recorded_digests(make_run(tmp_path, LAKE, seed=seed))[0] for seed in range(5)}) == 5


def test_what_differs_shows_in_the_hash_of_its_topic_and_in_no_other(tmp_path):
    first, second = (make_run(tmp_path, LAKE, snapshots={"every": every}) for every in (6, 4))
    differing = {
        topic
        for topic, found in recorded_digests(first)[1].items()
        if recorded_digests(second)[1][topic] != found
    }
    assert differing == {"/q_table"}


def test_leaving_the_steps_out_leaves_only_them_out(taxis, tmp_path):
    run = make_run(tmp_path, TAXIS, recording={"steps": "none"})
    assert run.summary["messages"] == taxis.summary["messages"], "what was done is counted all the same"
    with open_recording(run.recording) as bare, open_recording(taxis.recording) as full:
        assert bare.train.steps.count() == bare.eval.steps.count() == 0
        for topic in set(schema.JOB_TOPICS) - {schema.TRAIN_STEP, schema.EVAL_STEP}:
            assert list(bare.table(topic).messages()) == list(full.table(topic).messages())
    _, topics = digest_of(run.recording)
    assert topics == {
        topic: found for topic, found in recorded_digests(taxis)[1].items() if not topic.endswith("/step")
    }


@pytest.mark.parametrize("made_of", [TAXIS, LAKE, TAXIS | SAMPLED | {"algorithm": "random"}])
def test_recording_changes_nothing(made_of, tmp_path):
    """Recorded, computed without a file, and computed by the plain-Python twin: the same tables and steps."""
    run = make_run(tmp_path, made_of, seed=4)
    config = experiment(made_of)
    mdp = load_mdp(config.env.id, config.env.kwargs, config.rewards)
    learner = Learner(config, mdp, 4)
    unrecorded = Session(Job(config, 4), learner, recorder_for(Job(config, 4), learner, None))
    assert unrecorded.run()
    assert unrecorded.recorder.drain() == recorded_digests(run)[1]
    twin = Twin(config, mdp, 4)
    twin.train(config.episodes, 10**9)
    with open_recording(run.recording) as recording:
        last = list(recording.snapshots())[-len(twin.tables) :]
        steps = recording.train.steps.array()
    for i, table in enumerate(twin.tables):
        assert last[i].values.tobytes() == learner.table(i).tobytes() == np.array(table).tobytes()
    for name in ("step", "episode", "t", "state", "action", "next_state", "rewards", "explored"):
        assert steps[name].tolist() == [getattr(step, name) for step in twin.training.steps]
