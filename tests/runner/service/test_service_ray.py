"""Jobs of the service on a Ray cluster of two machines, which are processes here."""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import sys
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest
from submitted import ENDLESS, ICY

import runner
from runner.client.jobs import LogEvent
from runner.recording.reader import open_recording
from runner.runs.run import list_runs, run_at
from runner.service.jobs import worker as worker_jobs
from runner.service.jobs.checking import check
from runner.service.jobs.queue import JobQueue
from runner.service.jobs.worker import JobChannel, require_job_api
from tests.waiting import until

for module in ("ray", "aiohttp_cors"):  # the second is of `ray[default]`, which has the job API
    pytest.importorskip(module)

pytestmark = [
    pytest.mark.long,
    pytest.mark.filterwarnings("ignore"),  # Ray's own, about its future defaults and open files
]

LONG = ENDLESS | {"name": "long", "episodes": 10_000, "seeds": [0]}
"""Five seconds."""
SWEEP = {
    "name": "small",
    "base": ICY | {"name": "base", "seeds": [0]},
    "strategy": "grid",
    "parameters": {"step_size": [0.2, 0.9]},
    "seeds": [0],
}


def submit(jobs, config):
    text = json.dumps(config)
    return jobs.add(text, check(text, "job.yaml", jobs.recordings)).number


def job_until(jobs, number, condition):
    return until(condition, lambda: jobs.store.job(number), seconds=120)


def digests(runs):
    return [run.summary["content_digest"] for run in sorted(runs, key=lambda run: run.seed)]


def kill_machine(node):
    """Kill all processes of a node of the cluster, such as the command that does a job."""
    (raylet,) = node.all_processes["raylet"]
    for process in psutil.Process(raylet.process.pid).children(recursive=True):
        with contextlib.suppress(psutil.NoSuchProcess):
            process.kill()


@pytest.fixture(scope="module")
def cluster():
    """Return a cluster whose head has no processors, so that jobs run on another machine."""
    from ray.cluster_utils import Cluster

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
        patch.delenv("RAY_ADDRESS", raising=False)
        made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": True})
        yield made
        made.shutdown()


def test_jobs_on_a_cluster_give_the_same_runs_are_cancelled_and_outlive_a_machine(cluster, tmp_path):
    here = runner.run_all(ICY, recordings=tmp_path / "here")
    first = cluster.add_node(num_cpus=1)
    with JobQueue(tmp_path / "far", 2, ray=cluster.address) as jobs:
        number = submit(jobs, ICY)
        over = job_until(jobs, number, lambda job: job.is_over)
        assert over.state == "finished", over.error
        far = list_runs(tmp_path / "far")
        assert digests(far) == digests(here)
        assert over.started_runs == {run.seed: run.run_id for run in sorted(far, key=lambda run: run.seed)}
        kinds = {event.kind for event in jobs.store.events(number)[0]}
        assert kinds == {"state", "run", "log"}
        with open_recording(far[0].recording) as recording:
            assert recording.provenance["package.ray"]

        endless = submit(jobs, ENDLESS)
        job_until(jobs, endless, lambda job: job.progress and job.progress.episode > 0)
        (worker,) = [each for each in multiprocessing.active_children() if each.name == f"job-{endless}"]
        worker.kill()  # the command on the cluster goes on, and is replaced
        job_until(jobs, endless, lambda job: job.deaths and job.state == "running")
        job_until(jobs, endless, lambda job: job.progress and job.progress.episode > 0)
        jobs.cancel(endless)
        (run,) = until(
            lambda runs: runs[0].status == "interrupted",
            lambda: [run for run in list_runs(tmp_path / "far") if run.name == "endless"],
        )

        long = submit(jobs, LONG)
        job_until(jobs, long, lambda job: job.progress and job.progress.episode > 0)
        kill_machine(first)
        cluster.remove_node(first, allow_graceful=False)
        (run,) = until(
            lambda runs: runs[0].status == "interrupted",
            lambda: [run for run in list_runs(tmp_path / "far") if run.name == "long"],
        )
        second = cluster.add_node(num_cpus=1)
        over = job_until(jobs, long, lambda job: job.is_over)
        assert (over.state, over.deaths) == ("finished", 1), over.error
        events = jobs.store.events(long)[0]
        assert [event.data.run_id for event in events if event.kind == "run"] == [run.run_id] * 2, "resumed"
        assert run_at(run.folder).summary["episodes"] == LONG["episodes"]
        (info,) = [
            info
            for info in require_job_api().JobSubmissionClient(cluster.address).list_jobs()
            if info.status == "SUCCEEDED" and info.metadata["folder"].endswith(f"/{long}")
        ]
        assert info.driver_node_id == second.node_id

        number = submit(jobs, SWEEP)
        over = job_until(jobs, number, lambda job: job.is_over)
        assert over.state == "finished", over.error
        assert over.progress.done == 2


def test_a_cluster_that_cannot_be_reached_fails_the_job(tmp_path):
    with JobQueue(tmp_path / "far", 1, ray="http://127.0.0.1:9") as jobs:
        over = job_until(jobs, submit(jobs, ICY), lambda job: job.is_over)
        assert over.state == "failed"
        assert over.error.startswith("--ray: the cluster at http://127.0.0.1:9 does not do this job: ")


def test_a_cluster_that_has_no_agent_yet_is_asked_again(tmp_path, monkeypatch):
    answers = [RuntimeError("500: No available agent to submit job, please try again later."), "first"]

    class Client:
        def list_jobs(self):
            return []

        def submit_job(self, **_):
            answer = answers.pop(0)
            if isinstance(answer, str):
                return answer
            raise answer

        def get_job_status(self, _):
            return SimpleNamespace(is_terminal=lambda: True)

        def get_job_info(self, submission):
            return SimpleNamespace(message=f"{submission} is over")

        async def tail_job_logs(self, _):
            yield ""

    monkeypatch.setattr(worker_jobs, "POLL_SECONDS", 0.01)
    monkeypatch.setattr(
        worker_jobs, "require_job_api", lambda: SimpleNamespace(JobSubmissionClient=lambda _: Client())
    )
    events = []
    spec = SimpleNamespace(folder=tmp_path, job=SimpleNamespace(run_ids=()))
    worker_jobs.do_on_cluster(spec, "http://127.0.0.1:1", JobChannel(events.append, lambda: False))
    assert not answers
    assert events == [LogEvent("Ray: first is over")]
