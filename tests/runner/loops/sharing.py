"""Processes that record one run together, for tests of shards."""

from __future__ import annotations

import functools
import random
import time
from multiprocessing.process import BaseProcess

import gymnasium
import numpy as np

import runner
from runner.service.processes import PRELOADED
from runner.util.processes import process_context, start_process

FORKED = process_context(PRELOADED)
"""Starts processes that have nothing of this one, yet need not import what they record with."""


def play(rec, steps: int, seed: int | None, delay: float = 0.0, log: bool = True) -> None:
    """Take steps with random actions in an environment, with resets, extras and logged numbers."""
    chance, generator = random.Random(), np.random.default_rng(seed)
    rec.reset(seed=seed)
    for step in range(steps):
        if delay and step % 40 == 0:
            time.sleep(chance.random() * delay)
        action = int(generator.integers(rec.action_space.n))
        _, _, terminated, truncated, _ = rec.step(action, {"value": step / 2})
        if terminated or truncated:
            rec.reset()
        if log and step % 50 == 0:
            rec.log("loss", 1 / (step + 1))


def work(run, shard, steps, seed, delay=0.0, env_id="CartPole-v1", phase="train", at=None):
    """Join a run and take steps, in a process of its own."""
    env = gymnasium.make(env_id)
    with runner.record(env, join=run, shard=shard, phase=phase) as rec:
        if at is not None:
            rec.at_step(at)
        play(rec, steps, seed, delay)


def run_all(*processes) -> None:
    for process in processes:
        process.start()
    for process in processes:
        process.join(60)
        assert process.exitcode == 0


def started(*arguments, **keywords) -> BaseProcess:
    """Let another process do the work; return it."""
    return start_process(FORKED, functools.partial(work, **keywords), *arguments)
