"""A sweep on Ray: what it gives, and what a killed worker or a cluster that is not there do to it."""

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
    """Return the processes in which a sweep's tasks are done; idle ones of Ray's are called otherwise."""
    return [p for p in psutil.Process().children(recursive=True) if "RayActor" in " ".join(p.cmdline())]


def test_ray_gives_what_local_workers_give_also_when_one_is_killed(tmp_path):
    base = described()["base"] | {"episodes": 60_000, "evaluation": {"every": 20_000, "trials": 5}}
    sweep = from_values(described(strategy="random", trials=3, seeds=[0, 1], base=base))
    killed = []

    def kill_one(standing):
        if not killed and standing.done >= 1 and standing.running == 2:
            killed.append(workers_of_ray()[0].pid)
            os.kill(killed[0], signal.SIGKILL)

    with RayWorkers(2, None, 6) as workers:
        trials, standing = swept(tmp_path / "ray", sweep, workers, report=kill_one)
        impossible = Task("", 0, {}, "small", (), None, sweep.objective, run_id="none")  # a TypeError
        workers.give(impossible)
        assert workers.collect(60) == [(impossible, None)]
    assert killed
    assert (standing.done, standing.failed) == (6, 0)
    assert len(list_runs(tmp_path / "ray")) == 6
    here, _ = swept(tmp_path / "here", sweep)
    assert digests(trials) == digests(here)


def test_a_cluster_that_is_not_there_is_told():
    with pytest.raises(RunnerError, match=r"no cluster at 127\.0\.0\.1:9"):
        RayWorkers(1, "127.0.0.1:9", 1)
