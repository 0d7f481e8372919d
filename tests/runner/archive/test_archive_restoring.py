"""What comes back from an archive: the same content, or an error that names what is wrong."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from runner.archive import layout
from runner.archive.layout import Entry, Manifest, entries_of
from runner.archive.reading import Archive, restore
from runner.archive.runs import archive_run
from runner.errors import RecordingError, RunnerError
from runner.execution.verify import verify
from runner.recording import schema
from runner.recording.integrity import check_integrity
from runner.recording.reader import open_recording
from runner.recording.repair import repair
from runner.runs.run import run_at
from tests.runner.altering import altered
from tests.runner.archive.whole import archived, contents
from tests.runner.recording.making import LAKE, TAXIS, make_run


@pytest.mark.parametrize(
    "parts",
    [
        {"mode": "cooperative"},
        {"recording": {"chunk_steps": 256, "index": "chunk", "compression": "lz4"}},
        {"recording": {"steps": "none"}},
        {"snapshots": {"every": 7}, "initial_q": {"random": {"low": -1.0, "high": 1.0}}},
        {"log": None, "evaluation": None},
    ],
    ids=[
        "one learner",
        "two learners, packed otherwise",
        "without steps",
        "random start",
        "nothing but steps",
    ],
)
def test_everything_comes_back_and_verifies(parts, tmp_path):
    run = make_run(tmp_path, TAXIS, **parts)
    back = tmp_path / "back.mcap"
    manifest = restore(archived(run.recording, tmp_path / "archive"), back)
    assert contents(back) == contents(run.recording)
    check_integrity(back)
    found = verify(back)
    assert found.sound, found.finding
    if parts.get("recording", {}).get("steps") != "none":
        assert manifest.digest == run.summary["content_digest"]


def test_another_environment_without_scene_or_events_comes_back(tmp_path):
    run = make_run(tmp_path, LAKE)
    back = tmp_path / "back.mcap"
    restore(archived(run.recording, tmp_path / "archive"), back)
    assert contents(back) == contents(run.recording)


def test_what_a_killed_run_left_comes_back(run, tmp_path):
    with open_recording(run.recording) as recording:
        chunks = recording.file.index.chunks
        cut = sum(chunks[len(chunks) - 6][:2])
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(run.recording.read_bytes()[: cut + 11])
    back = tmp_path / "back.mcap"
    restore(archived(torn, tmp_path / "archive"), back)
    assert contents(back) == contents(torn)
    assert contents(back) != contents(run.recording)


def test_what_a_repair_left_comes_back_with_its_holes(taxis_with_a_hole, tmp_path):
    back = tmp_path / "back.mcap"
    folder = archived(taxis_with_a_hole, tmp_path / "archive")
    restore(folder, back)
    assert contents(back) == contents(taxis_with_a_hole)
    with open_recording(back) as recording:
        assert recording.lost
    snapshots = pq.read_table(folder / layout.Q_TABLES)
    assert snapshots["data"].null_count < snapshots.num_rows  # what follows the hole cannot be replayed


@pytest.fixture
def taxis_with_a_hole(tmp_path):
    """A repaired recording that lost a chunk of training steps."""
    run = make_run(tmp_path / "holed", TAXIS, recording={"chunk_steps": 256})
    with open_recording(run.recording) as recording:
        entry = recording.train.steps.entry(3)
    data = bytearray(run.recording.read_bytes())
    data[entry.offset + 100] ^= 255
    run.recording.write_bytes(data)
    assert repair(run.recording).lost
    return run.recording


def test_a_snapshot_that_the_steps_do_not_make_is_kept_whole(run, tmp_path):
    """As after a quirk that the replay would not know: the recording says what the table was."""

    def with_other_cell(messages):
        times = [time for time, _ in messages]
        payloads = [bytearray(payload) for _, payload in messages]
        payloads[1][-3] ^= 1
        return list(zip(times, map(bytes, payloads), strict=True))

    def without_digests(entries):
        stored = json.loads(entries["json"])
        return {"json": json.dumps(stored | {"topic_digests": {}, "content_digest": None})}

    odd = altered(
        run.recording, tmp_path / "odd.mcap", schema.Q_TABLE_TOPIC, with_other_cell, result=without_digests
    )
    folder = archived(odd, tmp_path / "archive")
    kept = [row is not None for row in pq.read_table(folder / layout.Q_TABLES)["data"].to_pylist()]
    assert kept[:3] == [False, True, True]  # and the next one follows from the true one
    restore(folder, tmp_path / "back.mcap")
    assert contents(tmp_path / "back.mcap") == contents(odd)


def test_one_changed_byte_is_found_and_its_file_named(archive, tmp_path):
    names = [path.relative_to(archive) for path in archive.rglob("*") if path.is_file()]
    for name in names:
        folder = tmp_path / "changed"
        shutil.copytree(archive, folder)
        data = bytearray((folder / name).read_bytes())
        data[len(data) // 2] ^= 1
        (folder / name).write_bytes(data)
        with pytest.raises(RecordingError, match=name.name):
            restore(folder, tmp_path / "back.mcap")
        assert not (tmp_path / "back.mcap").exists()
        shutil.rmtree(folder)


def test_a_missing_file_and_a_missing_manifest_are_named(archive, tmp_path):
    folder = shutil.copytree(archive, tmp_path / "less")
    (folder / layout.EPISODES).unlink()
    with pytest.raises(RecordingError, match=r"episodes\.parquet: cannot be read"):
        restore(folder)
    (folder / layout.MANIFEST).unlink()
    with pytest.raises(RecordingError, match=r"is no archive: manifest\.json"):
        restore(folder)


def forged(archive, folder, name, table, **options):
    """Return a copy with another table in it, whose manifest agrees."""
    shutil.copytree(archive, folder)
    pq.write_table(table, folder / name, **options)
    return sealed(folder)


def sealed(folder, change=lambda manifest: manifest):
    """Write the manifest that belongs to the files there are, changed."""
    path = folder / layout.MANIFEST
    stored = json.loads(path.read_bytes())
    topics = {name: Entry(**entry) for name, entry in stored["topics"].items()}
    manifest = Manifest(stored["run"], topics, entries_of(folder))
    path.write_bytes(change(manifest).to_json())
    return folder


def with_column(table, name, values):
    return table.set_column(table.schema.get_field_index(name), table.schema.field(name), values)


def test_a_forged_value_is_found_by_the_topics_hash(archive, tmp_path):
    steps = pq.read_table(archive / layout.STEPS)
    reward = steps["reward"].to_numpy().copy()
    reward[5] += 1  # the steps before training are those of an evaluation
    folder = forged(
        archive, tmp_path / "forged", layout.STEPS, with_column(steps, "reward", pa.array(reward))
    )
    with pytest.raises(RecordingError, match=r"/eval/step: restored"):
        restore(folder)


@pytest.mark.parametrize(
    ("forge", "message"),
    [
        (lambda steps: steps.drop(["state"]), "found columns"),
        (lambda steps: with_column(steps, "t", pa.nulls(len(steps), pa.int32())), "rows without t"),
        (lambda steps: steps.set_column(6, "state", steps["state"].cast(pa.int64())), "found columns"),
        (lambda steps: pa.concat_tables([steps] * 2), "rows, expected"),
        (lambda steps: steps.slice(1), "rows, expected"),
        (
            lambda steps: with_column(steps, "state", pa.array(np.full(len(steps), 2**31 - 1, np.int32))),
            "expected less than",
        ),
        (
            lambda steps: with_column(steps, "phase", pa.array(["test"] * len(steps)).cast(layout.TEXT)),
            "found phases",
        ),
    ],
    ids=["no column", "nulls", "type", "more rows", "fewer rows", "no such state", "no such phase"],
)
def test_tables_of_another_kind_are_refused(archive, tmp_path, forge, message):
    steps = pq.read_table(archive / layout.STEPS)
    folder = forged(archive, tmp_path / "forged", layout.STEPS, forge(steps))
    with pytest.raises(RunnerError, match=message):
        restore(folder)


def test_rows_without_end_are_refused_before_they_are_read(archive, tmp_path):
    """A few kilobytes that declare 17 million rows, in a manifest that agrees."""
    steps = pq.read_table(archive / layout.STEPS).slice(0, 1)
    n = 1 << 21
    folder = tmp_path / "endless"
    shutil.copytree(archive, folder)
    zeros = pa.table({name: pa.repeat(steps[name][0], n) for name in steps.schema.names}, steps.schema)
    with pq.ParquetWriter(folder / layout.STEPS, steps.schema, compression="zstd") as writer:
        for _ in range(8):
            writer.write_table(zeros, n)

    def with_as_many(manifest):
        others = manifest.topics["/eval/step"].size
        return replace(manifest, topics={**manifest.topics, "/train/step": Entry(8 * n - others, "0" * 64)})

    sealed(folder, with_as_many)
    with pytest.raises(RecordingError, match="made to exhaust the disk"):
        restore(folder)


@pytest.mark.parametrize("name", ["../outside", "/etc/passwd", "a\\b", "c:d", "."])
def test_no_file_of_an_archive_is_outside_of_it(archive, tmp_path, name):
    folder = shutil.copytree(archive, tmp_path / "outside")
    sealed(folder, lambda manifest: replace(manifest, files={**manifest.files, name: Entry(1, "0" * 64)}))
    with pytest.raises(RecordingError, match="would leave the archive"):
        restore(folder)


def test_an_archive_of_a_later_version_is_refused_by_its_version(archive, tmp_path):
    folder = shutil.copytree(archive, tmp_path / "later")
    path = folder / layout.MANIFEST
    path.write_text(path.read_text().replace('"version": 1', '"version": 7'))
    with pytest.raises(RecordingError, match="version 7, expected 1"):
        restore(folder)


def test_reading_a_table_keeps_nothing_of_the_groups_before(tmp_path):
    folder = archived(make_run(tmp_path, LAKE).recording, tmp_path / "archive")
    columns, rows, groups = pa.schema([("data", pa.int64())]), 1 << 17, 16
    numbers = np.random.default_rng(1).integers(-(2**63), 2**63, rows, np.int64)
    with pq.ParquetWriter(folder / "numbers.parquet", columns) as writer:
        for _ in range(groups):
            writer.write_table(pa.table([numbers], columns))
    before, most = pa.total_allocated_bytes(), 0
    for _ in Archive(folder).batches("numbers.parquet", columns, rows * groups, 4096):
        most = max(most, pa.total_allocated_bytes() - before)
    assert most < 4 * numbers.nbytes


@pytest.mark.parametrize("name", ["manifest.json", "run.parquet", "steps.parquet"])
@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_in_place_of_a_file_is_refused_and_does_not_block(taxis, tmp_path, name):
    recordings, archive = tmp_path / "recordings", tmp_path / "archive"
    shutil.copytree(taxis.folder, recordings / taxis.run_id)
    archive_run(run_at(recordings / taxis.run_id), str(archive), remove=True)
    (archive / taxis.run_id / name).unlink()
    os.mkfifo(archive / taxis.run_id / name)
    restoring = f"""
from pathlib import Path
from runner.archive.runs import restore_run
from runner.errors import RunnerError
from runner.runs.run import run_at
try:
    restore_run(run_at(Path({str(recordings / taxis.run_id)!r})))
except RunnerError as error:
    print(error)
"""
    command = [sys.executable, "-c", restoring]
    done = subprocess.run(command, capture_output=True, check=True, text=True, timeout=60)
    assert str(archive) in done.stdout, done
