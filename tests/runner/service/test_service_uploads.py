"""An upload becomes a complete run or nothing: in pieces, twice, after a restart, damaged, hostile."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from uploading import ANNA, BEN, begin, grow, over, send, source, start, visible

from runner.config.model import Job
from runner.errors import RunnerError, RunNotFound
from runner.execution.resume import resume
from runner.execution.session import run_job
from runner.export.mcap import export_mcap
from runner.recording.labels import Labels, change_labels
from runner.runs.resolve import find_run
from runner.runs.run import create_run, list_runs
from runner.service.errors import StateConflict, UploadTooLarge
from runner.service.uploads import FOLDER, UploadSource
from tests.runner.recording.making import TAXIS, experiment, make_run, stopping_after, with_id


def test_a_recording_becomes_its_run(uploads, taxis, tmp_path):
    data = taxis.recording.read_bytes()
    upload = grow(uploads, ANNA)
    for offset in range(0, len(data), 10_000):
        piece = data[offset : offset + 10_000]
        assert uploads.append(ANNA, upload.id, offset, piece).offset == offset + len(piece)
    assert uploads.get(ANNA, upload.id).offset == len(data)
    assert list_runs(tmp_path / "runs") == []
    seconds = taxis.summary["seconds"]
    whole = source(data, run={"summary": {"seconds": seconds}, "name": "taxis"})
    verifying = uploads.put(ANNA, upload.id, whole)
    assert verifying.state == "verifying"
    assert over(uploads, verifying).run_id == taxis.run_id
    run = find_run(taxis.run_id, tmp_path / "runs")
    assert {key: value for key, value in taxis.facts.items() if key != "owner"} == run.facts
    assert run.recording.read_bytes() == data
    assert sorted(path.name for path in run.folder.iterdir()) == ["recording.mcap", "run.json"]
    assert bodies(tmp_path) == []


def bodies(folder: Path) -> list[Path]:
    return list((folder / "runs" / FOLDER).rglob("body"))


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
    first = begin(uploads, ANNA, data)
    first = uploads.append(ANNA, first.id, 0, data[:7])
    assert begin(uploads, ANNA, data) == first
    assert begin(uploads, BEN, data).offset == 0, "another's upload is not handed out"
    done = over(uploads, uploads.append(ANNA, first.id, 7, data[7:]))
    assert (done.state, done.already) == ("stored", False)
    digests = {"run_id": lake.run_id, "content_digest": lake.summary["content_digest"]}
    assert begin(uploads, ANNA, data, **digests) == done
    assert [upload.owner for upload in uploads.all()] == [BEN], "its sender knows"
    known = begin(uploads, ANNA, data, **digests)
    assert (known.state, known.run_id, known.already, known.offset) == (
        "stored",
        lake.run_id,
        True,
        len(data),
    )
    others = send(uploads, data, BEN)
    assert (others.state, others.already) == ("stored", True)
    known = grow(uploads, "carl", run_id=lake.run_id, content_digest=lake.summary["content_digest"])
    assert (known.state, known.already) == ("stored", True)
    assert visible(tmp_path / "runs") == [lake.run_id]
    shutil.rmtree(tmp_path / "runs" / lake.run_id)
    fresh = begin(uploads, ANNA, data)
    assert (fresh.state, fresh.offset) == ("receiving", 0), "a run that was removed can be sent again"


def test_received_bytes_outlive_the_server(lake, tmp_path):
    data = lake.recording.read_bytes()
    first = start(tmp_path / "runs")
    upload = begin(first, ANNA, data)
    first.append(ANNA, upload.id, 0, data[:5_000], len(data) - 5_000)
    with pytest.raises(RunnerError, match="is served by another process already"):
        start(tmp_path / "runs")
    first.close()
    second = start(tmp_path / "runs")
    known = begin(second, ANNA, data)
    assert (known.id, known.created, known.offset) == (upload.id, upload.created, 5_000)
    assert second.append(ANNA, upload.id, 5_000, data[5_000:]).state == "verifying"
    second.close()  # while it verifies
    third = start(tmp_path / "runs")
    assert over(third, upload).run_id == lake.run_id
    third.close()


def test_a_repeated_verification_has_the_same_result(uploads, lake, tmp_path):
    data = lake.recording.read_bytes()
    stored = send(uploads, data)
    (path,) = (tmp_path / "runs" / FOLDER).glob("*/upload.json")
    uploads.close()
    path.write_text(json.dumps(json.loads(path.read_text()) | {"state": "receiving", "run_id": ""}))
    path.with_name("body").write_bytes(data)  # killed before the result was saved
    again = start(tmp_path / "runs")
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
    assert bodies(tmp_path) == []
    assert begin(uploads, ANNA, change(lake.recording.read_bytes())) == refused
    uploads.delete(ANNA, refused.id)
    again = begin(uploads, ANNA, change(lake.recording.read_bytes()))
    assert (again.offset, again.problem) == (0, ""), "it can be sent again"


def test_the_results_of_the_newest_uploads_are_kept(tmp_path):
    uploads = start(tmp_path / "runs", uploads=2)
    refused = [send(uploads, bytes([i])) for i in range(5)]
    assert {upload.state for upload in refused} == {"refused"}
    grow(uploads, ANNA)
    assert [upload.id for upload in uploads.all() if upload.is_over] == [refused[4].id, refused[3].id]
    assert len(list((tmp_path / "runs" / FOLDER).glob("*/upload.json"))) == 3
    uploads.close()


def test_bytes_changed_in_transit_are_refused(uploads, lake):
    data = lake.recording.read_bytes()
    upload = begin(uploads, ANNA, data)
    refused = over(uploads, uploads.append(ANNA, upload.id, 0, altered(data)))
    assert "another digest" in refused.problem


def test_another_run_of_the_same_id_is_not_replaced(uploads, lake, taxis, tmp_path):
    shutil.copytree(taxis.folder, tmp_path / "runs" / lake.run_id)
    facts = json.loads((tmp_path / "runs" / lake.run_id / "run.json").read_text())
    (tmp_path / "runs" / lake.run_id / "run.json").write_text(json.dumps(facts | {"run_id": lake.run_id}))
    refused = send(uploads, lake.recording.read_bytes())
    assert "another run" in refused.problem
    assert find_run(lake.run_id, tmp_path / "runs").recording.read_bytes() == taxis.recording.read_bytes()


def test_a_run_that_is_announced_otherwise_later_is_not_left_in_the_list(uploads, lake, tmp_path):
    data = lake.recording.read_bytes()
    upload = grow(uploads, ANNA, run_id=lake.run_id)
    uploads.append(ANNA, upload.id, 0, data)
    assert visible(tmp_path / "runs") == [lake.run_id]
    uploads.put(ANNA, upload.id, UploadSource(run_id="another"))
    assert visible(tmp_path / "runs") == []


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
    stored = send(
        uploads, data, labels={"name": "yours", "tags": ["there"], "note": "other"}, status="finished"
    )
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
    upload = begin(uploads, ANNA, data)
    with pytest.raises(RunNotFound):
        uploads.get(BEN, upload.id)
    with pytest.raises(RunNotFound):
        uploads.append(ANNA, "../" + upload.id, 0, b"1")
    with pytest.raises(StateConflict, match="expected 0"):
        uploads.append(ANNA, upload.id, 7, b"1")
    with pytest.raises(UploadTooLarge):
        uploads.append(ANNA, upload.id, 0, b"", len(data) + 1)
    with pytest.raises(UploadTooLarge):
        uploads.append(ANNA, upload.id, 0, data + b"more")
    assert uploads.get(ANNA, upload.id).offset == 0
    assert begin(uploads, ANNA, data).state == "receiving", "it is not verified without its bytes"
    with pytest.raises(StateConflict, match="another digest"):
        uploads.put(ANNA, upload.id, source(altered(data)))
    assert uploads.append(ANNA, upload.id, 0, data).offset == len(data)
    with pytest.raises(StateConflict, match=f"expected {len(data):,}"):
        uploads.append(ANNA, upload.id, 0, data)


def test_a_file_that_became_shorter_is_sent_from_its_beginning(uploads, lake):
    data = lake.recording.read_bytes()
    upload = grow(uploads, ANNA, run_id=lake.run_id)
    uploads.append(ANNA, upload.id, 0, data + b"lost by a full disk")
    again = uploads.put(ANNA, upload.id, source(data))
    assert (again.id, again.offset) == (upload.id, 0)
    assert over(uploads, uploads.append(ANNA, upload.id, 0, data)).state == "stored"
