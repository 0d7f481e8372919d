"""Environments that workers make by a function: one run, whose processes are put together."""

from __future__ import annotations

import functools
import pickle

import gymnasium
from scripts import the_run

from runner.execution.verify import verify
from runner.integrations.libraries import Workers

make = functools.partial(gymnasium.make, "CartPole-v1")


def test_the_environments_of_workers_are_one_run():
    with Workers(make, name="workers", seed=3, config={"lr": 0.1}) as recording:
        functions = [recording.train, pickle.loads(pickle.dumps(recording.train))]
        for seed, function in enumerate(functions):
            env = function()
            env.reset(seed=seed)
            env.step(0)
            env.close()
        recording.recorded.log("loss", 0.5)
    run = the_run()
    assert (run.name, run.seed, run.status) == ("workers", 3, "finished")
    assert run.summary["train_steps"] == 2
    assert run.summary["logged"] == {"loss": 0.5}
    assert verify(run.recording).verdict == "reproduced"


def test_an_error_is_that_of_the_run():
    try:
        with Workers(make, name="workers"):
            raise ValueError("mine")
    except ValueError:
        pass
    assert the_run().status == "failed"
