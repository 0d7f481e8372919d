"""Branches of parents whose recordings are damaged."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

import runner
from runner.execution.branching import branch_training
from runner.execution.verify import verify
from runner.recording import schema
from runner.recording.reader import open_recording
from runner.recording.repair import repair
from tests.runner.recording.making import SAMPLED, TAXIS, make_run, middle_of, training


@pytest.fixture(scope="module")
def long_parent(tmp_path_factory):
    """Return a parent with a dozen chunks of training steps."""
    return make_run(tmp_path_factory.mktemp("parent"), TAXIS, SAMPLED, recording={"chunk_steps": 256})


def damaged(run, folder, chunk, is_cut=False):
    """Return a copy of a run of which a chunk of steps is damaged, or where the file ends in it."""
    copy = runner.Run(Path(shutil.copytree(run.folder, folder / run.run_id)), run.facts)
    with open_recording(run.recording) as recording:
        at = recording.table(schema.TRAIN_STEP).entry(chunk).offset + 100
    data = bytearray(copy.recording.read_bytes())
    data[at] ^= 1
    copy.recording.write_bytes(data[:at] if is_cut else data)
    return copy


@pytest.mark.parametrize("share", [0.3, 0.9])
def test_a_parent_is_branched_if_other_steps_of_it_are_damaged(long_parent, tmp_path, share):
    copy = damaged(long_parent, tmp_path / "copy", chunk=1)
    branch = branch_training(copy, at=middle_of(long_parent, share), recordings=tmp_path).run
    assert branch.summary.content_digest == long_parent.summary.content_digest
    assert (checked := verify(branch.recording)).sound, checked.finding


def test_a_parent_with_a_hole_or_without_an_end_serves_as_far_as_it_goes(long_parent, tmp_path):
    cut = damaged(long_parent, tmp_path / "cut", chunk=5, is_cut=True)
    hole = damaged(long_parent, tmp_path / "hole", chunk=2)
    assert repair(hole.recording).lost
    for run in (cut, hole):
        branch = branch_training(run, at=int(training(run)["step"][-1]), recordings=tmp_path).run
        assert branch.summary.content_digest == long_parent.summary.content_digest
        assert (checked := verify(branch.recording)).sound, checked.finding
