"""Runs that were cut off or damaged end as if nothing had happened; living ones are left alone."""

from __future__ import annotations

import errno
import json
import os
import time

import pytest

from runner.config import from_mapping
from runner.config.model import Job
from runner.errors import Diverged, RunnerError, StorageError
from runner.execution import verify
from runner.execution.rerecord import evaluate
from runner.execution.resume import resume
from runner.execution.session import run_job
from runner.recording.integrity import survey
from runner.recording.reader import open_recording
from runner.recording.repair import repair
from runner.recording.schema import TRAIN_STEP
from runner.recording.writer import RecordingFile
from runner.runs import provenance
from runner.runs import run as runs
from runner.runs.resolve import find_run
from runner.runs.run import Run, create_run, list_runs, locked
from tests.runner.recording.making import SAMPLED, TAXIS, copy_of, make_run, stopping_after

# --- every state that a file can be in ----------------------------------------------------------------


@pytest.fixture
def whole(taxis):
    """A finished run, not to be changed."""
    return taxis


def cut(run: Run, size: int) -> None:
    """Cut a run's recording off."""
    os.truncate(run.recording, size)


def assert_same(done: Run, whole: Run) -> None:
    """Assert that a run ended as one that was never interrupted."""
    assert done.status == find_run(str(done.folder), done.folder).status == "finished"
    assert done.summary["content_digest"] == whole.summary["content_digest"]
    found = verify.verify(done.recording)
    assert found.sound, found.finding
    assert found.content_digest == whole.summary["content_digest"]
    files = {path.name for path in done.folder.iterdir()}
    assert files <= {"run.json", "recording.mcap", "owner.lock", "trust.json"}


@pytest.mark.parametrize("share", [0, 1e-4, 0.05, 0.2, 0.4, 0.6, 0.75, 0.9, 0.97, 0.99, 0.9999])
def test_cut_off_anywhere(whole, tmp_path, share):
    run = copy_of(whole, tmp_path, summary={})
    cut(run, int(share * run.recording.stat().st_size))
    assert_same(resume(run), whole)


def test_progress_of_a_resumed_run_begins_with_what_is_recorded(whole, tmp_path):
    run = copy_of(whole, tmp_path, summary={})
    cut(run, int(0.97 * run.recording.stat().st_size))
    with open_recording(run.recording) as recording:
        recorded = recording.done()
    seen = []
    resume(run, report=lambda progress: seen.append((progress.episode, progress.train_steps)))
    assert seen == sorted(seen)
    assert recorded["episodes"] <= seen[0][0]
    assert 0 < recorded["train_steps"] <= seen[0][1]
    assert seen[-1] == (whole.summary["episodes"], whole.summary["train_steps"])


@pytest.mark.parametrize(
    "config",
    [
        pytest.param({"recording": {"steps": "none", "chunk_steps": 256}}, id="without steps"),
        pytest.param({"recording": {"index": "chunk", "compression": "lz4"}}, id="chunk index"),
        pytest.param({"initial_q": "random", "algorithm": "random", **SAMPLED}, id="random"),
        pytest.param({"evaluation": None, "log": None}, id="training only"),
        pytest.param({"mode": "cooperative", "recording": {"compression": "none"}}, id="one table"),
    ],
)
def test_cut_off_whatever_is_recorded(tmp_path, config):
    whole = make_run(tmp_path / "whole", TAXIS | config)
    for number, share in enumerate((0.3, 0.7, 0.95)):
        run = copy_of(whole, tmp_path / str(number), summary={})
        cut(run, int(share * run.recording.stat().st_size))
        assert_same(resume(run), whole)


def test_several_seeds_differ_and_each_is_resumed(tmp_path):
    digests = set()
    for seed in (1, 2):
        whole = make_run(tmp_path / "whole", TAXIS, seed=seed)
        run = copy_of(whole, tmp_path / "cut", summary={})
        cut(run, run.recording.stat().st_size // 2)
        assert_same(resume(run), whole)
        digests.add(whole.summary["content_digest"])
    assert len(digests) == 2


def test_an_evaluation_of_a_recorded_table(whole, tmp_path):
    source = copy_of(whole, tmp_path, "finished")
    evaluated = evaluate(source, tmp_path, trials=40)
    assert evaluated.facts["config"]["initial_q"] == {
        "run": source.run_id,
        "step": source.summary["train_steps"],
    }
    run = copy_of(evaluated, tmp_path / "cut", summary={})
    cut(run, run.recording.stat().st_size // 2)
    assert_same(resume(run), evaluated)  # though the source is not in that folder


def test_stopped_and_resumed_step_by_step(whole, tmp_path):
    config = from_mapping(whole.facts["config"])
    run, stops = create_run(tmp_path, config, 0), 0
    run = run_job(Job(config, 0), run, stop=stopping_after(3))
    while run.status == "interrupted" and stops < 100:
        stops += 1
        run = resume(run, stop=stopping_after(3 + 4 * stops))
    assert stops > 3
    assert_same(run, whole)


def test_a_stop_while_it_catches_up_loses_nothing(whole, tmp_path):
    run = copy_of(whole, tmp_path, summary={})
    cut(run, int(0.8 * run.recording.stat().st_size))
    good = survey(run.recording).chunks  # the last chunk may lack its index; it comes again
    steps = sum(part.messages for part in good if part.channel == TRAIN_STEP.channel)
    stopped = resume(run, stop=stopping_after(2))
    assert stopped.status == "interrupted"
    assert stopped.summary["train_steps"] == steps > 0
    assert stopped.summary["content_digest"] is None
    with open_recording(run.recording) as recording:
        assert recording.file.finished
        assert recording.train.steps.count() == steps == recording.result["train_steps"]
    assert_same(resume(stopped), whole)


# --- damage ---------------------------------------------------------------------------------------------


def damage(run: Run, share: float) -> None:
    """Turn a byte around in one of the chunks of training steps."""
    parts = [part for part in survey(run.recording).chunks if part.channel == TRAIN_STEP.channel]
    chunk = parts[int(share * len(parts))]
    data = bytearray(run.recording.read_bytes())
    data[chunk.offset + chunk.length - 99] ^= 0x55
    run.recording.write_bytes(data)


@pytest.mark.parametrize(
    ("share", "repaired"),
    [(1, True), (0.9, True), (0.9, False)],  # a hole in a whole one is found by repair only
)
def test_a_hole_is_filled_by_a_new_recording(whole, tmp_path, share, repaired):
    run = copy_of(whole, tmp_path, "interrupted", proof=None)
    cut(run, int(share * run.recording.stat().st_size))
    damage(run, 0.5)
    if repaired:
        assert repair(run.recording).lost
    before = run.recording.read_bytes()
    stopped = resume(run, stop=stopping_after(6))
    assert stopped.status == "interrupted"
    assert run.recording.read_bytes() == before
    first = run.recording.with_suffix(".resuming").stat().st_size
    stopped = resume(run, stop=stopping_after(12))
    assert run.recording.with_suffix(".resuming").stat().st_size > first
    done = resume(stopped)
    for path in done.folder.glob("*.damaged-*"):
        path.unlink()
    assert_same(done, whole)


def test_a_known_digest_is_a_proof(whole, tmp_path):
    run = copy_of(whole, tmp_path, proof="0" * 64)
    damage(run, 0.5)
    repair(run.recording)
    before = run.recording.read_bytes()
    with pytest.raises(Diverged, match="content digest"):
        resume(run)
    assert run.recording.read_bytes() == before


def test_description_damaged(whole, tmp_path):
    run = copy_of(whole, tmp_path, summary={})
    cut(run, int(0.97 * run.recording.stat().st_size))
    data = bytearray(run.recording.read_bytes())
    at = data.index(b"format_version")
    data[at - 30 : at + 30] = bytes(60)
    run.recording.write_bytes(data)
    assert_same(resume(run), whole)


@pytest.mark.parametrize("provenance", [None, ["host"], "host", {"host": "here", "git": 3}])
def test_a_damaged_provenance_in_the_run_file_costs_no_run(whole, tmp_path, provenance):
    run = copy_of(whole, tmp_path, provenance=provenance)
    cut(run, whole.recording.stat().st_size // 2)
    done = resume(run)
    assert_same(done, whole)
    assert done.file.problems == ()
    assert done.file.provenance.get("host") == ("here" if isinstance(provenance, dict) else None)


@pytest.mark.parametrize("more", [bytes(5000), b"\x06" + b"\xff" * 40, b"hello"])
def test_bytes_after_the_end(whole, tmp_path, more):
    run = copy_of(whole, tmp_path, summary={})
    with run.recording.open("ab") as stream:
        stream.write(more)
    assert_same(resume(run), whole)
    cut(run, int(0.7 * run.recording.stat().st_size))
    with run.recording.open("ab") as stream:
        stream.write(more)
    assert_same(resume(run.update(status="failed")), whole)


def test_without_recording_or_run_file(whole, tmp_path):
    run = copy_of(whole, tmp_path / "a", "finished")
    run.recording.unlink()
    assert_same(resume(run), whole)
    run = copy_of(whole, tmp_path / "b")
    cut(run, run.recording.stat().st_size // 2)
    (run.folder / "run.json").unlink()
    (found,) = list_runs(tmp_path / "b")
    assert found.status == "interrupted"
    assert_same(resume(found), whole)


def test_a_recording_that_stands_alone_is_no_run(whole, tmp_path):
    path = tmp_path / "alone.mcap"
    path.write_bytes(whole.recording.read_bytes()[:-100])
    with pytest.raises(RunnerError, match="folder of its own"):
        resume(find_run(str(path), tmp_path))
    assert [one.name for one in tmp_path.iterdir()] == ["alone.mcap"]


def test_a_finished_recording_whose_run_file_says_otherwise(whole, tmp_path):
    run = copy_of(whole, tmp_path, "running", owner={"host": "elsewhere"}, summary={})
    os.utime(run.folder / "run.json", (0, 0))
    before = run.recording.stat()
    done = resume(run)
    assert done.status == "finished"
    assert done.summary["content_digest"] == whole.summary["content_digest"]
    assert run.recording.stat().st_mtime_ns == before.st_mtime_ns


def test_another_seed_is_not_resumed(whole, tmp_path):
    other = make_run(tmp_path / "other", TAXIS, seed=1)
    run = copy_of(other, tmp_path, summary={})
    cut(run, int(0.7 * run.recording.stat().st_size))
    recorded = run.recording.read_bytes()
    entry = b"\x04\0\0\0seed\x01\0\0\0"
    assert recorded.count(entry + b"1") == 1
    run.recording.write_bytes(recorded.replace(entry + b"1", entry + b"0"))
    with pytest.raises(Diverged, match="metadata run: job"):
        resume(run.update(seed=0))
    assert_same(resume(run.update(seed=1)), other)  # run.json knows better


@pytest.mark.parametrize("room", [0, 1000, 30_000, 60_000, 100_000])
def test_after_a_full_disk(whole, tmp_path, monkeypatch, room):
    config = from_mapping(whole.facts["config"])
    run = create_run(tmp_path, config, 0)
    write = RecordingFile._append

    def filling(file, data):
        if file.size + len(data) > room:
            write(file, data[: max(room - file.size, 0)])
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(file, data)

    with monkeypatch.context() as patch:
        patch.setattr(RecordingFile, "_append", filling)
        with pytest.raises(StorageError, match="No space left") as full:
            run_job(Job(config, 0), run)
        if run.recording.exists():
            assert f"`dualtaxi resume {run.run_id}`" in "".join(full.value.__notes__)
        assert find_run(run.run_id, tmp_path).status == "failed"
        with pytest.raises(StorageError, match="No space left"):  # it is still full
            resume(find_run(run.run_id, tmp_path))
        assert find_run(run.run_id, tmp_path).status == "failed"
    assert_same(resume(find_run(run.run_id, tmp_path)), whole)


# --- who may go on ----------------------------------------------------------------------------------------


def test_other_versions_are_refused_with_what_differs(whole, tmp_path, monkeypatch):
    run = copy_of(whole, tmp_path, summary={})
    cut(run, run.recording.stat().st_size // 2)
    here = provenance.provenance()
    monkeypatch.setattr(provenance, "provenance", lambda: here | {"package.numpy": "1.0", "host": "another"})
    with pytest.raises(RunnerError, match=r"package\.numpy: \S+ then, 1\.0 now") as refused:
        resume(run)
    assert "--accept-changes" in str(refused.value)
    assert "host" not in str(refused.value)
    done = resume(run, accept_changes=True)
    with open_recording(done.recording) as recording:
        accepted = json.loads(recording.file.metadata("resume/1")["accepted_changes"])
    assert accepted == {"package.numpy": f"{here['package.numpy']} -> 1.0"}
    assert_same(done, whole)


def test_status(whole, tmp_path):
    here = runs.owner()
    run = copy_of(whole, tmp_path, "running", owner=here)

    def status(**owner: object) -> str:
        return run.update(owner=here | owner).status

    assert status() == "running"
    assert status(pid=2**22 + 1) == "interrupted"  # gone
    assert status(process_started=here["process_started"] - 5) == "interrupted"  # its number used again
    assert status(host="elsewhere") == "running"  # just beaten
    assert status(boot_id="before", process_started=1.0) == "running"
    for age, expected in ((5, "running"), (14, "running"), (16, "interrupted"), (10**6, "interrupted")):
        elsewhere = run.update(owner=here | {"host": "elsewhere"})
        os.utime(run.folder / "run.json", (time.time() - age,) * 2)
        assert elsewhere.status == expected
    elsewhere.beat()
    assert elsewhere.status == "running"
    for odd in ({}, {"host": None}, {"host": here["host"], "boot_id": here["boot_id"], "pid": "x"}):
        changed = run.update(owner=odd)
        os.utime(run.folder / "run.json", (0, 0))
        assert changed.status == "interrupted"


def test_a_living_owner_is_left_alone(whole, tmp_path):
    run = copy_of(whole, tmp_path, "running", owner=runs.owner())
    with pytest.raises(RunnerError, match=rf"is running \(process {os.getpid()}"):
        resume(run)
    assert run.recording.read_bytes() == whole.recording.read_bytes()


def test_one_at_a_time(whole, tmp_path):
    run = copy_of(whole, tmp_path)
    with locked(run), pytest.raises(RunnerError, match="another process"):
        resume(run)
    assert resume(run).status == "finished"
