"""Jobs of the service on a Ray cluster."""

from __future__ import annotations

import json

import pytest
from submitted import ENDLESS, ICY

import runner
from runner.recording.reader import open_recording
from runner.runs.listing import list_runs
from runner.service.jobs.checking import check
from runner.service.jobs.queue import JobQueue
from tests.waiting import until

pytest.importorskip("ray")
from runner.sweep.cluster import connect

pytestmark = pytest.mark.filterwarnings("ignore")  # Ray's own, about its future defaults and open files


def submit(jobs, config):
    text = json.dumps(config)
    return jobs.add(text, check(text, "job.yaml", jobs.recordings))


@pytest.fixture(scope="module")
def cluster():
    """Return the address of a cluster on this machine."""
    ray = connect(None, 2)
    yield ray.get_runtime_context().gcs_address
    ray.shutdown()


def test_a_job_on_ray_gives_the_same_runs_and_can_be_cancelled(cluster, tmp_path):
    here = runner.run_all(ICY, recordings=tmp_path / "here")
    with JobQueue(tmp_path / "far", 1, ray=cluster) as jobs:
        number = submit(jobs, ICY).number
        over = until(lambda job: job.is_over, lambda: jobs.store.job(number), seconds=240)
        assert over.state == "finished", over.error
        far = sorted(list_runs(tmp_path / "far"), key=lambda run: run.seed)
        digests = [[run.summary["content_digest"] for run in runs] for runs in (far, here)]
        assert digests[0] == digests[1]
        assert over.started_runs == {run.seed: run.run_id for run in far}
        kinds = {event.kind for event in jobs.store.events(number)[0]}
        assert kinds == {"state", "run", "log"}
        with open_recording(far[0].recording) as recording:
            assert recording.provenance["package.ray"]
        endless = submit(jobs, ENDLESS).number
        until(lambda progress: progress and progress.episode > 0, lambda: jobs.store.job(endless).progress)
        jobs.cancel(endless)
        until(lambda job: job.state == "cancelled", lambda: jobs.store.job(endless))
    (run,) = [run for run in list_runs(tmp_path / "far") if run.name == "endless"]
    assert run.status == "interrupted"
