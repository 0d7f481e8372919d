"""What an archive holds: everything that was recorded, in columns that others read."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from runner.archive import layout
from runner.archive.batches import Batches
from runner.archive.layout import entries_of, read_manifest
from runner.archive.writing import write_archive
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.reader import open_recording
from runner.recording.rewriting import rewrite
from tests.runner.altering import altered
from tests.runner.recording.making import TAXIS, make_run


def test_the_manifest_states_the_runs_digest_and_each_files_hash(run, archive):
    manifest = read_manifest((archive / layout.MANIFEST).read_bytes(), "here")
    assert manifest.digest == manifest.run["content_digest"] == run.summary["content_digest"]
    assert manifest.run_id == run.run_id
    found = {path.relative_to(archive).as_posix() for path in archive.rglob("*") if path.is_file()}
    assert found == {*manifest.files, layout.MANIFEST}
    assert entries_of(archive) == dict(manifest.files)


def test_the_steps_are_there_in_the_order_taken_under_the_names_of_the_recording(run, archive):
    table = pq.read_table(archive / layout.STEPS)
    position = table["position"].to_numpy()
    assert (np.diff(position) == 1).all()
    assert position[0] == 1
    assert set(table["run_id"].to_pylist()) == {run.run_id}
    with open_recording(run.recording) as recording:
        for phase in schema.PHASES:
            steps = recording.phase(phase).steps.array()
            mine = table.filter(pa.compute.equal(table["phase"], phase))
            for name in ("step", "episode", "t", "state", "action", "next_state", "terminated", "truncated"):
                np.testing.assert_array_equal(mine[name].to_numpy(), steps[name])
            np.testing.assert_array_equal(mine["reward"].to_numpy(), steps["rewards"][:, 0])
            own = mine["action_taxi_1"].to_numpy() * 6 + mine["action_taxi_2"].to_numpy()
            np.testing.assert_array_equal(own, steps["action"])


def test_learners_of_their_own_have_columns_of_their_own(tmp_path):
    run = make_run(tmp_path, TAXIS)
    with open_recording(run.recording) as recording:
        steps = recording.train.steps.array()
        batches = Batches(recording)
        table = pa.Table.from_batches(batches.of(batches.shape.tables[layout.STEPS]))
    table = table.filter(pa.compute.equal(table["phase"], "train"))
    for i in range(2):
        np.testing.assert_array_equal(table[f"reward_taxi_{i + 1}"].to_numpy(), steps["rewards"][:, i])
        np.testing.assert_array_equal(table[f"explored_taxi_{i + 1}"].to_numpy(), steps["explored"] >> i & 1)
    np.testing.assert_array_equal(table["reward"].to_numpy(), steps["rewards"].sum(axis=1))


def test_snapshots_that_the_steps_make_are_kept_by_hash(archive):
    table = pq.read_table(archive / layout.Q_TABLES)
    assert table.num_rows > 2
    assert table["data"].null_count == table.num_rows
    assert len(set(table["blake3"].to_pylist())) > 2


def test_without_steps_the_snapshots_are_kept_whole(tmp_path):
    run = make_run(tmp_path, TAXIS, mode="cooperative", recording={"steps": "none"})
    folder = tmp_path / "archive"
    folder.mkdir()
    with open_recording(run.recording) as recording:
        write_archive(recording, folder)
        last = list(recording.snapshots())[-1]
    table = pq.read_table(folder / layout.Q_TABLES)
    assert table["data"][-1].as_py() == last.values.tobytes()
    assert pq.read_table(folder / layout.STEPS).num_rows == 0


def test_a_message_that_columns_cannot_hold_is_refused_and_named(run, tmp_path):
    def with_odd_bit(steps):
        steps["explored"][7] = 2
        return steps

    path = altered(run.recording, tmp_path / "odd.mcap", schema.TRAIN_STEP, with_odd_bit)
    (tmp_path / "archive").mkdir()
    with (
        open_recording(path) as recording,
        pytest.raises(RecordingError, match=r"message 7 of /train/step has what no recorder writes"),
    ):
        write_archive(recording, tmp_path / "archive")


def test_a_recording_that_is_not_what_its_result_says_is_refused(run, tmp_path):
    def with_other_action(steps):
        steps["action"][7] ^= 1
        return steps

    path = altered(run.recording, tmp_path / "other.mcap", schema.TRAIN_STEP, with_other_action)
    (tmp_path / "archive").mkdir()
    with (
        open_recording(path) as recording,
        pytest.raises(RecordingError, match=r"/train/step: found .* expected .* by its result"),
    ):
        write_archive(recording, tmp_path / "archive")


@pytest.mark.parametrize("name", ["run.parquet", "manifest.json", "metadata.json", "checkpoints/ab"])
def test_an_attachment_with_the_name_of_a_file_of_archives_is_refused(run, tmp_path, name):
    path = tmp_path / "recording.mcap"

    def attach(file):
        file.add_attachment(name, "text/plain", b"other content")

    rewrite(run.recording, path, lambda _, entries: entries, add=attach)
    (tmp_path / "archive").mkdir()
    with open_recording(path) as recording, pytest.raises(RecordingError, match=f"an attachment '{name}'"):
        write_archive(recording, tmp_path / "archive")
