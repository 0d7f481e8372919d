"""Charts of how a training went on its machine."""

from __future__ import annotations

import re

import numpy as np
import pytest

from runner.export.plots.training import machine_facts, machine_plots
from runner.recording.machine import FIELDS, GPU_FIELDS, Clock, HostMetrics

CLOCK = Clock(np.array([0, 100, 400]), np.array([0.0, 10.0, 20.0]), np.zeros(3), {0.0: 0.0})


def host_of(gpus=0, **values):
    rows = {name: np.full(3, np.nan) for name in FIELDS} | {
        name: np.full((3, gpus), 50.0) for name in GPU_FIELDS
    }
    return HostMetrics(
        np.arange(3),
        np.array([1.0, 2.0, 3.0]),
        rows | {key: np.array(own) for key, own in values.items()},
        np.zeros(3),
    )


@pytest.mark.parametrize(
    ("host", "titles"),
    [
        (None, []),
        (host_of(), []),
        (host_of(cpu_percent=[5.0, np.nan, 9.0]), ["Processor, this process"]),
        (host_of(disk_read_bytes=[1e6, 3e6, 9e6]), ["Disk, all of the machine"]),
        (host_of(gpus=2), ["GPU", "GPU memory"]),
    ],
)
def test_only_what_is_known_is_drawn(host, titles):
    plots = [*machine_plots(CLOCK, host)]
    drawn = [re.search(r'aria-label="([^"]*)"', plot.picture)[1] for plot in plots]
    assert drawn == ["Steps a second", *titles]
    assert all("nan" not in plot.picture for plot in plots)


def test_a_run_that_took_no_time_has_no_charts():
    clock = Clock(np.zeros(1, np.int64), np.zeros(1), np.zeros(1))
    assert [*machine_plots(clock, None)] == []
    assert machine_facts(clock, None)["Steps a second, mean"] == "–"


def test_facts_have_the_time_of_all_sessions():
    resumed = Clock(CLOCK.positions, CLOCK.seconds, np.array([1.0, 1.0, 2.0]), {1.0: 0.0, 2.0: 10.0})
    facts = machine_facts(resumed, host_of(memory_bytes=[1e9, 3e9, np.nan]))
    assert facts["Time"] == "20 s, in 2 sessions"
    assert facts["Steps a second, mean"] == "20"
    assert facts["Memory of the process, largest"] == "3.0 GB"
