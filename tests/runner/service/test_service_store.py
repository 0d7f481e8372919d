"""The store of jobs, in folders."""

from __future__ import annotations

import errno
import os
from contextlib import closing

import pytest

from runner.client.jobs import LogEvent, RunEvent, RunProgress
from runner.errors import RunnerError, StorageError
from runner.service.errors import JobNotFound, LimitReached
from runner.service.jobs import store as stores
from runner.service.jobs.store import CheckedJob, JobStore, read_values

CONFIG = {"episodes": 3, "seeds": [0]}
SWEEP = {"parameters": {"limit": [1.5, float("inf")]}}


def added(store, name="tiny"):
    return store.add(CheckedJob("config", name, 1, 0, CONFIG, (0,)), "episodes: 3\n")


def texts(events):
    return [getattr(event.data, "text", getattr(event.data, "state", None)) for event in events]


@pytest.fixture
def store(tmp_path):
    with closing(JobStore(tmp_path / "recordings")) as opened:
        yield opened


def test_jobs_their_runs_and_events_outlive_the_process(tmp_path):
    with closing(JobStore(tmp_path)) as store:
        first, second = added(store), added(store, "other")
        third = store.add(CheckedJob("sweep", "swept", 2, 0, SWEEP), "", 2)
        store.update(first.number, state="failed", error="no luck")
        store.report(second.number, LogEvent("hello"))
        store.update(second.number, run_ids={2**64 - 1: "aaaa", 3: "bbbb"})
        store.report(second.number, RunEvent("aaaa", 2**64 - 1))
        before, events = store.jobs(), store.events(second.number)
    with closing(JobStore(tmp_path)) as store:
        assert store.jobs() == before
        assert [(job.number, job.state, job.error) for job in before] == [
            (1, "failed", "no luck"),
            (2, "queued", ""),
            (3, "queued", ""),
        ]
        assert (read_values(store.path(third.number)), third.run_ids, third.workers) == (SWEEP, {}, 2)
        assert store.events(2) == events
        assert [event.kind for event in events[0]] == ["state", "log", "run"]
        assert (store.submitted(1), read_values(store.path(1))) == ("episodes: 3\n", CONFIG)
        assert store.job(2).run_ids == {2**64 - 1: "aaaa", 3: "bbbb"}
        assert store.job(2).started_runs == {2**64 - 1: "aaaa"}
        assert [len(run_id) for run_id in store.job(1).run_ids.values()] == [8], "reserved at once"
        assert added(store).number == 4


def test_one_process_at_a_time_has_the_store(store):
    with pytest.raises(RunnerError, match="served by another process already"):
        JobStore(store.recordings)


def test_more_unfinished_jobs_than_the_maximum_are_refused(tmp_path):
    with closing(JobStore(tmp_path, max_unfinished=2)) as store:
        first, _ = added(store), added(store)
        with pytest.raises(LimitReached, match="2 jobs are unfinished"):
            added(store)
        store.update(first.number, state="finished")
        added(store)


def test_the_oldest_jobs_that_are_over_are_forgotten_but_no_number_is_used_twice(tmp_path):
    with closing(JobStore(tmp_path, max_over=2)) as store:
        for _ in range(4):
            store.update(added(store).number, state="finished")
        waiting = added(store)
        assert [job.number for job in store.jobs()] == [3, 4, 5]
        with pytest.raises(JobNotFound, match="no job 1;"):
            store.events(1)
    with closing(JobStore(tmp_path)) as store:
        assert [job.number for job in store.jobs()] == [3, 4, waiting.number]
        assert added(store).number == 6


def test_a_damaged_job_is_reported_and_kept(tmp_path):
    with closing(JobStore(tmp_path)) as store:
        state = store.path(added(store).number, stores.STATE_FILE)
    for damaged in (b"", b"no job", b'{"number": 1}'):
        state.write_bytes(damaged)
        with pytest.raises(StorageError, match="move its folder away to start without the job"):
            JobStore(tmp_path)
        assert state.read_bytes() == damaged


def test_a_submission_that_was_not_confirmed_leaves_nothing(tmp_path):
    with closing(JobStore(tmp_path)) as store:
        folder = store.path(added(store).number)
    (folder / stores.STATE_FILE).unlink()  # which is written last
    with closing(JobStore(tmp_path)) as store:
        assert (store.jobs(), folder.exists()) == ([], False)
        assert added(store).number == 1


def test_a_line_that_was_not_written_to_its_end_is_left_out(tmp_path):
    with closing(JobStore(tmp_path)) as store:
        number = added(store).number
        store.report(number, LogEvent("one"))
        before, log = store.events(number), store.path(number, stores.LOG_FILE)
    with log.open("ab") as stream:
        stream.write(b'{"kind": "log", "values": {"text": "the power fai')
    with closing(JobStore(tmp_path)) as store:
        assert store.log_size(number) == before[1]
        assert store.events(number) == before
        store.report(number, LogEvent("two"))
        assert texts(store.events(number)[0]) == ["queued", "one", "two"]
        assert store.events(number, before[1])[1] == store.log_size(number)


def test_a_reader_continues_after_the_last_event_it_saw(store):
    number, other = added(store).number, added(store).number
    store.report(number, LogEvent("one"))
    seen, last = store.events(number)
    store.report(number, LogEvent("two — ü"))
    assert texts(seen) == ["queued", "one"]
    assert int(seen[-1].id) == last
    assert texts(store.events(number, last)[0]) == ["two — ü"]
    store.report(other, LogEvent("three"))
    for id_ in (last + 3, 10**9, store.events(other)[1]):
        assert store.events(number, id_)[0] == store.events(number)[0], "it is no event of the job"


def test_many_events_are_read_in_parts_and_too_many_are_dropped(store, monkeypatch):
    monkeypatch.setattr(stores, "EVENTS_PER_READ", 30)
    monkeypatch.setattr(stores, "MAX_LOG_BYTES", 10_000)
    number = added(store).number
    for i in range(200):
        store.report(number, LogEvent(f"line {i}"))
    store.update(number, state="finished")
    found, last = [], 0
    while (part := store.events(number, last))[0]:
        assert len(part[0]) <= 30
        found, last = [*found, *part[0]], part[1]
    assert 100 < len(found) < 130
    assert texts(found) == ["queued", *(f"line {i}" for i in range(len(found) - 2)), "finished"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_cannot_be_written_is_reported(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(StorageError, match="cannot be written"):
        JobStore(tmp_path / "recordings")


def test_on_a_full_disk_a_job_is_not_queued_and_a_change_counts_until_the_next_start(tmp_path, monkeypatch):
    def full(path, *_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), path)

    with closing(JobStore(tmp_path)) as store:
        job = added(store)
        monkeypatch.setattr(stores, "_write", full)
        with pytest.raises(StorageError, match="No space left on device"):
            added(store)
        assert [folder.name for folder in store.path(job.number).parent.iterdir() if folder.is_dir()] == ["1"]
        store.update(job.number, state="cancelled")
        assert [job.state for job in store.jobs()] == ["cancelled"]
    with closing(JobStore(tmp_path)) as store:
        assert store.jobs() == [job]


def test_a_line_that_the_disk_had_no_room_for_is_dropped_and_later_ones_are_whole(store, monkeypatch):
    number = added(store).number
    log = store.path(number, stores.LOG_FILE)
    whole = log.read_bytes()
    log.write_bytes(whole + b'{"kind": "log", "values": {"text": "a line of which the disk took only ')
    assert texts(store.events(number)[0]) == ["queued"]
    for text in ("one", "two", "three"):
        store.report(number, LogEvent(text))
        assert store.events(number)[1] == store.log_size(number)
    assert texts(store.events(number)[0]) == ["queued", "one", "two", "three"]


def test_progress_is_no_event_and_is_that_of_the_last_report(store):
    number, progress = added(store).number, RunProgress("aaaa", 0, 1, 1, 2, 3, 40, 0, 500, None)
    before = store.events(number)
    store.report(number, progress)
    assert store.job(number).progress == progress
    assert store.events(number) == before


def test_the_last_events_are_read(store):
    number = added(store).number
    assert texts(store.last_events(number, 10)) == ["queued"]
    for i in range(100):
        store.report(number, LogEvent(f"line {i}"))
    found = store.last_events(number, 10)
    assert texts(found) == [f"line {i}" for i in range(90, 100)]
    last = int(found[-1].id)
    assert store.events(number, last) == ([], last)
    with pytest.raises(JobNotFound):
        store.last_events(9, 10)


def test_a_job_that_is_forgotten_while_its_files_are_opened_is_no_job(store, monkeypatch):
    check = store.job

    def forgotten_after(number):
        job = check(number)
        store._forget(number)
        return job

    monkeypatch.setattr(store, "job", forgotten_after)
    for read in (store.events, store.submitted, lambda number: store.last_events(number, 10)):
        number = added(store).number
        with pytest.raises(JobNotFound):
            read(number)
