"""Recorded steps are checked before they are replayed, in whatever the tables are needed for."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from click.testing import CliRunner
from rerun.chunk import RrdReader

from runner.archive.writing import write_archive
from runner.cli import cli
from runner.errors import RecordingError
from runner.export.rerun.selection import Request
from runner.export.rerun.writing import export
from runner.recording import schema
from runner.recording.reader import open_recording
from runner.replay.tables import TableReplay, known_steps, tables_at
from runner.runs.run import run_at
from tests.runner.altering import altered, without_chunk
from tests.runner.recording.making import TAXIS, make_run

FAR = 4_000_000_000


def exported(recording, path):
    (selection,) = export([run_at(recording.path)], Request(everything=True), path)
    return selection


def archived(recording, path):
    path.mkdir()
    write_archive(recording, path)


def last_tables(recording, path):
    TableReplay(recording, 0).advance(recording.train.steps.count())


@pytest.mark.parametrize("use", [exported, archived, last_tables])
@pytest.mark.parametrize("field", ["action", "state", "next_state"])
def test_a_step_that_the_environment_cannot_have_is_an_error(taxis, tmp_path, field, use):
    def change(records):
        records[field][700] = FAR
        return records

    path = altered(taxis.recording, tmp_path / "forged.mcap", schema.TRAIN_STEP, change)
    with (
        open_recording(path) as recording,
        pytest.raises(RecordingError, match=f"found {field} {FAR} in training step 700, expected less"),
    ):
        use(recording, tmp_path / "made")


def test_a_trial_that_the_environment_cannot_have_is_an_error(taxis, tmp_path):
    def change(records):
        records["state"][5] = FAR
        return records

    path = altered(taxis.recording, tmp_path / "forged.mcap", schema.EVAL_STEP, change)
    with (
        open_recording(path) as recording,
        pytest.raises(RecordingError, match="in evaluation step 5,"),
    ):
        exported(recording, tmp_path / "made.rrd")


def test_the_command_reports_it_and_leaves_no_file(tmp_path):
    run = make_run(tmp_path, TAXIS)
    forged = altered(
        run.recording, tmp_path / "x.mcap", schema.TRAIN_STEP, lambda r: (r["action"].put(9, FAR), r)[1]
    )
    shutil.move(forged, run.recording)
    target = tmp_path / "made.rrd"
    arguments = ["export", "rerun", run.run_id, "--all", "-o", str(target), "--recordings", str(tmp_path)]
    done = CliRunner().invoke(cli, arguments)
    assert done.exit_code == 2
    assert f"found action {FAR} in training step 9" in done.stderr
    assert not target.exists()


@pytest.fixture
def lossy(tmp_path):
    """A run of two snapshots' distance that lost its third chunk of training steps, and an untouched copy."""
    run = make_run(tmp_path, TAXIS, recording={"chunk_steps": 256})
    whole = tmp_path / "whole.mcap"
    shutil.copyfile(run.recording, whole)
    assert without_chunk(run.recording, schema.TRAIN_STEP, 2) == 256
    with open_recording(run.recording) as recording, open_recording(whole) as original:
        yield recording, original


def test_the_tables_are_known_up_to_lost_steps_and_from_the_next_snapshot_on(lossy):
    recording, whole = lossy
    middle, total = [one.step for one in recording.snapshots()][2], recording.train.steps.count()
    assert known_steps(recording) == [(0, 512), (middle, total)]
    assert known_steps(whole) == [(0, total)]
    for step in (0, 512, middle, total):
        pairs = zip(tables_at(recording, step), tables_at(whole, step), strict=True)
        assert all(np.array_equal(found, expected) for found, expected in pairs)
    replay = TableReplay(recording, 100)
    for step in (total, 40, middle + 1, 512):
        replay.seek(step)
        pairs = zip(replay.tables, tables_at(whole, step), strict=True)
        assert all(np.array_equal(found, expected) for found, expected in pairs)
    with pytest.raises(RecordingError, match="training steps 512 to 767 were lost"):
        replay.seek(800)


def test_an_export_leaves_out_the_q_values_that_are_unknown(lossy, tmp_path):
    recording, whole = lossy
    selection = exported(recording, tmp_path / "lossy.rrd")
    exported(whole, tmp_path / "whole.rrd")
    middle = [one.step for one in recording.snapshots()][2]
    assert any(f"{middle - 768:,} of these training steps" in text for text in selection.warnings)
    rewards = column(tmp_path / "lossy.rrd", "/train/reward", "Scalars:scalars")
    found = column(tmp_path / "lossy.rrd", "/train/q", "Scalars:scalars")
    expected = column(tmp_path / "whole.rrd", "/train/q", "Scalars:scalars")
    steps = recording.train.steps.array()
    known = (steps["step"] <= 512) | (steps["step"] >= middle)
    times = steps["log_time"].astype(np.int64) // schema.STEP_NANOSECONDS
    assert sorted(rewards) == times.tolist()
    assert sorted(found) == times[known].tolist()
    assert all(found[time] == expected[time] for time in found)
    cleared = column(tmp_path / "lossy.rrd", "/train/q", "Clear:is_recursive")
    assert times[known & (steps["step"] < middle)][-1] + 1 in cleared


def column(path, entity, component):
    """Return a component of an entity by the time it was logged at."""
    chunks = RrdReader(str(path)).store().stream().filter(content=entity).to_chunks()
    batches = [chunk.to_record_batch() for chunk in chunks if not chunk.is_static]
    return {
        time: value
        for batch in batches
        if component in batch.schema.names
        for time, value in zip(
            batch.column("step").to_pylist(), batch.column(component).to_pylist(), strict=True
        )
    }
