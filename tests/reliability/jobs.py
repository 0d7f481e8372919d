"""A server's jobs and kills at random moments: `python -m tests.reliability.jobs [--kills N] [--seed S]`.

Jobs of several seeds and sweeps are submitted to a server. Again and again, the server, one of its workers,
or all of them are killed (SIGKILL); jobs are cancelled and resumed, by several clients at once. Afterwards

1. every job is finished: none stands still, and none has lost or repeated a run;
2. every run has the content digest of an undisturbed run;
3. the log of every job has its states in a possible order, and each event once for every watcher.

`--jobs N` submits N small jobs at once instead, and prints how long they take.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import contextlib
import itertools
import json
import random
import re
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any, Final

import httpx2
import psutil

import runner
from runner.runs.run import list_runs
from tests.runner.service.served import Served
from tests.waiting import until

CONFIG: Final[dict[str, Any]] = {
    "name": "quick",
    "episodes": 1200,
    "mode": "cooperative",
    "epsilon": {"schedule": "linear", "start": 1.0, "end": 0.1, "over": 1200},
    "evaluation": {"every": 200, "trials": 100},
}
SWEEP: Final[dict[str, Any]] = {
    "base": CONFIG | {"episodes": 5000, "name": "base", "recording": {"steps": "none"}},
    "strategy": "grid",
    "parameters": {"step_size": [0.2, 0.9]},
    "seeds": [0, 1],
}
TINY: Final[dict[str, Any]] = {"env": {"id": "FrozenLake-v1"}, "episodes": 5, "evaluation": None}
KILLS: Final = ("server", "worker", "both")
EVENT: Final = re.compile(r"^id: ", re.MULTILINE)
"""The line of an event that is kept: any but progress."""
SEEDS: Final = 2
"""Runs of a job."""
AT_A_TIME: Final = 3
"""Unfinished jobs."""


class Killing:
    """A server, its jobs, and what was done to them."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.server = Served(folder)
        self.random = random.Random(seed)
        self.done = Counter[str]()
        self.submitted = 0

    def jobs(self) -> dict[int, dict[str, Any]]:
        """Return the jobs by number."""
        return {job["number"]: job for job in self.server.get("/jobs?limit=1000")["jobs"]}

    def submit(self) -> None:
        """Submit another job: every third one is a sweep."""
        number = self.submitted
        self.submitted += 1
        values = SWEEP | {"name": f"sweep{number}"}
        if number % 3:
            values = CONFIG | {"seeds": [SEEDS * number + i for i in range(SEEDS)]}
        self.server.post("/jobs", json.dumps(values))

    def kill(self) -> None:
        """Kill the server, one of its workers, or everything."""
        what = self.random.choice(KILLS)
        workers = [process for process in self.server.workers() if is_worker(process)]
        if what == "worker" and not workers:
            what = "both"
        self.done[what] += 1
        if what == "worker":
            with contextlib.suppress(psutil.NoSuchProcess):
                self.random.choice(workers).kill()
            return
        self.server.kill(with_workers=what == "both")
        self.server.start()

    def ask(self, verb: str, number: int) -> None:
        """Cancel or resume a job, whose state may have changed meanwhile."""
        answer = self.server.client.post(f"/jobs/{number}/{verb}")
        assert answer.status_code in (200, 409), answer.text
        self.done[f"{verb} {answer.status_code}"] += 1

    def race(self, number: int) -> None:
        """Cancel and resume a job, by several clients at once."""
        verbs = self.random.choices(("cancel", "resume"), k=8)
        with concurrent.futures.ThreadPoolExecutor(4) as clients:
            for answer in [clients.submit(self.ask, verb, number) for verb in verbs]:
                answer.result()

    def continue_all(self) -> list[dict[str, Any]]:
        """Resume jobs that were cancelled, or failed as their workers were killed; return unfinished ones."""
        jobs = self.jobs()
        for job in jobs.values():
            if job["state"] == "cancelled" or "its worker died" in job["error"]:
                self.ask("resume", job["number"])
            else:
                assert job["state"] != "failed", job
        return [job for job in jobs.values() if job["state"] != "finished"]

    def run(self, kills: int) -> None:
        """Kill so often, then wait until all jobs are finished."""
        while sum(self.done[what] for what in KILLS) < kills:
            unfinished = self.continue_all()
            for _ in range(AT_A_TIME - len(unfinished)):
                self.submit()
            if unfinished and self.random.random() < 0.3:
                self.race(self.random.choice(unfinished)["number"])
            time.sleep(self.random.uniform(0, 2))
            self.kill()
        until(lambda unfinished: not unfinished, self.continue_all, 600)


def is_worker(process: psutil.Process) -> bool:
    """Return whether a process is the worker of a job, or one of its own; they yield to the server."""
    with contextlib.suppress(psutil.NoSuchProcess):
        return bool(process.nice() > psutil.Process().nice())
    return False


def check_runs(folder: Path, jobs: dict[int, dict[str, Any]], calm: Path) -> int:
    """Check that every job has its runs, each once, with the content of undisturbed runs; return how many."""
    runs = list_runs(folder)
    assert [run.status for run in runs] == ["finished"] * len(runs)
    assert len(runs) == sum(job["runs"] for job in jobs.values()), "a run was lost, or made twice"
    digests: dict[str, str] = {}
    for run in runs:
        job = json.dumps([run.file.config | {"name": "", "seeds": []}, run.seed], sort_keys=True)
        if job not in digests:
            config = run.file.config | {"seeds": [run.seed]}
            alone = runner.run(config, recordings=calm)
            digests[job] = str(alone.summary["content_digest"])
        assert run.summary["content_digest"] == digests[job], run
    return len(runs)


def check_events(server: Served, job: dict[str, Any]) -> int:
    """Check the events of a job, from the first and from one in the middle; return how many there are."""
    address = f"{server.url}/api/v1/jobs/{job['number']}/events"
    events = [
        dict(line.split(": ", 1) for line in block.splitlines())
        for block in httpx2.get(address, timeout=60).text.split("\n\n")
        if EVENT.search(block)
    ]
    ids = [int(event["id"]) for event in events]
    assert ids == sorted(set(ids))
    states = [json.loads(event["data"])["state"] for event in events if event["event"] == "state"]
    assert (states[0], states[-1]) == ("queued", "finished"), states
    for before, after in itertools.pairwise(states):
        assert after != "running" or before in ("queued", "running"), states
    middle = len(events) // 2
    later = httpx2.get(address, headers={"Last-Event-ID": str(ids[middle])}, timeout=60).text
    assert len(EVENT.findall(later)) >= len(events) - middle - 1
    begun = {json.loads(event["data"])["run_id"] for event in events if event["event"] == "run"}
    assert begun == {run["run_id"] for run in job["begun"]}
    return len(events)


def run_many(folder: Path, count: int) -> None:
    """Submit many small jobs, and print how long that takes, and how long until all are finished."""
    with Served(folder) as server:
        began = time.monotonic()
        for seed in range(count):
            server.post("/jobs", json.dumps(TINY | {"seed": seed}))
        submitted = time.monotonic() - began
        until(
            lambda queue: not queue["running"] and not queue["queued"],
            lambda: server.get("/jobs?limit=0")["queue"],
            600,
        )
        seconds = time.monotonic() - began
        jobs = server.get("/jobs?limit=1000")["jobs"]
    assert Counter(job["state"] for job in jobs) == {"finished": count}
    assert len(list_runs(folder)) == count
    print(f"{count} jobs: submitted in {submitted:.1f} s, finished after {seconds:.1f} s")


def main() -> None:
    """Kill, and check what comes of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=0)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as parent:
        folder, calm = Path(parent) / "runs", Path(parent) / "calm"
        if arguments.jobs:
            run_many(folder, arguments.jobs)
            return
        began, killing = time.monotonic(), Killing(folder, arguments.seed)
        try:
            with killing.server:
                killing.run(arguments.kills)
                jobs = killing.jobs()
                events = sum(check_events(killing.server, job) for job in jobs.values())
            runs = check_runs(folder, jobs, calm)
        except BaseException:
            sys.stderr.write(killing.server.log.read_text()[-20_000:])
            raise
        print(f"{dict(killing.done)}; {time.monotonic() - began:.0f} s")
        print(f"{len(jobs)} jobs with {runs} runs and {events} events: none failed")


if __name__ == "__main__":
    main()
