"""Jobs over HTTP: submitted, watched, cancelled, resumed."""

from __future__ import annotations

import concurrent.futures
import contextlib
import errno
import json
import re
import time
from contextlib import closing
from dataclasses import replace
from multiprocessing.process import BaseProcess

import pytest
from click.testing import CliRunner
from submitted import ENDLESS, ICY

import runner
from runner.cli import cli
from runner.client.jobs import LogEvent
from runner.config import from_mapping
from runner.runs.run import list_runs
from runner.service.api.jobs import POLL_SECONDS
from runner.service.jobs import queue
from runner.service.jobs.checking import check
from runner.service.jobs.queue import JobQueue
from runner.service.jobs.store import CheckedJob, JobStore
from tests.waiting import until

CONFIG = ICY | {"episodes": 200, "evaluation": {"every": 100, "trials": 5}}
SWEEP = {
    "name": "small",
    "base": {"env": {"id": "FrozenLake-v1"}, "episodes": 60, "evaluation": {"every": 20, "trials": 5}},
    "strategy": "grid",
    "parameters": {"step_size": [0.1, 0.5, 1.0]},
    "seeds": [0, 1],
    "objective": {"metric": "training.mean_reward"},
}


@pytest.fixture
def submit(client):
    def send(values, source="job.yaml"):
        answer = client.post("/api/v1/jobs", params={"source": source}, content=json.dumps(values))
        assert answer.status_code == 201, answer.text
        assert answer.headers["location"] == f"/api/v1/jobs/{answer.json()['number']}"
        return answer.json()["number"]

    return send


def job(client, number):
    return client.get(f"/api/v1/jobs/{number}").json()


def job_until(client, number, condition):
    return until(condition, lambda: job(client, number))


def watched(client, number, last=None):
    """Return all events of a stream as (id, event, data)."""
    headers = {} if last is None else {"Last-Event-ID": str(last)}
    answer = client.get(f"/api/v1/jobs/{number}/events", headers=headers)
    assert answer.headers["content-type"].startswith("text/event-stream")
    seen = []
    for block in answer.text.split("\n\n"):
        fields = dict(line.split(": ", 1) for line in block.splitlines())
        if "event" in fields:
            seen.append((fields.get("id"), fields["event"], json.loads(fields["data"])))
    return seen


def test_a_configuration_is_run_seed_by_seed_as_from_the_command_line(client, submit, recordings, tmp_path):
    number = submit(CONFIG)
    seen = watched(client, number)
    done = job(client, number)
    assert (done["state"], done["error"], done["runs"]) == ("finished", "", 2)
    runs = {run.run_id: run for run in list_runs(recordings)}
    here = [runs[begun["run_id"]] for begun in done["begun"]]
    elsewhere = runner.run_all(CONFIG, recordings=tmp_path / "elsewhere")
    for run, alone in zip(here, elsewhere, strict=True):
        assert (run.status, run.name, run.seed) == ("finished", "icy", alone.seed)
        assert run.summary["content_digest"] == alone.summary["content_digest"]

    states = [data["state"] for _, event, data in seen if event == "state"]
    assert states == ["queued", "running", "finished"]
    page = client.get(f"/queue/{number}", headers={"Accept": "text/html"}).text
    assert page.count("finished</li>") == page.count("job finished</li>") + 2, "of the job and of each run"
    assert [data["run_id"] for _, event, data in seen if event == "run"] == [run.run_id for run in here]
    log = [data["text"] for _, event, data in seen if event == "log" and data.get("seed") == 1]
    assert log[0] == "training 200 episodes with q_learning"
    assert log[-1] == "finished"
    progress = [data for _, event, data in seen if event == "progress"]
    assert progress[-1]["episode"] == progress[-1]["episodes"] == 200
    assert (progress[-1]["run"], progress[-1]["runs"]) == (2, 2)
    assert progress[-1]["last_evaluation"]["episode"] == 200


def test_a_watcher_continues_after_the_last_event(client, submit):
    number = submit(CONFIG | {"seeds": [0]})
    seen = [event for event in watched(client, number) if event[0]]
    assert [event for event in watched(client, number) if event[0]] == seen
    assert [event for event in watched(client, number, last=seen[2][0]) if event[0]] == seen[3:]
    assert [event for event in watched(client, number, last="nonsense") if event[0]] == seen
    end = client.get(f"/api/v1/jobs/{number}/events", headers={"Last-Event-ID": seen[-1][0]})
    assert end.status_code == 204


def test_a_busy_store_blocks_neither_the_pages_nor_the_event_loop(client, submit):
    number = submit(CONFIG)
    job_until(client, number, lambda job: job["state"] == "finished")
    address = f"/api/v1/jobs/{number}"
    with concurrent.futures.ThreadPoolExecutor(1) as threads, client.app.state.jobs.store.lock:
        # as while a process is started and a file is synced
        for path in ("/api/v1/jobs", address, f"{address}/events", "/runs/first", "/runs/first/status"):
            assert threads.submit(client.get, path).result(30).is_success


def test_watchers_read_the_log_only_for_new_events(client, submit, monkeypatch):
    *running, queued = [submit(ENDLESS) for _ in range(3)]
    read, counts = JobStore.events, []

    def counted(*args):
        events, last = read(*args)
        counts.append(len(events))
        return events, last

    with concurrent.futures.ThreadPoolExecutor(1) as threads:
        monkeypatch.setattr(JobStore, "events", counted)
        watcher = threads.submit(watched, client, queued)
        until(lambda counts: counts, lambda: counts)
        time.sleep(4 * POLL_SECONDS)
        for number in (queued, *running):
            client.post(f"/api/v1/jobs/{number}/cancel")
        assert [data["state"] for _, _, data in watcher.result(30)] == ["queued", "cancelled"]
    assert 0 not in counts


def test_the_page_of_a_job_loads_its_state_and_the_rest_of_its_log(client, submit):
    *running, queued = [submit(ENDLESS) for _ in range(3)]
    (last,) = re.findall(r'<li data-id="(\d+)"', client.get(f"/queue/{queued}").text)
    status, log = f"/queue/{queued}/status?state=queued", f"/queue/{queued}/log?after={last}"
    assert client.get(status).status_code == 200
    assert "<li" not in client.get(log).text
    for number in (queued, *running):
        client.post(f"/api/v1/jobs/{number}/cancel")
    assert client.get(status).status_code == 204, "the whole page is loaded again"
    assert client.get(log).text.count("job cancelled") == 1


def test_a_late_watcher_receives_the_last_progress(client, submit):
    number = submit(CONFIG)
    job_until(client, number, lambda job: job["state"] == "finished" and job["progress"] is None)
    (progress,) = [data for _, event, data in watched(client, number) if event == "progress"]
    assert (progress["run"], progress["runs"], progress["episode"]) == (2, 2, 200)


def test_a_running_job_is_cancelled_and_resumed(client, submit, recordings):
    config = {"episodes": 1500, "mode": "cooperative", "evaluation": {"every": 100, "trials": 200}}
    number = submit(config)
    job_until(client, number, lambda job: (job["progress"] or {}).get("episode", 0) > 0)
    begun = job(client, number)["begun"][0]["run_id"]
    until(
        lambda listed: {run["run_id"]: run["status"] for run in listed}.get(begun) == "running",
        lambda: client.get("/api/v1/runs").json()["runs"],
    )
    cancelled = client.post(f"/api/v1/jobs/{number}/cancel").json()
    assert cancelled["state"] == "cancelled"
    again = client.post(f"/api/v1/jobs/{number}/cancel")
    assert again.status_code == 409
    assert "is cancelled already" in again.json()["error"]["message"]

    assert client.post(f"/api/v1/jobs/{number}/resume").json()["state"] == "queued"
    done = job_until(client, number, lambda job: job["state"] == "finished")
    assert [run["run_id"] for run in done["begun"]] == [begun]
    run = next(run for run in list_runs(recordings) if run.run_id == begun)
    assert run.status == "finished"
    alone = runner.run(config, recordings=recordings)
    assert run.summary["content_digest"] == alone.summary["content_digest"]
    log = [data["text"] for _, event, data in watched(client, number) if event == "log"]
    lines = [text for text in log if text.startswith("evaluation")]
    assert len(lines) == len(set(lines)) == 16, "a resumed run repeats no line"
    assert client.post(f"/api/v1/jobs/{number}/resume").status_code == 409


def test_jobs_wait_for_workers_and_can_be_cancelled_meanwhile(connect, settings, client):
    numbers = [client.post("/api/v1/jobs", content=json.dumps(ENDLESS)).json()["number"] for _ in range(4)]
    job_until(client, numbers[1], lambda job: job["progress"] is not None)
    page = client.get("/api/v1/jobs").json()
    assert [job["state"] for job in page["jobs"]] == ["queued", "queued", "running", "running"]
    assert (page["queue"]["workers"], page["queue"]["running"], page["queue"]["queued"]) == (2, 2, 2)
    only = client.get("/api/v1/jobs", params={"state": "queued", "limit": 1}).json()
    assert (only["total"], [job["number"] for job in only["jobs"]]) == (2, [numbers[3]])
    for number in (numbers[2], numbers[0]):
        (address,) = re.findall(rf'action="(/queue/{number}/cancel[^"]*)"', client.get("/queue").text)
        queue = client.post(address)
        assert (queue.status_code, queue.url.path) == (200, "/queue")
        assert job(client, number)["state"] == "cancelled"
        assert address not in queue.text
    job_until(client, numbers[3], lambda job: job["state"] == "running")


def test_a_sweep_uses_the_free_workers(client, submit, recordings, tmp_path):
    number = submit(SWEEP)
    busy = client.post("/api/v1/jobs", content=json.dumps(SWEEP))
    assert busy.status_code == 409
    assert "does the sweep 'small' already" in busy.json()["error"]["message"]
    seen = watched(client, number)
    assert job(client, number)["state"] == "finished"
    progress = [data for _, event, data in seen if event == "progress"]
    assert (progress[-1]["done"], progress[-1]["runs"], progress[-1]["failed"]) == (6, 6, 0)
    assert max(data["running"] for data in progress) == 2
    runs = [run for run in list_runs(recordings) if "sweep=small" in run.tags]
    assert len(runs) == 6
    best = progress[-1]["best"]
    assert any(f"trial {best['trial']} is the best so far" in data.get("text", "") for _, _, data in seen)
    compared = "Comparing the trials of 6 runs …"  # as soon as the index has all of them
    first = until(lambda page: compared in page, lambda: client.get("/sweeps/small").text)
    assert 'data-later="/sweeps/small/pictures"' in first

    def texts():
        """Return the pages, which change once more when the index notices that the last runs are over."""
        return [
            client.get(f"/sweeps/small{rest}").text for rest in ("/results", "/importance", "/pictures", "")
        ]

    table, _, pictures, page = until(lambda seen: all(part in seen[3] for part in seen[:3]), texts)
    assert all(f'href="/runs/{run.run_id}"' in table for run in runs)
    assert 'aria-label="Length of evaluation trials over training episodes"' in pictures
    assert "data-later" not in page
    (recordings / ".sweeps" / "small" / ".replacing").symlink_to("gone")  # as a file that vanishes
    assert client.get("/sweeps/small").status_code == 200


def test_jobs_hold_the_workers_that_they_ask_for_and_start_in_order(client, submit):
    number = submit(ENDLESS)
    job_until(client, number, lambda job: job["progress"] is not None)
    asked = client.post("/api/v1/jobs", params={"workers": 5}, content=json.dumps(SWEEP)).json()
    assert (asked["workers"], job(client, number)["workers"]) == (2, 1)
    last = submit(CONFIG | {"seeds": [0]})
    waiting = f"job {asked['number']} waits for 2 workers; free: 1"
    until(lambda queue: queue["waiting_for"] == waiting, lambda: client.get("/api/v1/jobs").json()["queue"])
    assert job(client, last)["state"] == "queued", "it does not overtake the sweep"
    client.post(f"/api/v1/jobs/{number}/cancel")
    done = job_until(client, last, lambda job: job["state"] == "finished")
    assert done["workers"] == 1
    log = [data["text"] for _, event, data in watched(client, asked["number"]) if event == "log"]
    assert log[0] == "5 workers were requested; it gets 2, the most that it can use here"
    one = client.post("/api/v1/jobs", params={"workers": 1}, content=json.dumps(SWEEP | {"name": "alone"}))
    number = one.json()["number"]
    running = [data["running"] for _, event, data in watched(client, number) if event == "progress"]
    assert max(running) == 1
    assert client.post("/api/v1/jobs", params={"workers": 0}, content="episodes: 3").status_code == 422


def test_a_job_whose_worker_dies_is_retried_and_then_fails(client, submit):
    import psutil

    number = submit(ENDLESS)
    for _ in range(2):
        job_until(client, number, lambda job: job["progress"] is not None)
        for process in psutil.Process().children(recursive=True):
            with contextlib.suppress(psutil.NoSuchProcess):  # another child has just ended
                if process.nice() > psutil.Process().nice():
                    process.kill()
        job_until(client, number, lambda job: job["progress"] is None)
    failed = job_until(client, number, lambda job: job["state"] == "failed")
    assert failed["error"].startswith("its worker died 2 times, at last with exit code -9")


def test_a_failed_job_has_a_message_and_can_be_resumed(client, submit):
    number = submit(SWEEP | {"objective": {"metric": "training.mean_rewards"}})
    failed = job_until(client, number, lambda job: job["state"] == "failed")
    assert "Did you mean 'training.mean_reward'?" in failed["error"]
    last = watched(client, number)[-1][2]
    assert (last["state"], last["error"]) == ("failed", failed["error"])
    again = client.post(f"/api/v1/jobs/{number}/resume").json()
    assert (again["state"], again["error"]) == ("queued", "")
    assert job_until(client, number, lambda job: job["state"] == "failed")["error"] == failed["error"]


def test_mistakes_are_reported_with_line_and_key(client, recordings):
    answer = client.post("/api/v1/jobs", params={"source": "my.yaml"}, content="episodes: 3\nepsilom: 1\n")
    assert answer.status_code == 422
    error = answer.json()["error"]
    assert error["message"] == "my.yaml:2:1: epsilom: unknown key. Did you mean 'epsilon'?"
    assert error["problems"][0] | {"message": ""} == {"path": "epsilom", "line": 2, "message": ""}
    assert client.get("/api/v1/jobs").json()["total"] == 0
    assert client.post("/api/v1/jobs", content=b"episodes: \xff").status_code == 422
    assert client.post("/api/v1/jobs", content="").status_code == 422
    assert client.post("/api/v1/jobs", params={"source": "../x"}, content="episodes: 3").status_code == 422


def test_a_text_can_be_checked_without_being_queued(client):
    checked = client.post("/api/v1/jobs/check", content=json.dumps(CONFIG)).json()
    assert (checked["kind"], checked["name"], checked["runs"]) == ("config", "icy", 2)
    assert checked["bytes"] > 0
    assert client.get("/api/v1/jobs").json()["total"] == 0


def test_a_job_that_is_too_large_is_refused_and_a_full_disk_delays_jobs(client, submit, monkeypatch):
    monkeypatch.setattr(queue, "free_bytes", lambda _: 1000)
    refused = client.post("/api/v1/jobs", content=json.dumps(CONFIG))
    assert refused.status_code == 507
    assert "its recordings need about" in refused.json()["error"]["message"]
    monkeypatch.setattr(queue, "free_bytes", lambda _: queue.RESERVE_BYTES - 1)
    number = submit(CONFIG | {"seeds": [0]})
    time.sleep(0.5)
    assert job(client, number)["state"] == "queued"
    assert client.get("/api/v1/jobs").json()["queue"]["waiting_for"].startswith("disk: 268 MB are free")
    monkeypatch.undo()
    job_until(client, number, lambda job: job["state"] == "finished")


def test_unknown_jobs_are_not_found(client):
    for path in ("", "/events", "/submitted"):
        assert client.get(f"/api/v1/jobs/7{path}").status_code == 404
    for verb in ("cancel", "resume"):
        assert client.post(f"/api/v1/jobs/7/{verb}").status_code == 404
    assert client.get("/api/v1/jobs/0").status_code == 422


def test_the_submitted_text_is_returned(client, submit):
    number = submit(ENDLESS)
    assert json.loads(client.get(f"/api/v1/jobs/{number}/submitted").text) == ENDLESS


@pytest.mark.parametrize("folder", ["missing", "there"])
def test_a_reserved_run_that_was_never_made_is_made(tmp_path, folder):
    """The server reserved the run's id, or the worker made its folder as well, and was killed."""
    with JobQueue(tmp_path, 1) as jobs:
        if folder == "there":
            (jobs.recordings / "abcdefgh").mkdir()
        with jobs.store.lock:
            queued = jobs.store.add(one_seed(3), "")
            jobs.store.update(queued.number, run_ids={3: "abcdefgh"})
        over = until(lambda job: job.is_over, lambda: jobs.store.job(queued.number))
        assert over.state == "finished"
        runs = list_runs(jobs.recordings)
        assert [run.run_id for run in runs] == [over.started_runs[3]] == ["abcdefgh"]


def test_a_command_does_a_job_from_its_folder_alone(tmp_path):
    folder = tmp_path / "runs"
    with closing(JobStore(folder)) as store:
        text = json.dumps(CONFIG)
        path = store.path(store.add(check(text, "job.yaml", folder), text).number)
        missing = one_seed().values | {"env": {"id": "Missing-v0", "kwargs": {}}}
        broken = store.path(store.add(replace(one_seed(), values=missing), "").number)
    lines, code = done_by_command("run", path)
    assert code == 0
    assert [line["values"]["seed"] for line in lines if line["kind"] == "run"] == [0, 1]
    assert lines[-1] == {"kind": "state", "values": {"state": "finished"}}
    here = runner.run_all(CONFIG, recordings=tmp_path / "here")
    digests = [
        {run.seed: run.summary["content_digest"] for run in runs} for runs in (list_runs(folder), here)
    ]
    assert digests[0] == digests[1]
    for command in ("resume", "branch", "explain", "sweep run"):
        assert done_by_command(command, path)[1] == 0, "it is finished already"
    assert len(list_runs(folder)) == 2
    lines, code = done_by_command("run", broken)
    assert code == 1
    assert "Missing" in lines[-1]["values"]["error"]
    refused = CliRunner().invoke(cli, ["run", "--job", str(folder)])
    assert refused.exit_code == 2
    assert "expected the folder of a job" in refused.stderr


def done_by_command(command, folder):
    """Return the lines of JSON that a command prints which does a job, and its exit code."""
    result = CliRunner().invoke(cli, [*command.split(), "--job", str(folder)])
    return [json.loads(line) for line in result.stdout.splitlines()], result.exit_code


def test_a_worker_that_cannot_be_started_is_retried_and_readiness_reports_it(
    client, submit, settings, monkeypatch
):
    """The system has no process to give for a while: the queue must continue afterwards."""

    def refused(_):
        raise OSError(errno.EAGAIN, "Resource temporarily unavailable")

    monkeypatch.setattr(queue, "RETRY_SECONDS", 0.05)
    with monkeypatch.context() as full:
        full.setattr(BaseProcess, "start", refused)
        number = jobs_of(client).store.add(one_seed(), "").number
        waiting = "no worker process can be started (Resource temporarily unavailable)"
        until(
            lambda queue: queue["waiting_for"] == waiting, lambda: client.get("/api/v1/jobs").json()["queue"]
        )
        assert job(client, number)["state"] == "queued"
        ready = client.get("/readyz")
        assert (ready.status_code, ready.json()["checks"]["jobs_can_be_started"]) == (503, False)
    job_until(client, number, lambda job: job["state"] == "finished")
    assert client.get("/readyz").status_code == 200


def test_an_error_of_one_job_does_not_stop_the_others(client, submit, monkeypatch):
    jobs = jobs_of(client)
    report = jobs.store.report

    def failing(number, event):
        if number == 1 and isinstance(event, LogEvent):
            raise RuntimeError("our own fault")
        report(number, event)

    monkeypatch.setattr(jobs.store, "report", failing)
    numbers = [submit(CONFIG | {"seeds": [0]}) for _ in range(2)]
    for number in numbers:
        job_until(client, number, lambda job: job["state"] == "finished")
    assert client.get("/readyz").status_code == 200


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_readiness_reports_a_dead_job_thread(client, monkeypatch):
    def fatal(*_):
        raise SystemExit

    jobs = jobs_of(client)
    monkeypatch.setattr(jobs.pool, "_start_next", fatal)
    until(lambda ready: ready.status_code == 503, lambda: client.get("/readyz"))
    assert client.get("/readyz").json()["checks"]["jobs_can_be_started"] is False


def test_a_cancelled_job_is_not_forgotten_while_its_worker_closes(client, submit):
    jobs = jobs_of(client)
    jobs.store._max_over = 0
    number = submit(ENDLESS)
    job_until(client, number, lambda job: job["progress"] is not None)
    with jobs.store.lock:  # the worker's end is not taken in before the next job is there
        jobs.cancel(number)
        other = jobs.store.add(one_seed(), "").number
    job_until(client, other, lambda job: job["state"] == "finished")


def jobs_of(client):
    return client.app.state.jobs


def one_seed(seed=0):
    return CheckedJob("config", "icy", 1, 0, from_mapping(CONFIG | {"seeds": [seed]}).to_mapping(), (seed,))
