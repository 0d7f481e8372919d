"""What the tests of pictures share: runs of several worlds, each made once."""

from __future__ import annotations

from typing import ClassVar

import gymnasium
import numpy as np
import pytest

import runner
from runner.export.report import render_report
from runner.recording.reader import open_recording

_SHORT = {"evaluation": {"every": 20, "trials": 6}, "log": {"every_steps": 200, "window": 100}}
WORLDS = {
    "taxis": {"mode": "cooperative", "env": {"kwargs": {"max_episode_steps": 60}}},
    "rivals": {"mode": "competitive", "env": {"kwargs": {"max_episode_steps": 60}}},
    "taxi": {"env": {"id": "Taxi-v4"}},
    "lake": {"env": {"id": "FrozenLake-v1"}},
    "cliff": {"env": {"id": "CliffWalking-v1", "kwargs": {"max_episode_steps": 60}}},
    "stairs": {"env": {"id": "Stairs-v0"}},
}


class Stairs(gymnasium.Env):
    """Four states, one action up and one down; it says nothing of what it means."""

    P: ClassVar = {
        s: {a: [(1.0, min(max(s + 2 * a - 1, 0), 3), -1.0, s + a == 4)] for a in (0, 1)} for s in range(4)
    }
    initial_state_distrib = np.array([1.0, 0, 0, 0])
    observation_space = gymnasium.spaces.Discrete(4)
    action_space = gymnasium.spaces.Discrete(2)


@pytest.fixture(scope="session")
def pictured(tmp_path_factory):
    """Return a function that gives the run of a world, made when first asked for."""
    if "Stairs-v0" not in gymnasium.registry:
        gymnasium.register("Stairs-v0", Stairs, max_episode_steps=25)
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
            chosen = [("train", 7, 0), ("train", 30, 0)]
            made[world] = render_report([pictured(world).recording], chosen)[0]
        return made[world]

    return page


@pytest.fixture(params=WORLDS)
def recording(request, pictured):
    """An open recording of each world."""
    with open_recording(pictured(request.param).recording) as opened:
        yield opened
