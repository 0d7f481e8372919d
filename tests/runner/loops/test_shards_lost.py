"""Shards that are damaged, cut, of another kind: nothing is removed that is not in the run."""

from __future__ import annotations

import shutil
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import runner
from runner.errors import RunnerError
from runner.execution.verify import verify
from runner.loops.fold import fold_if_over
from runner.loops.step_buffer import StepBuffer
from runner.recording.reader import open_recording
from runner.runs.run import run_at
from runner.runs.shards import shards_of
from tests.runner.loops.making import dualtaxi
from tests.runner.loops.sharing import play

STEPS = 1500


@pytest.fixture(scope="module")
def unfolded(tmp_path_factory) -> Path:
    """A run of which the process that began it, and two more, are over, and nothing was folded."""
    folder = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("runner.loops.loop_run.fold_if_over", lambda run, _: run)
        with runner.record(gymnasium.make("CartPole-v1"), folder, name="cart") as rec:
            for shard in ("w0", "w1"):
                env = gymnasium.make("CartPole-v1")
                with runner.record(env, join=rec.run, shard=shard, chunk_steps=256) as joined:
                    play(joined, STEPS, int(shard[1]))
            play(rec, 100, 5)
    return rec.run.folder


@pytest.fixture
def run(unfolded, tmp_path) -> runner.Run:
    return run_at(Path(shutil.copytree(unfolded, tmp_path / unfolded.name)))


def chunks_of_steps(path: Path) -> list[slice]:
    with open_recording(path) as recording:
        chunks = recording.train.steps
        entries = [chunks.entry(k) for k in range(len(chunks))]
    return [slice(entry.offset, entry.offset + entry.length) for entry in entries]


def steps_in(path: Path) -> int:
    with open_recording(path) as recording:
        return sum(len(block) for block in recording.train.steps.blocks())


def test_a_repaired_shard_is_kept_if_steps_in_it_are_not_in_the_run(run):
    path = shards_of(run)[0].recording
    data = bytearray(path.read_bytes())
    data[chunks_of_steps(path)[2].start + 100] ^= 1
    path.write_bytes(data)
    with pytest.raises(RunnerError, match="repair"):
        fold_if_over(run)
    pending = run_at(run.folder)
    assert (pending.status, len(shards_of(pending))) == ("interrupted", 2)
    refused = dualtaxi(run.folder.parent, "verify", run.run_id)
    assert refused.exit_code == 2
    assert "not complete" in refused.output

    repaired = dualtaxi(run.folder.parent, "repair", run.run_id)
    assert repaired.exit_code == 1
    assert "512 to 767" in repaired.output
    kept = run.folder / "unfolded" / "w0"
    assert steps_in(kept / "recording.mcap") == STEPS - 256
    assert (kept / "recording.damaged-1.mcap").read_bytes() == data
    folded = run_at(run.folder)
    assert not (run.folder / "shards").exists()
    assert folded.status == "interrupted"
    assert f"w0: 512 of {STEPS:,} training steps" in folded.summary.error
    assert "unfolded/w0" in dualtaxi(run.folder.parent, "show", run.run_id).output
    assert steps_in(folded.recording) == 100 + STEPS + 512
    assert "w0: 512 of" in verify(folded.recording, rerun=False).finding
    assert dualtaxi(run.folder.parent, "repair", run.run_id).exit_code == 1


@pytest.mark.parametrize("left", ["cut", "emptied", "removed", "foreign"])
def test_a_shard_that_lacks_what_it_stated_is_kept(run, left):
    path = shards_of(run)[1].recording
    data, whole = path.read_bytes(), chunks_of_steps(path)[2].stop
    if left == "removed":
        path.unlink()
    else:
        path.write_bytes({"cut": data[: whole + 100], "emptied": b"", "foreign": b"no MCAP" * 100}[left])
    folded = fold_if_over(run)
    assert folded.status == "interrupted"
    assert "w1" in folded.summary.error
    assert not verify(folded.recording, rerun=False).sound
    assert 100 + STEPS <= steps_in(folded.recording) < 100 + 2 * STEPS
    assert (run.folder / "unfolded" / "w1" / "run.json").exists()
    if left != "removed":
        assert (run.folder / "unfolded" / "w1" / "recording.mcap").stat().st_size in (whole + 100, 0, 700)


def test_a_shard_without_its_run_file_is_folded_or_kept(run):
    for shard in shards_of(run):
        (shard.folder / "run.json").unlink()
    (run.folder / "shards" / "w1" / "recording.mcap").write_bytes(b"garbage")
    folded = fold_if_over(run)
    assert steps_in(folded.recording) == 100 + STEPS
    assert (run.folder / "unfolded" / "w1" / "recording.mcap").read_bytes() == b"garbage"
    assert folded.status == "interrupted"


def test_a_shard_of_another_kind_is_kept_and_the_others_are_folded(run, tmp_path):
    with runner.record(gymnasium.make("Taxi-v4"), tmp_path / "other", name="taxi") as taxi:
        play(taxi, 50, 1, log=False)
    shutil.copytree(taxi.run.folder, run.folder / "shards" / "taxi")
    folded = fold_if_over(run)
    assert steps_in(folded.recording) == 100 + 2 * STEPS
    assert folded.status == "interrupted"
    assert "taxi: found agents ['taxi'], expected ['agent']" in folded.summary.error
    kept = dualtaxi(tmp_path, "show", str(run.folder / "unfolded" / "taxi"))
    assert "50 of training" in kept.output


def test_closing_the_last_process_warns_of_what_was_left_out(unfolded, tmp_path):
    rec = runner.record(gymnasium.make("CartPole-v1"), tmp_path, name="warns")
    play(rec, 50, 1)
    with runner.record(gymnasium.make("CartPole-v1"), join=rec.run, shard="w0") as joined:
        play(joined, 50, 2)
    shutil.copytree(unfolded / "shards" / "w0", rec.run.folder / "shards" / "w1")
    (rec.run.folder / "shards" / "w1" / "recording.mcap").write_bytes(b"")
    with pytest.warns(RuntimeWarning, match=r"w1: .*kept in unfolded/w1"):
        rec.close()
    assert steps_in(rec.run.recording) == 100


def test_nothing_is_removed_if_the_folded_steps_are_not_those_of_the_shards(run, monkeypatch):
    real = StepBuffer.copy

    def copy(self, rows: np.ndarray, environment: int) -> None:
        changed = rows.copy()
        changed["rewards"] += 1
        real(self, changed, environment)

    monkeypatch.setattr(StepBuffer, "copy", copy)
    before = run.recording.read_bytes()
    with pytest.raises(RunnerError, match="rewards: found other values"):
        fold_if_over(run)
    assert len(shards_of(run)) == 2
    assert run.recording.read_bytes() == before


def test_what_the_first_process_recorded_is_kept_if_not_all_of_it_is_folded(run):
    path = run.recording
    path.write_bytes(path.read_bytes()[: chunks_of_steps(path)[0].stop])
    data = path.read_bytes()
    folded = fold_if_over(run)
    assert (run.folder / "recording.unfolded.mcap").read_bytes() == data
    assert "the process that began the run" in folded.summary.error


def test_repair_counts_what_a_cut_recording_lacks(tmp_path):
    with runner.record(gymnasium.make("CartPole-v1"), tmp_path, name="cut", chunk_steps=256) as rec:
        play(rec, STEPS, 0)
    path = rec.run.recording
    path.write_bytes(path.read_bytes()[: chunks_of_steps(path)[2].stop])
    repaired = dualtaxi(tmp_path, "repair", rec.run.run_id)
    assert repaired.exit_code == 1
    assert f"768 to {STEPS - 1:,}" in repaired.output
    assert run_at(rec.run.folder).status == "interrupted"
    assert not verify(path, rerun=False).sound
