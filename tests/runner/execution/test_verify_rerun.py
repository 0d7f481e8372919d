"""Verification with the environment that is installed: what differs from the recorded one is named."""

from __future__ import annotations

import json

import pytest

from runner.execution import verify as verifying
from runner.execution.verify import verify
from runner.recording.integrity import survey
from runner.recording.reader import open_recording
from runner.recording.records import RawRecord, encode_chunk, read_record
from runner.recording.writer import RecordingFile
from runner.runs import provenance
from runner.util.packing import Packing
from tests.runner.altering import altered
from tests.runner.recording.making import TAXIS, make_run


def test_a_rerun_reports_what_differs(tmp_path, monkeypatch):
    whole = make_run(tmp_path, TAXIS)
    here = provenance.provenance()
    other = here | {"package.numpy": "1.0", "command": "x"}
    monkeypatch.setattr(provenance, "provenance", lambda: other)
    found = verify(whole.recording, rerun=True)
    assert found.sound
    assert found.changes == {"package.numpy": (here["package.numpy"], "1.0")}
    assert not verify(whole.recording).changes


def test_a_rerun_in_another_environment_diverges(tmp_path, monkeypatch):
    whole = make_run(tmp_path, TAXIS)
    load = verifying.load_mdp
    monkeypatch.setattr(
        verifying,
        "load_mdp",
        lambda env_id, kwargs, rewards: load(env_id, dict(kwargs) | {"slip": 0.5}, rewards),
    )
    found = verify(whole.recording, rerun=True)
    assert found.difference.topic in ("/train/step", "/eval/step")
    assert found.difference.step is not None
    assert found.changes["environment.next_state"] == ("as recorded", "another")
    assert verify(whole.recording).sound


def described_as(source, target, change):
    """Rewrite a recording with another description of its environment; return its path."""
    with open_recording(source) as recording, RecordingFile(target, recording.layout) as file:
        for name in recording.file.metadata_names:
            if name != "result":
                file.add_metadata(name, recording.file.metadata(name))
        for name, media_type, data in recording.file.attachments():
            if name == "environment.json":
                stored = json.loads(data)
                change(stored)
                file.add_attachment(name, media_type, json.dumps(stored).encode())
                continue
            file.add_attachment(name, media_type, data)
        for entry in survey(source).chunks:
            data = source.read_bytes()[entry.offset :][: entry.length]
            chunk = read_record(RawRecord.of(data, entry.offset, data[9:]))
            file.add_chunk(encode_chunk(chunk.topic, chunk.records, chunk.times, chunk.offsets, Packing()))
        file.finish(recording.file.metadata("result"))
    return target


def renamed(stored):
    stored["scene"]["actions"][0]["name"] = "fly"


def reordered(stored):
    stored["event_names"].reverse()


def moved(stored):
    stored["scene"]["landmarks"][0]["cell"] = [1, 1]


@pytest.mark.parametrize(
    ("change", "where"),
    [(renamed, "scene.actions[0].name"), (reordered, "event_names"), (moved, "scene.landmarks[0].cell")],
)
def test_a_rerun_compares_how_the_environment_is_described(run, tmp_path, change, where):
    made = described_as(run.recording, tmp_path / "x.mcap", change)
    found = verify(made, rerun=True)
    assert f"environment.json: {where}" in found.finding
    assert verify(run.recording, rerun=True).sound
    assert not verify(run.recording, rerun=True).not_compared
    assert "--rerun compares" in verify(run.recording).not_compared


def test_names_that_stand_in_a_recording_twice_are_compared(run, tmp_path):
    def elsewhere(stored):
        stored["env_id"] = "another:Game-v1"

    assert "env_id" in verify(described_as(run.recording, tmp_path / "a.mcap", elsewhere)).finding

    def others(entries):
        return entries | {"agents": json.dumps([f"x{k}" for k in range(int(entries["learners"]))])}

    finding = verify(altered(run.recording, tmp_path / "b.mcap", None, id, run=others)).finding
    assert "metadata run: agents" in finding
