"""An upload becomes a complete run or nothing: in pieces, twice, after a restart, damaged, hostile."""

from __future__ import annotations

import json
import os
import shutil
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
from blake3 import blake3

from runner.config.job import Job
from runner.errors import RunnerError, RunNotFound, StorageError
from runner.execution.resume import resume
from runner.execution.session import run_job
from runner.export.mcap import export_mcap
from runner.recording.labels import Labels, change_labels
from runner.runs.listing import list_runs
from runner.runs.resolve import find_run
from runner.runs.run import create_run
from runner.service.errors import TooManyUploads, UploadConflict, UploadTooLarge
from runner.service.settings import Limits
from runner.service.upload import Announcement, Completion
from runner.service.uploads import FOLDER, Uploads
from tests.runner.recording.making import TAXIS, experiment, make_run, stopping_after, with_id
from tests.waiting import until

ANNA, BEN = "anna", "ben"


@pytest.fixture
def uploads(tmp_path):
    made = Uploads(tmp_path / "runs", Limits(spare_bytes=0))
    yield made
    made.close()


def completion(data: bytes, **details) -> Completion:
    return Completion(digest=blake3(data).hexdigest(), size=len(data), run=details)


def announced(data: bytes, **more) -> Announcement:
    return Announcement(digest=blake3(data).hexdigest(), size=len(data), **more)


def send(uploads, data, owner=ANNA, whole=None, **details):
    """Upload bytes in one go, and return the upload when its verification is over."""
    upload, _ = uploads.begin(owner, announced(data))
    uploads.append(upload.id, owner, 0, data)
    return over(uploads, uploads.complete(upload.id, owner, whole or completion(data, **details)))


def over(uploads, upload):
    return until(lambda upload: upload.state != "verifying", lambda: uploads.get(upload.id, upload.owner))


def visible(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.name[0] != ".")


def test_a_recording_becomes_its_run(uploads, taxis, tmp_path):
    data = taxis.recording.read_bytes()
    upload, new = uploads.begin(ANNA, announced(data))
    assert new
    for offset in range(0, len(data), 10_000):
        piece = data[offset : offset + 10_000]
        assert uploads.append(upload.id, ANNA, offset, piece).offset == offset + len(piece)
    assert uploads.get(upload.id, ANNA).offset == len(data)
    assert list_runs(tmp_path / "runs") == []
    seconds = taxis.summary["seconds"]
    verifying = uploads.complete(
        upload.id, ANNA, completion(data, summary={"seconds": seconds}, name="taxis")
    )
    assert verifying.state == "verifying"
    assert over(uploads, verifying).run_id == taxis.run_id
    run = find_run(taxis.run_id, tmp_path / "runs")
    assert {key: value for key, value in taxis.facts.items() if key != "owner"} == run.facts
    assert run.recording.read_bytes() == data
    assert sorted(path.name for path in run.folder.iterdir()) == ["recording.mcap", "run.json"]
    assert not (tmp_path / "runs" / FOLDER / upload.id / "body").exists()


def test_an_exported_recording_is_stored_with_its_labels(uploads, lake, tmp_path):
    shutil.copytree(lake.folder, tmp_path / "mine" / lake.run_id)
    run = find_run(lake.run_id, tmp_path / "mine")
    change_labels(run.folder, lambda labels: replace(labels, tags=("good",), note="seen"))
    data = export_mcap(run, tmp_path / "a.mcap").path.read_bytes()
    stored = send(uploads, data)
    assert (stored.state, stored.run_id) == ("stored", lake.run_id)
    assert find_run(lake.run_id, tmp_path / "runs").labels == Labels("", ("good",), "seen")


def test_the_same_bytes_are_the_same_upload_and_the_same_run(uploads, lake, tmp_path):
    data = lake.recording.read_bytes()
    first, _ = uploads.begin(ANNA, announced(data))
    assert uploads.begin(ANNA, announced(data)) == (first, False)
    assert uploads.begin(BEN, announced(data))[1], "another's upload is not handed out"
    done = send(uploads, data)
    known, new = uploads.begin(ANNA, announced(data))
    assert (known.id, known.already, new) == (done.id, True, False)
    again = uploads.complete(done.id, ANNA, completion(data))
    assert again == done
    others = send(uploads, data, BEN)
    assert (others.state, others.already) == ("stored", True)
    digest = lake.summary["content_digest"]
    known, _ = uploads.begin("carl", Announcement(run_id=lake.run_id, content_digest=digest))
    assert (known.state, known.already) == ("stored", True)
    assert visible(tmp_path / "runs") == [lake.run_id]
    shutil.rmtree(tmp_path / "runs" / lake.run_id)
    fresh, new = uploads.begin(ANNA, announced(data))
    assert (new, fresh.state) == (True, "receiving"), "a run that was removed can be sent again"


def test_received_bytes_outlive_the_server(lake, tmp_path):
    data = lake.recording.read_bytes()
    first = Uploads(tmp_path / "runs")
    upload, _ = first.begin(ANNA, announced(data))
    first.append(upload.id, ANNA, 0, data[:5_000], len(data) - 5_000)
    with pytest.raises(RunnerError, match="is served by another process already"):
        Uploads(tmp_path / "runs")
    first.close()
    second = Uploads(tmp_path / "runs")
    known, new = second.begin(ANNA, announced(data))
    assert (known.id, new, known.offset) == (upload.id, False, 5_000)
    second.append(upload.id, ANNA, 5_000, data[5_000:])
    second.complete(upload.id, ANNA, completion(data))
    second.close()  # while it verifies
    third = Uploads(tmp_path / "runs")
    assert over(third, upload).run_id == lake.run_id
    third.close()


def test_a_repeated_verification_has_the_same_result(uploads, lake, tmp_path):
    data = lake.recording.read_bytes()
    stored = send(uploads, data)
    folder = tmp_path / "runs" / FOLDER / stored.id
    state = json.loads((folder / "upload.json").read_text())
    uploads.close()
    (folder / "upload.json").write_text(json.dumps(state | {"state": "verifying", "run_id": ""}))
    (folder / "body").write_bytes(data)
    again = Uploads(tmp_path / "runs")
    known = over(again, stored)
    assert (known.state, known.run_id, known.already) == ("stored", lake.run_id, True)
    again.close()


def altered(data: bytes) -> bytes:
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :]


@pytest.mark.parametrize(
    "change",
    [
        altered,
        lambda data: b"",
        lambda data: b"PK\x03\x04" + bytes(10_000),
        lambda data: data[:8] + bytes(5_000),
        lambda data: data.replace(b"/train/step", b"/train/stop"),
    ],
    ids=["altered", "empty", "a zip", "a magic and nothing", "other names"],
)
def test_an_unsound_recording_is_refused_and_leaves_nothing(uploads, lake, tmp_path, change):
    refused = send(uploads, change(lake.recording.read_bytes()))
    assert refused.state == "refused"
    assert refused.problem.startswith("the upload: ")
    assert str(tmp_path) not in refused.problem
    assert visible(tmp_path / "runs") == []
    assert not (tmp_path / "runs" / FOLDER / refused.id / "body").exists()
    again, new = uploads.begin(ANNA, announced(change(lake.recording.read_bytes())))
    assert new, "it can be sent again"
    assert again.id != refused.id


def test_bytes_changed_in_transit_are_refused(uploads, lake):
    data = lake.recording.read_bytes()
    upload, _ = uploads.begin(ANNA, announced(data))
    uploads.append(upload.id, ANNA, 0, altered(data))
    refused = over(uploads, uploads.complete(upload.id, ANNA, completion(data)))
    assert "another digest" in refused.problem


def test_another_run_of_the_same_id_is_not_replaced(uploads, lake, taxis, tmp_path):
    shutil.copytree(taxis.folder, tmp_path / "runs" / lake.run_id)
    facts = json.loads((tmp_path / "runs" / lake.run_id / "run.json").read_text())
    (tmp_path / "runs" / lake.run_id / "run.json").write_text(json.dumps(facts | {"run_id": lake.run_id}))
    refused = send(uploads, lake.recording.read_bytes())
    assert "another run" in refused.problem
    assert find_run(lake.run_id, tmp_path / "runs").recording.read_bytes() == taxis.recording.read_bytes()


def test_a_truncated_run_is_stored_as_interrupted(uploads, taxis, tmp_path):
    data = taxis.recording.read_bytes()[:-3_000]
    stored = send(uploads, data, status="interrupted")
    assert stored.run_id == taxis.run_id, stored.problem
    assert find_run(taxis.run_id, tmp_path / "runs").status == "interrupted"


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """Return an interrupted run, and the same one resumed to its end."""
    folder = tmp_path_factory.mktemp("stopped")
    config = experiment(TAXIS, episodes=400)
    run = run_job(Job(config, 0), create_run(folder, config, 0), stop=stopping_after(31))
    assert run.status == "interrupted"
    early = find_run(shutil.copytree(run.folder, folder / "early" / run.run_id).as_posix(), folder)
    return early, resume(run)


def test_a_resumed_run_replaces_its_beginning(uploads, stopped, tmp_path):
    early, whole = stopped
    assert send(uploads, early.recording.read_bytes(), status="interrupted").state == "stored"
    there = tmp_path / "runs" / early.run_id
    change_labels(there, lambda _: Labels("mine", ("here",), "seen"))
    data = whole.recording.read_bytes()
    more = completion(data, status="finished").model_copy(
        update={"labels": {"name": "yours", "tags": ["there"], "note": "other"}}
    )
    stored = send(uploads, data, whole=more)
    assert (stored.state, stored.problem, stored.already) == ("stored", "", False)
    run = find_run(whole.run_id, tmp_path / "runs")
    assert run.status == "finished"
    assert [run.summary[key] for key in ("content_digest", "bytes")] == [
        whole.summary[key] for key in ("content_digest", "bytes")
    ]
    assert run.recording.read_bytes() == data
    assert run.labels == Labels("mine", ("here", "there"), "seen")
    assert visible(tmp_path / "runs") == [run.run_id]
    assert not list(there.glob(".*"))
    older = send(uploads, early.recording.read_bytes()[:-1], status="interrupted")
    assert (older.state, older.problem, older.already) == ("stored", "", True)
    assert find_run(whole.run_id, tmp_path / "runs").recording.read_bytes() == data


def test_a_run_that_does_not_continue_another_replaces_nothing(uploads, stopped, tmp_path):
    early, _ = stopped
    cut = early.recording.read_bytes()[:-40_000]
    assert send(uploads, cut, status="finished").state == "stored"
    run = find_run(early.run_id, tmp_path / "runs")
    assert run.status == "interrupted"
    assert send(uploads, cut, BEN, status="finished").already
    assert find_run(early.run_id, tmp_path / "runs").status == "interrupted"
    other = make_run(tmp_path / "other", TAXIS, seed=1)
    facts = json.loads((run.folder / "run.json").read_text())
    fake = with_id(run.run_id, other.recording, tmp_path / "fake.mcap")
    assert "another run" in send(uploads, fake.read_bytes(), status="finished").problem
    assert run.recording.read_bytes() == cut
    assert json.loads((run.folder / "run.json").read_text()) == facts


def test_an_interrupted_replacement_is_completed_by_a_second_upload(uploads, stopped, tmp_path):
    early, whole = stopped
    assert send(uploads, early.recording.read_bytes(), status="interrupted").state == "stored"
    there = find_run(early.run_id, tmp_path / "runs")
    shutil.copy(whole.recording, there.recording)  # and killed before run.json was updated
    assert send(uploads, whole.recording.read_bytes(), status="finished").already
    assert find_run(early.run_id, tmp_path / "runs").status == "finished"


def test_wrong_requests_of_a_client_are_refused(uploads, lake):
    data = lake.recording.read_bytes()
    upload, _ = uploads.begin(ANNA, announced(data))
    with pytest.raises(RunNotFound):
        uploads.get(upload.id, BEN)
    with pytest.raises(RunNotFound):
        uploads.append("../" + upload.id, ANNA, 0, b"1")
    with pytest.raises(UploadConflict, match="expected 0"):
        uploads.append(upload.id, ANNA, 7, b"1")
    with pytest.raises(UploadTooLarge):
        uploads.append(upload.id, ANNA, 0, b"", len(data) + 1)
    with pytest.raises(UploadTooLarge):
        uploads.append(upload.id, ANNA, 0, data + b"more")
    assert uploads.get(upload.id, ANNA).offset == 0
    with pytest.raises(UploadConflict, match="found 0 bytes"):
        uploads.complete(upload.id, ANNA, completion(data))
    assert uploads.append(upload.id, ANNA, 0, data).offset == len(data)
    with pytest.raises(UploadConflict, match=f"expected {len(data):,}"):
        uploads.append(upload.id, ANNA, 0, data)
    other = completion(data).model_copy(update={"digest": "0" * 64})
    with pytest.raises(UploadConflict, match="another digest"):
        uploads.complete(upload.id, ANNA, other)


def test_uploads_beyond_the_limits_are_refused(lake, tmp_path):
    uploads = Uploads(tmp_path / "runs", Limits(upload_bytes=1_000, uploads=2))
    with pytest.raises(UploadTooLarge, match="1,000"):
        uploads.begin(ANNA, Announcement(size=1_001))
    first, _ = uploads.begin(ANNA, Announcement())
    with pytest.raises(UploadTooLarge):
        uploads.append(first.id, ANNA, 0, bytes(1_001))
    uploads.begin(ANNA, Announcement())
    with pytest.raises(TooManyUploads):
        uploads.begin(BEN, Announcement())
    uploads.delete(first.id, ANNA)
    uploads.begin(BEN, Announcement())
    uploads.close()
    full = Uploads(tmp_path / "full", Limits(spare_bytes=1 << 60))
    with pytest.raises(StorageError, match="room for 0 bytes"):
        full.begin(ANNA, Announcement(size=10))
    full.close()


def test_a_full_disk_keeps_what_is_there(uploads, lake, monkeypatch):
    data = lake.recording.read_bytes()
    upload, _ = uploads.begin(ANNA, announced(data))
    real, room = os.write, [6_000]

    def full(descriptor, view):
        if room[0] == 0:
            raise OSError(28, "No space left on device")
        written = real(descriptor, view[: room[0]])
        room[0] -= written
        return written

    monkeypatch.setattr("runner.service.uploads.os.write", full)
    with pytest.raises(StorageError, match="No space left"):
        uploads.append(upload.id, ANNA, 0, data)
    monkeypatch.undo()
    assert uploads.get(upload.id, ANNA).offset == 6_000
    uploads.append(upload.id, ANNA, 6_000, data[6_000:])
    assert over(uploads, uploads.complete(upload.id, ANNA, completion(data))).state == "stored"


def test_the_disk_reserve_holds_for_uploads_of_unknown_size(tmp_path, monkeypatch):
    uploads = Uploads(tmp_path / "runs", Limits(spare_bytes=5_000))
    upload, _ = uploads.begin(ANNA, Announcement())
    free = iter((7_000, 6_000))
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr("runner.service.uploads.shutil.disk_usage", lambda _: usage._replace(free=next(free)))
    uploads.append(upload.id, ANNA, 0, bytes(2_000))
    with pytest.raises(StorageError, match="room for 1,000 bytes"):
        uploads.append(upload.id, ANNA, 2_000, bytes(2_000))
    assert uploads.get(upload.id, ANNA).offset == 2_000
    uploads.close()


def test_a_limited_number_of_results_is_remembered(lake, tmp_path):
    shutil.copytree(lake.folder, tmp_path / "runs" / lake.run_id)
    uploads = Uploads(tmp_path / "runs", Limits(uploads=3))
    for number in range(9):
        known = {"run_id": lake.run_id, "content_digest": lake.summary["content_digest"]}
        upload, _ = uploads.begin(ANNA, Announcement(digest=f"{number:064}", **known))
        assert upload.state == "stored"
    assert len(uploads.all()) == len(list((tmp_path / "runs" / FOLDER).glob("*/upload.json"))) == 4
    assert uploads.get(upload.id, ANNA).already
    uploads.close()


def test_old_results_and_abandoned_uploads_are_forgotten(lake, tmp_path):
    uploads = Uploads(tmp_path / "runs")
    stored = send(uploads, lake.recording.read_bytes())
    idle, _ = uploads.begin(ANNA, Announcement(name="idle"))
    fresh, _ = uploads.begin(ANNA, Announcement(name="fresh"))
    uploads.close()
    for upload, days in ((stored, 2), (idle, 8)):
        folder = tmp_path / "runs" / FOLDER / upload.id
        state = json.loads((folder / "upload.json").read_text())
        (folder / "upload.json").write_text(json.dumps(state | {"created": "2020-01-01T00:00:00.000+00:00"}))
        for path in folder.iterdir():
            os.utime(path, (time.time() - days * 86400,) * 2)
    (tmp_path / "runs" / FOLDER / ("0" * 32)).mkdir()
    again = Uploads(tmp_path / "runs")
    assert [upload.id for upload in again.all()] == [fresh.id]
    assert [path.name for path in (tmp_path / "runs" / FOLDER).iterdir() if path.is_dir()] == [fresh.id]
    assert visible(tmp_path / "runs") == [lake.run_id]
    again.close()


def test_removing_an_upload_does_not_block_others(uploads, lake, monkeypatch):
    """The event loop of the server reads uploads: it must not wait for the disk."""
    data, go_on = lake.recording.read_bytes(), threading.Event()
    given_up, _ = uploads.begin(ANNA, Announcement(name="given up"))
    upload, _ = uploads.begin(ANNA, announced(data))
    monkeypatch.setattr("runner.service.uploads.shutil.rmtree", lambda *_, **__: go_on.wait(60))
    with ThreadPoolExecutor(2) as threads:
        removal = threads.submit(uploads.delete, given_up.id, ANNA)
        try:
            until(lambda known: len(known) == 1, uploads.all)
            assert threads.submit(uploads.get, upload.id, ANNA).result(20) == upload
            assert not removal.done()
        finally:
            go_on.set()


def test_an_upload_whose_verification_fails_unexpectedly_can_be_completed_again(uploads, lake, monkeypatch):
    data = lake.recording.read_bytes()
    with monkeypatch.context() as broken:
        broken.setattr("runner.service.processes.ChildProcess", lambda *_: json.loads("no process"))
        failed = send(uploads, data)
    assert failed.state == "receiving"
    assert failed.problem == "something unexpected went wrong while it was verified; complete it again."
    again = uploads.complete(failed.id, ANNA, completion(data))
    assert over(uploads, again).state == "stored"


def test_one_client_cannot_hold_all_uploads(tmp_path):
    uploads = Uploads(tmp_path / "runs", Limits(uploads=3, uploads_each=2))
    for _ in range(2):
        uploads.begin(ANNA, Announcement())
    with pytest.raises(TooManyUploads, match="2 of your uploads are open"):
        uploads.begin(ANNA, Announcement())
    uploads.begin(BEN, Announcement())
    with pytest.raises(TooManyUploads, match="3 uploads are open"):
        uploads.begin(BEN, Announcement())
    uploads.close()
