"""A sweep on Ray: its results, a killed worker, and an unreachable cluster."""

from __future__ import annotations

import os
import signal

import psutil
import pytest
from sweeping import described, digests, swept

from runner.errors import RunnerError
from runner.runs.run import list_runs
from runner.sweep.loading import from_values
from runner.sweep.task import Task

pytest.importorskip("ray")
from runner.sweep.cluster import RayWorkers

pytestmark = pytest.mark.filterwarnings("ignore")  # Ray's own, about its future defaults and open files


def workers_of_ray():
    """Return the processes of a sweep's tasks; idle processes of Ray have other names."""
    return [p for p in psutil.Process().children(recursive=True) if "RayActor" in " ".join(p.cmdline())]


def test_ray_gives_the_results_of_local_workers_also_when_one_is_killed(tmp_path):
    base = described()["base"] | {"episodes": 60_000, "evaluation": {"every": 20_000, "trials": 5}}
    sweep = from_values(described(strategy="random", trials=3, seeds=[0, 1], base=base))
    killed = []

    def kill_one(status):
        if not killed and status.done >= 1 and status.running == 2:
            killed.append(workers_of_ray()[0].pid)
            os.kill(killed[0], signal.SIGKILL)

    with RayWorkers(2, None, 6) as workers:
        trials, status = swept(tmp_path / "ray", sweep, workers, report=kill_one)
        impossible = Task("", 0, {}, "small", (), None, sweep.objective, run_id="none")  # a TypeError
        workers.submit(impossible)
        assert workers.collect(60) == [(impossible, None)]
    assert killed
    assert (status.done, status.failed) == (6, 0)
    assert len(list_runs(tmp_path / "ray")) == 6
    here, _ = swept(tmp_path / "here", sweep)
    assert digests(trials) == digests(here)


def test_an_unreachable_cluster_is_reported():
    with pytest.raises(RunnerError, match=r"no cluster at 127\.0\.0\.1:9"):
        RayWorkers(1, "127.0.0.1:9", 1)
