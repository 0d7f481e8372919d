"""The store of jobs in SQLite."""

from __future__ import annotations

import contextlib
import os
import sqlite3

import pytest

from runner.client.jobs import LogEvent
from runner.errors import RunnerError, StorageError
from runner.service.errors import JobNotFound, QueueFull
from runner.service.jobs import store as stores
from runner.service.jobs.store import JobStore

CONFIG = {"episodes": 3, "env": {"kwargs": {"limit": float("inf")}}}


def added(store, name="tiny"):
    return store.add("config", name, 1, "episodes: 3\n", CONFIG)


def texts(events):
    return [getattr(event.data, "text", getattr(event.data, "state", None)) for event in events]


@pytest.fixture
def store(tmp_path):
    with JobStore(tmp_path / "recordings") as opened:
        yield opened


def test_jobs_their_runs_and_events_outlive_the_process(tmp_path):
    with JobStore(tmp_path) as store:
        first, second = added(store), added(store, "other")
        store.update(first.number, state="failed", error="no luck")
        store.log(second.number, [LogEvent("hello")])
        store.reserve_runs(second.number, {2**64 - 1: "aaaa", 3: "bbbb"})
        store.start_run(second.number, 3, "bbbb")
        before, events = store.jobs(), store.events(second.number)
    with JobStore(tmp_path) as store:
        assert store.jobs() == before
        assert [(job.number, job.state, job.error) for job in before] == [
            (1, "failed", "no luck"),
            (2, "queued", ""),
        ]
        assert store.events(2) == events
        assert [event.kind for event in events[0]] == ["state", "log", "run"]
        assert (store.submitted(1), store.values(1)) == ("episodes: 3\n", CONFIG)
        assert store.run_ids(2) == {3: "bbbb"}
        assert store.run_ids(2, started=False) == {3: "bbbb", 2**64 - 1: "aaaa"}
        assert added(store).number == 3


def test_one_process_at_a_time_has_the_store(store):
    with pytest.raises(RunnerError, match="served by another process already"):
        JobStore(store.recordings)


def test_more_unfinished_jobs_than_the_maximum_are_refused(tmp_path):
    with JobStore(tmp_path, max_unfinished=2) as store:
        first, _ = added(store), added(store)
        with pytest.raises(QueueFull, match="2 jobs are unfinished"):
            added(store)
        store.update(first.number, state="finished")
        added(store)


def test_the_oldest_jobs_that_are_over_are_forgotten_but_no_number_is_used_twice(tmp_path):
    with JobStore(tmp_path, max_over=2) as store:
        for _ in range(4):
            store.update(added(store).number, state="finished")
        waiting = added(store)
        assert [job.number for job in store.jobs()] == [3, 4, 5]
        with pytest.raises(JobNotFound, match="no job 1;"):
            store.events(1)
    with JobStore(tmp_path) as store:
        assert [job.number for job in store.jobs()] == [3, 4, waiting.number]
        assert added(store).number == 6


def test_a_file_that_is_no_database_is_reported_and_kept(tmp_path):
    with JobStore(tmp_path) as store:
        path = store.path
    path.write_bytes(b"no database" * 1000)
    with pytest.raises(StorageError, match="move it away to start with an empty queue"):
        JobStore(tmp_path)
    assert path.read_bytes().startswith(b"no database")


def test_the_jobs_of_a_server_that_gave_no_workers_are_read(tmp_path):
    with JobStore(tmp_path) as store:
        before, path = added(store), store.path
    with contextlib.closing(sqlite3.connect(path)) as database:
        database.execute("ALTER TABLE jobs DROP COLUMN workers")
    with JobStore(tmp_path) as store:
        assert store.jobs() == [before]


def test_a_reader_continues_after_the_last_event_it_saw(store):
    number, other = added(store).number, added(store).number
    store.log(number, [LogEvent("one")])
    seen, last = store.events(number)
    store.log(number, [LogEvent("two — ü")])
    assert texts(seen) == ["queued", "one"]
    assert int(seen[-1].id) == last
    assert texts(store.events(number, last)[0]) == ["two — ü"]
    for id_ in (last + 3, 10**9, store.events(other)[1]):
        assert store.events(number, id_)[0] == store.events(number)[0], "it is no event of the job"


def test_many_events_are_read_in_parts_and_too_many_are_dropped(store, monkeypatch):
    monkeypatch.setattr(stores, "EVENTS_PER_READ", 30)
    monkeypatch.setattr(stores, "MAX_EVENTS", 100)
    number = added(store).number
    for i in range(0, 200, 4):
        store.log(number, [LogEvent(f"line {i + j}") for j in range(4)])
    store.update(number, state="finished")
    found, last = [], 0
    while (part := store.events(number, last))[0]:
        assert len(part[0]) <= 30
        found, last = [*found, *part[0]], part[1]
    assert texts(found) == ["queued", *(f"line {i}" for i in range(99)), "finished"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_cannot_be_written_is_reported(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(StorageError, match="cannot be written"):
        JobStore(tmp_path / "recordings")


def test_on_a_full_disk_a_job_is_not_queued_and_a_change_counts_until_the_next_start(tmp_path, monkeypatch):
    def full(*_):
        raise sqlite3.OperationalError("database or disk is full")

    with JobStore(tmp_path) as store:
        job = added(store)
        monkeypatch.setattr(store, "_insert_events", full)
        with pytest.raises(StorageError, match="disk is full"):
            added(store)
        with pytest.raises(StorageError, match="disk is full"):
            store.update(job.number, state="finished")
        assert [job.state for job in store.jobs()] == ["finished"]
    with JobStore(tmp_path) as store:
        assert store.jobs() == [job]


def test_the_last_events_are_read(store):
    number = added(store).number
    assert texts(store.last_events(number, 10)[0]) == ["queued"]
    store.log(number, [LogEvent(f"line {i}") for i in range(100)])
    found, last = store.last_events(number, 10)
    assert texts(found) == [f"line {i}" for i in range(90, 100)]
    assert store.events(number, last) == ([], last)
    with pytest.raises(JobNotFound):
        store.last_events(9, 10)
