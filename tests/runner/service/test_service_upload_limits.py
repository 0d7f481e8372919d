"""The limits of uploads: of bytes, disk, time and number."""

from __future__ import annotations

import json
import os
import shutil
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from uploading import ANNA, BEN, begin, grow, over, send, start, visible

from runner.errors import StorageError
from runner.service.errors import Busy, LimitReached, UploadTooLarge
from runner.service.settings import ServiceLimits
from runner.service.uploads import FOLDER, Uploads
from tests.waiting import until


def test_uploads_beyond_the_limits_are_refused(lake, tmp_path):
    uploads = start(tmp_path / "runs", upload_bytes=1_000, uploads=2)
    with pytest.raises(UploadTooLarge, match="1,000"):
        grow(uploads, ANNA, size=1_001)
    first = grow(uploads, ANNA)
    with pytest.raises(UploadTooLarge):
        uploads.append(ANNA, first.id, 0, bytes(1_001))
    grow(uploads, ANNA)
    with pytest.raises(LimitReached):
        grow(uploads, BEN)
    uploads.delete(ANNA, first.id)
    grow(uploads, BEN)
    uploads.close()
    full = start(tmp_path / "full", spare_bytes=1 << 60)
    with pytest.raises(StorageError, match="room for 0 bytes"):
        grow(full, ANNA, size=10)
    full.close()


def test_a_full_disk_keeps_what_is_there(uploads, lake, monkeypatch):
    data = lake.recording.read_bytes()
    upload = begin(uploads, ANNA, data)
    real, room = os.write, [6_000]

    def full(descriptor, view):
        if room[0] == 0:
            raise OSError(28, "No space left on device")
        written = real(descriptor, view[: room[0]])
        room[0] -= written
        return written

    monkeypatch.setattr("runner.service.uploads.os.write", full)
    with pytest.raises(StorageError, match="No space left"):
        uploads.append(ANNA, upload.id, 0, data)
    monkeypatch.undo()
    assert uploads.get(ANNA, upload.id).offset == 6_000
    assert over(uploads, uploads.append(ANNA, upload.id, 6_000, data[6_000:])).state == "stored"


def test_the_disk_reserve_holds_for_uploads_of_unknown_size(tmp_path, monkeypatch):
    uploads = start(tmp_path / "runs", spare_bytes=5_000)
    upload = grow(uploads, ANNA)
    free = iter((7_000, 6_000))
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr("runner.service.uploads.shutil.disk_usage", lambda _: usage._replace(free=next(free)))
    uploads.append(ANNA, upload.id, 0, bytes(2_000))
    with pytest.raises(StorageError, match="room for 1,000 bytes"):
        uploads.append(ANNA, upload.id, 2_000, bytes(2_000))
    assert uploads.get(ANNA, upload.id).offset == 2_000
    uploads.close()


def test_an_upload_of_what_is_here_leaves_nothing(lake, tmp_path):
    shutil.copytree(lake.folder, tmp_path / "runs" / lake.run_id)
    uploads = start(tmp_path / "runs", uploads=3)
    for _ in range(9):
        upload = grow(uploads, ANNA, run_id=lake.run_id, content_digest=lake.summary["content_digest"])
        assert (upload.state, upload.already) == ("stored", True)
    assert uploads.all() == list((tmp_path / "runs" / FOLDER).glob("*/upload.json")) == []
    uploads.close()


def test_idle_uploads_are_dropped(lake, tmp_path):
    uploads = start(tmp_path / "runs")
    stored = send(uploads, lake.recording.read_bytes())
    idle, fresh = grow(uploads, ANNA, name="idle"), grow(uploads, ANNA, name="fresh")
    uploads.close()
    for upload, days in ((stored, 8), (idle, 8)):
        folder = tmp_path / "runs" / FOLDER / upload.folder
        state = json.loads((folder / "upload.json").read_text())
        (folder / "upload.json").write_text(json.dumps(state | {"created": "2020-01-01T00:00:00.000+00:00"}))
        for path in folder.iterdir():
            os.utime(path, (time.time() - days * 86400,) * 2)
    (tmp_path / "runs" / FOLDER / ("0" * 32)).mkdir()
    again = start(tmp_path / "runs")
    assert [upload.id for upload in again.all()] == [fresh.id]
    assert [path.name for path in (tmp_path / "runs" / FOLDER).iterdir() if path.is_dir()] == [fresh.folder]
    assert visible(tmp_path / "runs") == [lake.run_id]
    again.close()


def test_removing_an_upload_does_not_block_others(uploads, lake, monkeypatch):
    """The event loop of the server reads uploads: it must not wait for the disk."""
    data, go_on = lake.recording.read_bytes(), threading.Event()
    given_up, upload = grow(uploads, ANNA, name="given up"), begin(uploads, ANNA, data)
    monkeypatch.setattr("runner.service.uploads.shutil.rmtree", lambda *_, **__: go_on.wait(60))
    with ThreadPoolExecutor(2) as threads:
        removal = threads.submit(uploads.delete, ANNA, given_up.id)
        try:
            until(lambda known: len(known) == 1, uploads.all)
            assert threads.submit(uploads.get, ANNA, upload.id).result(20) == upload
            assert not removal.done()
        finally:
            go_on.set()


def test_an_upload_whose_verification_fails_unexpectedly_can_be_completed_again(uploads, lake, monkeypatch):
    data = lake.recording.read_bytes()
    with monkeypatch.context() as broken:
        broken.setattr("runner.service.processes.ChildProcess", lambda *_: json.loads("no process"))
        failed = send(uploads, data)
    assert failed.state == "receiving"
    assert failed.problem == "something unexpected went wrong while it was verified; try again."
    with pytest.raises(Busy, match="went wrong"):
        begin(uploads, ANNA, data)
    assert over(uploads, begin(uploads, ANNA, data)).state == "stored"


def test_an_upload_is_stored_although_a_report_of_it_fails(lake, tmp_path):
    def fail(upload):
        raise RuntimeError(upload.id)

    uploads = Uploads(tmp_path / "runs", ServiceLimits(spare_bytes=0), fail)
    assert send(uploads, lake.recording.read_bytes()).state == "stored"
    uploads.close()


def test_one_client_cannot_hold_all_uploads(tmp_path):
    uploads = start(tmp_path / "runs", uploads=3, uploads_each=2)
    for _ in range(2):
        grow(uploads, ANNA)
    with pytest.raises(LimitReached, match="2 of your uploads are open"):
        grow(uploads, ANNA)
    grow(uploads, BEN)
    with pytest.raises(LimitReached, match="3 uploads are open"):
        grow(uploads, BEN)
    uploads.close()
