"""Shared by the tests of pictures: runs of several worlds, each recorded once."""

from __future__ import annotations

import pytest

import runner
from runner.analysis.episodes import EpisodeRef
from runner.export.reports.report import render_report
from runner.recording.reader import open_recording

_SHORT = {"evaluation": {"every": 20, "trials": 6}, "log": {"every_steps": 200, "window": 100}}
WORLDS = {
    "taxis": {"mode": "cooperative", "env": {"kwargs": {"max_episode_steps": 60}}},
    "rivals": {"mode": "competitive", "env": {"kwargs": {"max_episode_steps": 60}}},
    "taxi": {"env": {"id": "Taxi-v4"}},
    "lake": {"env": {"id": "FrozenLake-v1"}},
    "cliff": {"env": {"id": "CliffWalking-v1", "kwargs": {"max_episode_steps": 60}}},
    "corridor": {"env": {"id": "tests.runner.corridor:Corridor-v0"}},
}


@pytest.fixture(scope="session")
def pictured(tmp_path_factory):
    """Return a function that gives the run of a world, recorded on first use."""
    folder, made = tmp_path_factory.mktemp("pictured"), {}

    def run_of(world, **changes):
        key = f"{world} {changes}"
        if key not in made:
            config = {"name": world, "episodes": 40, "seed": 1, "snapshots": {"every": 10}}
            made[key] = runner.run(config | _SHORT | WORLDS[world] | changes, recordings=folder)
        return made[key]

    return run_of


@pytest.fixture(scope="session")
def page_of(pictured):
    """Return a function that gives the report of a world's run, with the training episodes 7 and 30."""
    made = {}

    def page(world):
        if world not in made:
            chosen = [EpisodeRef(7), EpisodeRef(30)]
            made[world] = render_report([pictured(world).recording], chosen)[0]
        return made[world]

    return page


@pytest.fixture(params=WORLDS)
def recording(request, pictured):
    """An open recording of each world."""
    with open_recording(pictured(request.param).recording) as opened:
        yield opened
