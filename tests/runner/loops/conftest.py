"""A recordings folder that the tests of commands on loops share."""

from __future__ import annotations

import pytest

import runner
from tests.runner.loops.making import make, play


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """Return a recordings folder with loops of each kind, and two that differ only in the seed."""
    made = tmp_path_factory.mktemp("loops-commands")
    for name, env_id, seed in (
        ("lake", "FrozenLake-v1", 0),
        ("again", "FrozenLake-v1", 0),
        ("other", "FrozenLake-v1", 1),
        ("pole", "CartPole-v1", 0),
        ("rooms", "RoomsText", 0),
    ):
        with runner.record(make(env_id), made, name=name, seed=seed, config={"lr": 0.5}) as env:
            for k, entry in enumerate(play(env, 400, seed)):
                if entry[0] == "step":
                    env.log("loss", 1 / (k + 1))
            with env.phase("eval"):
                list(play(env, 60, seed))
            env.log("note", "done")
    return made
