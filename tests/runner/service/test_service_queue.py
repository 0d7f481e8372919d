"""The queue of jobs on disk."""

from __future__ import annotations

import os

import pytest

from runner.errors import RunnerError, StorageError
from runner.service.jobs import queue as queues
from runner.service.jobs.store import JobNotFound, Queue, QueueFull

CONFIG = {"episodes": 3}


def added(queue, name="tiny"):
    return queue.add("config", name, 1, "episodes: 3\n", CONFIG)


@pytest.fixture
def queue(tmp_path):
    with Queue(tmp_path / "recordings") as opened:
        yield opened


def test_what_was_queued_and_what_became_of_it_outlives_the_process(tmp_path):
    with Queue(tmp_path) as queue:
        first, second = added(queue), added(queue, "other")
        queue.change(first.number, state="failed", error="no luck")
        queue.note(second.number, "log", {"text": "hello"})
        before, events = queue.jobs(), queue.events(second.number)
    with Queue(tmp_path) as queue:
        assert queue.jobs() == before
        assert [(job.number, job.state, job.error) for job in before] == [
            (1, "failed", "no luck"),
            (2, "queued", ""),
        ]
        assert queue.events(2) == events
        assert queue.submitted(1) == "episodes: 3\n"
        assert added(queue).number == 3


def test_one_process_at_a_time_has_it(queue):
    with pytest.raises(RunnerError, match="served by another process already"):
        Queue(queue.recordings)


def test_more_than_so_many_unfinished_jobs_are_refused(tmp_path):
    with Queue(tmp_path, most_waiting=2) as queue:
        first, _ = added(queue), added(queue)
        with pytest.raises(QueueFull, match="2 jobs are unfinished"):
            added(queue)
        queue.change(first.number, state="finished")
        added(queue)


def test_the_oldest_that_are_over_are_forgotten_but_no_number_is_given_twice(tmp_path):
    with Queue(tmp_path, most_kept=2) as queue:
        for _ in range(4):
            queue.change(added(queue).number, state="finished")
        waiting = added(queue)
        assert [job.number for job in queue.jobs()] == [3, 4, 5]
        assert not queue.folder_of(1).exists()
        with pytest.raises(JobNotFound, match="no job 1;"):
            queue.job(1)
    with Queue(tmp_path) as queue:
        assert [job.number for job in queue.jobs()] == [3, 4, waiting.number]
        assert added(queue).number == 6


def test_what_was_not_wholly_submitted_is_gone_whole(tmp_path):
    with Queue(tmp_path) as queue:
        for _ in range(3):
            added(queue)
        (queue.folder_of(2) / queues.JOB_FILE).unlink()
        (queue.folder_of(3) / queues.JOB_FILE).write_text('{"number": 3, "kind": "party"')
        (queue.folder / "notes").mkdir()
    with Queue(tmp_path) as queue:
        assert [job.number for job in queue.jobs()] == [1]
        assert sorted(path.name for path in queue.folder.iterdir() if path.is_dir()) == ["1", "notes"]


@pytest.mark.parametrize(
    ("key", "value"), [("state", "merry"), ("number", "1"), ("runs", None), ("number", 7)]
)
def test_a_job_that_says_something_else_is_none(tmp_path, key, value):
    import json

    with Queue(tmp_path) as queue:
        path = queue.folder_of(added(queue).number) / queues.JOB_FILE
    path.write_text(json.dumps(json.loads(path.read_text()) | {key: value}))
    with Queue(tmp_path) as queue:
        assert queue.jobs() == []


def test_a_reader_comes_back_to_where_it_was_also_behind_a_torn_line(tmp_path):
    with Queue(tmp_path) as queue:
        number = added(queue).number
        queue.note(number, "log", {"text": "one"})
        seen, place = queue.events(number)
        queue.note(number, "log", {"text": "two — ü"})
        assert [event.data.get("text") for event in seen] == [None, "one"]
        assert seen[-1].place == place
        assert [event.data for event in queue.events(number, place)[0]] == [{"text": "two — ü"}]
        assert queue.events(number, place + 3)[0] == queue.events(number)[0], "no event begins there"
        assert queue.events(number, 10**9)[0] == queue.events(number)[0]
        path = queue.folder_of(number) / queues.EVENTS_FILE
    with path.open("ab") as stream:
        stream.write(b'{"event":"log","data":{"te')
    with Queue(tmp_path) as queue:
        queue.note(number, "log", {"text": "three"})
        assert [event.data["text"] for event in queue.events(number, place)[0]] == ["two — ü", "three"]


def test_many_events_are_read_in_parts_and_too_many_are_left_out(queue, monkeypatch):
    monkeypatch.setattr(queues, "MAX_READ_BYTES", 1000)
    monkeypatch.setattr(queues, "MAX_EVENTS_BYTES", 5000)
    number = added(queue).number
    for i in range(200):
        queue.note(number, "log", {"text": f"line {i}"})
    queue.change(number, state="finished")
    texts, place = [], 0
    while found := queue.events(number, place):
        events, after = found
        if after == place:
            break
        assert after - place <= 1000
        texts += [event.data.get("text", event.data.get("state")) for event in events]
        place = after
    kept = len(texts) - 2
    assert 50 < kept < 150
    assert texts == ["queued", *(f"line {i}" for i in range(kept)), "finished"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_cannot_be_written_is_told(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(StorageError, match="cannot be written"):
        Queue(tmp_path / "recordings")


def test_a_job_that_cannot_be_written_is_not_in_the_queue(queue, monkeypatch):
    def full(path, text):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(queues, "_write", full)
    with pytest.raises(StorageError, match="No space left on device"):
        added(queue)
    assert queue.jobs() == []
    assert not queue.folder_of(1).exists()


def test_the_last_events_are_read_from_the_end_of_the_file(queue, monkeypatch):
    monkeypatch.setattr(queues, "MAX_READ_BYTES", 1000)
    job = added(queue)
    assert [event.kind for event in queue.last_events(job.number, 10)[0]] == ["state"]
    for number in range(100):
        queue.note(job.number, "log", {"text": f"line {number}"})
    found, place = queue.last_events(job.number, 10)
    assert [event.data["text"] for event in found] == [f"line {number}" for number in range(90, 100)]
    assert queue.events(job.number, place) == ([], place)
    assert 10 < len(queue.last_events(job.number, 100)[0]) < 30, "no more than are read at once"
    with pytest.raises(JobNotFound):
        queue.last_events(9, 10)
