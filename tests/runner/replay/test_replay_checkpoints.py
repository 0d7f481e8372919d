"""Q-tables far from any snapshot: replayed once, and from then on from a checkpoint nearby."""

from __future__ import annotations

import os

import numpy as np
import pytest

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.reader import open_recording
from runner.replay import tables
from runner.replay.tables import TableReplay, tables_at
from runner.runs.catalogue.usage import cached
from runner.util.files import CACHED_TABLES, cache_folder
from tests.runner.altering import without_chunk
from tests.runner.recording.making import LAKE, TAXIS, make_run

SPARSE = {"snapshots": {"every": None}, "recording": {"chunk_steps": 256}}
KINDS = {
    "joint": TAXIS | {"mode": "cooperative"},
    "rivals": TAXIS,
    "double": TAXIS | {"algorithm": "double_q_learning"},
    "wolf": TAXIS | {"algorithm": "wolf_phc", "evaluation": {"every": 20, "trials": 3}},
    "traces": TAXIS | {"algorithm": "sarsa_lambda"},
    "n-step": TAXIS | {"mode": "cooperative", "algorithm": "n_step_q_learning"},
}


@pytest.fixture(autouse=True)
def _near(monkeypatch, tmp_path):
    """Keep checkpoints every 300 steps, in a cache of this test's own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(tables, "CHECKPOINT_STEPS", 300)


@pytest.fixture
def applied(monkeypatch):
    """Return a list that takes down how many steps each replay applies."""
    counts = []
    original = tables.StepReplay.apply

    def apply(self, steps, *rest, **named):
        counts.append(len(steps))
        original(self, steps, *rest, **named)

    monkeypatch.setattr(tables.StepReplay, "apply", apply)
    return counts


def files():
    return sorted((cache_folder() / CACHED_TABLES).glob("*"))


def as_bytes(held):
    return [{name: array.tobytes() for name, array in one.items()} for one in held]


@pytest.mark.parametrize("kind", KINDS)
def test_the_second_replay_takes_few_steps_and_gives_the_same(tmp_path, applied, kind):
    run = make_run(tmp_path, KINDS[kind], **SPARSE)
    with open_recording(run.recording) as recording:
        last = recording.train.steps.count()
        steps = [last - 1, 299, 300, 301, 650, 900]
        first = as_bytes(TableReplay(recording, last - 1).named_tables)
        assert sum(applied) == last - 1
        for step in steps:
            del applied[:]
            found = as_bytes(TableReplay(recording, step).named_tables)
            assert sum(applied) <= 300
            replay = TableReplay(recording)
            replay.advance(step)
            assert found == as_bytes(replay.named_tables)
        assert as_bytes(TableReplay(recording, last - 1).named_tables) == first
    assert cached(CACHED_TABLES)[run.run_id] == sum(file.stat().st_size for file in files()) > 0


def test_snapshots_that_are_near_need_no_checkpoints(tmp_path):
    run = make_run(tmp_path, LAKE)
    with open_recording(run.recording) as recording:
        for step in range(recording.train.steps.count()):
            tables_at(recording, step)
    assert files() == []


@pytest.mark.parametrize("damage", [b"", b"nonsense", None])
def test_damaged_checkpoints_are_passed_over(tmp_path, damage):
    run = make_run(tmp_path, TAXIS, **SPARSE)
    with open_recording(run.recording) as recording:
        expected = [table.tobytes() for table in tables_at(recording, 1000)]
        for file in files():
            data = bytearray(file.read_bytes())
            data[len(data) // 2] ^= 1
            file.write_bytes(data if damage is None else damage)
        assert [table.tobytes() for table in tables_at(recording, 1000)] == expected


def test_a_recording_that_changed_has_no_checkpoints(tmp_path):
    run = make_run(tmp_path, TAXIS, **SPARSE)
    with open_recording(run.recording) as recording:
        tables_at(recording, 1200)
    without_chunk(run.recording, schema.TRAIN_STEP, 1)
    with open_recording(run.recording) as recording, pytest.raises(RecordingError, match="were lost"):
        tables_at(recording, 1200)


def test_tables_set_by_hand_are_not_kept(tmp_path):
    run = make_run(tmp_path, TAXIS, **SPARSE)
    with open_recording(run.recording) as recording:
        replay = TableReplay(recording)
        replay.rewind(0, [{"q": table + 1.0} for table in replay.tables])
        replay.advance(1000)
        assert files() == []
        assert not np.array_equal(tables_at(recording, 1000)[0], replay.tables[0])


def test_the_cache_stays_within_its_size(tmp_path, monkeypatch):
    run = make_run(tmp_path, TAXIS, **SPARSE)
    with open_recording(run.recording) as recording:
        tables_at(recording, 1500)
        whole = files()
        for age, file in enumerate(whole):
            os.utime(file, (age, age))
        limit = sum(file.stat().st_size for file in whole[1:]) + 10
        monkeypatch.setattr(tables, "MAX_CACHE_BYTES", limit)
        tables_at(recording, 2100)
        assert whole[0] not in files()
        assert sum(file.stat().st_size for file in files()) <= limit


def test_a_cache_that_cannot_be_written_is_done_without(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    run = make_run(tmp_path, TAXIS, **SPARSE)
    with open_recording(run.recording) as recording:
        assert tables_at(recording, 1000)[0].any()
