"""Workers on Ray: a task that raises, and an unreachable cluster; `test_sweep_kills.py` runs a sweep."""

from __future__ import annotations

import pytest

from runner.errors import RunnerError
from runner.sweep.model import Objective
from runner.sweep.task import Task

pytest.importorskip("ray")
from runner.sweep.workers import RayWorkers

pytestmark = [
    pytest.mark.long,
    pytest.mark.filterwarnings("ignore"),  # Ray's own, about its future defaults and open files
]


def test_a_task_that_raises_counts_as_one_whose_worker_died():
    impossible = Task("", 0, {}, 0, None, Objective(metric="mean_length"), run_id="none")  # a TypeError
    with RayWorkers(1, None, 1) as workers:
        workers.submit(impossible)
        assert workers.collect(60) == [(impossible, None)]


def test_an_unreachable_cluster_is_reported():
    with pytest.raises(RunnerError, match=r"no cluster at 127\.0\.0\.1:9"):
        RayWorkers(1, "127.0.0.1:9", 1)
