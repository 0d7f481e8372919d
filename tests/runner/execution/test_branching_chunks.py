"""Packed chunks that a branch takes over from its parent, and those that it cannot."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

import runner
from runner.execution.branching import branch_training
from runner.execution.verify import verify
from runner.recording import schema
from runner.recording.layout import RECORD_HEAD
from runner.recording.reader import open_recording
from runner.recording.records import CHUNK_HEAD, ReadChunk, encode_chunk, walk
from runner.recording.repair import repair
from runner.recording.rewriting import whole_records
from runner.recording.writer import RecordingFile
from runner.util.packing import Packing
from tests.runner.recording.making import SAMPLED, TAXIS, make_run, middle_of, training


@pytest.fixture(scope="module")
def long_parent(tmp_path_factory):
    """Return a parent with a dozen chunks of training steps."""
    return make_run(tmp_path_factory.mktemp("parent"), TAXIS, SAMPLED, recording={"chunk_steps": 256})


def repacked(run, folder, compression="zstd", level=19, damaged=None, altered=None, forged=None):
    """Return a copy of a run with chunks that its recorder would not have written.

    The chunk of steps number `damaged` cannot be unpacked, and that number `altered` has another last byte;
    so has that number `forged`, with the checksum that it had before.
    """
    copy = runner.Run(Path(shutil.copytree(run.folder, folder / run.run_id)), run.facts)
    copy.recording.unlink()
    places = [place for place, _, _ in packed_steps(run)]
    with open_recording(run.recording) as recording:
        layout = recording.layout
    with RecordingFile(copy.recording, layout) as file:
        for record in whole_records(run.recording):
            if not isinstance(record, ReadChunk):
                file.copy(record)
                continue
            records = bytearray(record.records)
            records[-1] ^= record.offset in (places[k] for k in (altered, forged) if k is not None)
            packing = Packing(compression, level)
            fresh = encode_chunk(record.topic, bytes(records), record.times, record.offsets, packing)
            if forged is not None and record.offset == places[forged]:
                own = bytearray(fresh.record)
                CHUNK_HEAD.pack_into(own, RECORD_HEAD.size, *CHUNK_HEAD.unpack_from(record.body))
                fresh = replace(fresh, record=bytes(own))
            file.add_chunk(fresh)
        file.finish()
    if damaged is not None:
        data = bytearray(copy.recording.read_bytes())
        data[packed_steps(copy)[damaged][0] + 100] ^= 1
        copy.recording.write_bytes(data)
    return copy


def packed_steps(run):
    """Return place, body and times of a recording's chunks of training steps, by their message indexes."""
    found = []
    with run.recording.open("rb") as stream:
        for raw in walk(stream, run.recording.stat().st_size):
            if raw.is_chunk:
                last = (raw.offset, raw.body, CHUNK_HEAD.unpack_from(raw.body)[:2])
            elif raw.is_message_index and raw.body[0] == schema.TRAIN_STEP.channel:
                found.append(last)
    return found


def shared_chunks(a, b):
    """Return how many packed chunks of training steps two recordings have in common."""
    ours, theirs = ({body for _, body, _ in packed_steps(run)} for run in (a, b))
    return len(ours & theirs)


@pytest.mark.parametrize("share", [0.1, 0.9])
def test_chunks_before_the_branch_are_not_packed_again(long_parent, tmp_path, share):
    step, copy = middle_of(long_parent, share), repacked(long_parent, tmp_path / "copy")
    assert shared_chunks(copy, long_parent) == 0
    expected, found = (
        branch_training(run, at=step, overrides=["epsilon=0.9"], recordings=tmp_path / name).run
        for run, name in ((long_parent, "a"), (copy, "b"))
    )
    assert found.summary.content_digest == expected.summary.content_digest
    assert (checked := verify(found.recording)).sound, checked.finding
    branched_at = int(training(long_parent, step, step + 1)["log_time"][0])
    before = sum(end < branched_at for _, _, (_, end) in packed_steps(copy))
    assert shared_chunks(found, copy) == before > 0


@pytest.mark.parametrize("share", [0.3, 0.9])
@pytest.mark.parametrize(
    ("changes", "options"),
    [
        ([], {"damaged": 1}),
        ([], {"altered": 1}),
        ([], {"forged": 1}),
        ([], {"compression": "lz4"}),
        (["recording.level=9"], {}),
    ],
    ids=[
        "damaged",
        "other steps than the job's",
        "with their checksum too",
        "not packed as configured",
        "to be packed otherwise",
    ],
)
def test_a_chunk_that_cannot_be_used_is_packed_again(long_parent, tmp_path, share, changes, options):
    copy = repacked(long_parent, tmp_path / "copy", **options)
    branch = branch_training(
        copy, at=middle_of(long_parent, share), overrides=changes, recordings=tmp_path
    ).run
    assert branch.summary.content_digest == long_parent.summary.content_digest
    assert (checked := verify(branch.recording)).sound, checked.finding
    used = {body for _, body, _ in packed_steps(branch)}
    assert [body in used for _, body, _ in packed_steps(copy)[:3]] == [
        bool(options.keys() & {"damaged", "altered", "forged"}) and k != 1 for k in range(3)
    ]


def test_a_parent_with_a_hole_or_without_an_end_serves_as_far_as_it_goes(long_parent, tmp_path):
    cut = repacked(long_parent, tmp_path / "cut")
    places = [place for place, _, _ in packed_steps(cut)]
    data = cut.recording.read_bytes()
    cut.recording.write_bytes(data[: places[5] + 50])
    hole = repacked(long_parent, tmp_path / "hole", damaged=2)
    assert repair(hole.recording).lost
    for run in (cut, hole):
        branch = branch_training(run, at=int(training(run)["step"][-1]), recordings=tmp_path).run
        assert branch.summary.content_digest == long_parent.summary.content_digest
        assert (checked := verify(branch.recording)).sound, checked.finding
        assert shared_chunks(branch, run) >= 3
