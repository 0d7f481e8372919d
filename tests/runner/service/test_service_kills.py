"""A server that is killed during its jobs, and started again."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import threading
from contextlib import closing

import httpx2
import psutil
import pytest
from served import Served
from submitted import ENDLESS

import runner
from runner.runs.run import list_runs
from runner.service.jobs.store import JobStore
from runner.sweep import state
from runner.sweep.model import from_values
from runner.sweep.running import run_sweep
from runner.sweep.trials import Trials, recorded_trials
from tests.reliability.jobs import is_worker

pytestmark = pytest.mark.long

CONFIG = {
    "name": "quick",
    "episodes": 1200,
    "mode": "cooperative",
    "epsilon": {"schedule": "linear", "start": 1.0, "end": 0.1, "over": 1200},
    "evaluation": {"every": 200, "trials": 200},
}
LONGER = {"episodes": 10_000, "recording": {"steps": "none"}}
"""Takes half a second, which a kill cannot miss; its steps would take 230 MB."""
SWEEP = {
    "name": "small",
    "base": CONFIG | LONGER | {"name": "base"},
    "strategy": "tpe",
    "trials": 6,
    "batch": 2,
    "parameters": {"step_size": {"low": 0.1, "high": 1.0}},
    "seeds": [0],
}


def is_under_way(jobs):
    """Return whether a job has made progress."""
    return any(
        job["state"] == "running" and (job["progress"] or {}).get("episode", 0) > 0 for job in jobs.values()
    )


def are_finished(jobs):
    assert not [job for job in jobs.values() if job["state"] in ("failed", "cancelled")], jobs
    return all(job["state"] == "finished" for job in jobs.values())


def submitted(server, seeds):
    for seed in seeds:
        server.post("/jobs", json.dumps(CONFIG | {"seed": seed}))


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The content digests of undisturbed runs of five seeds, by seed."""
    runs = runner.run_all(CONFIG | {"seeds": list(range(5))}, recordings=tmp_path_factory.mktemp("alone"))
    return {run.seed: run.summary["content_digest"] for run in runs}


def digests(recordings):
    runs = list_runs(recordings)
    assert [run.status for run in runs] == ["finished"] * len(runs)
    return sorted((run.seed, run.summary["content_digest"]) for run in runs)


def test_five_jobs_survive_kills_of_the_server_and_of_everything(tmp_path, undisturbed):
    with Served(tmp_path) as server:
        submitted(server, range(5))
        server.until(is_under_way)
        workers = server.kill()
        _, alive = psutil.wait_procs(workers, timeout=60)
        assert not alive, "a worker whose server is gone closes its recording and ends"
        statuses = {run.status for run in list_runs(tmp_path)}
        assert "running" not in statuses
        assert "interrupted" in statuses

        server.start()
        before = server.until(is_under_way)
        assert sorted(before) == [1, 2, 3, 4, 5]
        server.kill(with_workers=True)
        server.start()
        jobs = server.until(are_finished)
        assert len(list_runs(tmp_path)) == 5, "no run was begun twice"
        assert digests(tmp_path) == sorted(undisturbed.items())
        begun = [job["begun"][0]["run_id"] for job in jobs.values()]
        assert sorted(begun) == sorted(run.run_id for run in list_runs(tmp_path))


def test_a_new_server_waits_for_a_worker_that_has_not_stopped_yet(tmp_path, undisturbed):
    with Served(tmp_path, "--workers", "1") as server:
        submitted(server, [0])
        server.until(is_under_way)
        slow = next(filter(is_worker, server.workers()))
        slow.send_signal(signal.SIGSTOP)  # it owns its run, and does nothing
        server.kill()
        server.start()
        server.until(lambda jobs: jobs[1]["state"] == "running")
        psutil.wait_procs([slow], timeout=2)
        [job] = server.get("/jobs")["jobs"]
        assert (job["state"], job["progress"]) == ("running", None), "it has not begun to work on the run"
        slow.send_signal(signal.SIGCONT)
        server.until(are_finished)
        assert digests(tmp_path) == [(0, undisturbed[0])]


def test_a_stopped_server_leaves_its_job_resumable_and_ends_event_streams(tmp_path):
    config = CONFIG | {"evaluation": {"every": 100, "trials": 2500}, "recording": {"steps": "none"}}
    with Served(tmp_path, "--workers", "1") as server:
        server.post("/jobs", json.dumps(config))
        server.until(is_under_way)
        seen = []

        def watch():
            with httpx2.stream("GET", f"{server.url}/api/v1/jobs/1/events", timeout=30) as answer:
                seen.extend(answer.iter_lines())

        watcher = threading.Thread(target=watch)
        watcher.start()
        server.until(lambda _: seen)
        assert server.stop() in (0, -signal.SIGTERM)
        watcher.join(60)
        assert not watcher.is_alive()
        with closing(JobStore(tmp_path)) as store:
            assert store.job(1).state == "interrupted"
        assert [run.status for run in list_runs(tmp_path)] == ["interrupted"]

        server.start()
        last = next(line for line in reversed(seen) if line.startswith("id: ")).removeprefix("id: ")
        server.until(are_finished)
        rest = httpx2.get(f"{server.url}/api/v1/jobs/1/events", headers={"Last-Event-ID": last}).text
        states = [
            json.loads(line.removeprefix("data: "))["state"]
            for line in rest.splitlines()
            if '"state"' in line
        ]
        assert states == ["interrupted", "queued", "running", "finished"]
        alone = runner.run(config, recordings=tmp_path / "alone")
        assert digests(tmp_path) == [(0, alone.summary["content_digest"])]


class Here:
    """A worker that needs no process."""

    def __init__(self):
        self.answers = []
        self.idle = 1

    def submit(self, task):
        self.answers.append((task, task.run(lambda: False)))

    def collect(self, seconds):
        answers, self.answers = self.answers, []
        return answers

    def stop(self):
        pass


def tried(folder):
    """Return the trials of the sweep with their results."""
    trials = recorded_trials(Trials(state.read_sweep("small", folder)), folder)
    return [(trial.values, trial.value, trial.results[0].digest) for trial in trials]


def test_a_killed_sweep_ends_as_if_it_never_was(tmp_path):
    calm, killed = tmp_path / "calm", tmp_path / "killed"
    sweep = from_values(SWEEP)
    state.begin(sweep, calm, resume=False, accept_changes=False)
    run_sweep(sweep, calm, Here())
    with Served(killed) as server:
        server.post("/jobs", json.dumps(SWEEP))
        server.until(lambda jobs: (jobs[1]["progress"] or {}).get("done", 0) >= 1)
        server.kill()
        server.start()  # at once, while the old sweep still closes its recordings
        server.until(are_finished)
    assert len(list_runs(killed)) == len(tried(calm)) == 6
    assert tried(killed) == tried(calm)


@pytest.fixture
def small_disk(tmp_path):
    """Return the folder of a disk of 400 MB; a job is started while 268 MB are free."""
    mount = shutil.which("mount")
    command = [mount, "-t", "tmpfs", "-o", "size=400m", "tmpfs", str(tmp_path)]
    if mount is None or subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("only root mounts a disk")
    yield tmp_path
    subprocess.run(["umount", "--lazy", str(tmp_path)], check=True)


def test_on_a_full_disk_jobs_are_seen_and_cancelled_and_later_resumed(small_disk, undisturbed):
    with Served(small_disk / "runs", "--workers", "1") as server:
        server.post("/jobs", json.dumps(ENDLESS))
        submitted(server, [0, 1])
        server.until(is_under_way)
        filling = small_disk / "filling"
        with filling.open("wb") as stream:
            while free := shutil.disk_usage(small_disk).free:  # the run writes, too
                with contextlib.suppress(OSError):
                    os.posix_fallocate(stream.fileno(), stream.seek(0, 2), min(free, 1 << 20))
        assert shutil.disk_usage(small_disk).free == 0
        *waiting, first = [job["state"] for job in server.get("/jobs")["jobs"]]
        assert waiting == ["queued", "queued"]
        assert first in ("running", "failed"), "it fails when it has to write"
        assert server.client.post("/jobs", content=json.dumps(CONFIG)).status_code == 507
        assert server.client.post("/jobs/1/cancel").status_code in (200, 409), "409 if it has failed"
        assert server.post("/jobs/2/cancel")["state"] == "cancelled"
        jobs = server.until(lambda _: {run.status for run in list_runs(small_disk / "runs")} != {"running"})
        assert jobs[1]["state"] in ("cancelled", "failed")
        assert [jobs[number]["state"] for number in (2, 3)] == ["cancelled", "queued"]
        assert "are free" in server.get("/jobs")["queue"]["waiting_for"]

        filling.unlink()
        server.until(lambda jobs: jobs[3]["state"] == "finished")
        server.post("/jobs/2/resume")
        server.until(lambda jobs: jobs[2]["state"] == "finished")
        finished = [run for run in list_runs(small_disk / "runs") if run.status == "finished"]
        assert {run.seed: run.summary["content_digest"] for run in finished} == {
            seed: undisturbed[seed] for seed in (0, 1)
        }
