"""The cost of recording pictures: Atari Pong with a stack of four, its whole steps or its actions alone.

The sides alternate in one run, with the same actions. A run's fixed part, some 25 kB, is in the bytes.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from typing import Any, Final

import gymnasium
import numpy as np
from gymnasium.wrappers import AtariPreprocessing, FrameStackObservation

import runner
from benchmarks.figures import Figure, figure

_BYTES: Final = {"all": (110, 60), "actions": (1.5, 0.5)}
_ADDED: Final = {"all": (60, 25), "actions": None}
"""Targets in bytes and microseconds a step: at least, aim."""


def measure(quick: bool) -> list[Figure]:
    """Return bytes and added time a step."""
    import ale_py

    gymnasium.register_envs(ale_py)
    steps, repetitions = (4_000, 2) if quick else (30_000, 3)
    actions = np.random.default_rng(0).integers(0, 6, steps).tolist()
    added: dict[str, list[float]] = {level: [] for level in _BYTES}
    whole: dict[str, list[float]] = {level: [] for level in _BYTES}
    size = dict.fromkeys(_BYTES, 0.0)
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(repetitions):
            alone = _play(_pong(), actions)
            for level in _BYTES:
                with runner.record(_pong(), folder, steps=level) as rec:
                    thread, process = _play(rec, actions)
                added[level].append((thread - alone[0]) / steps * 1e6)
                whole[level].append((process - alone[1]) / steps * 1e6)
                size[level] = rec.run.summary["bytes"] / steps
    figures = []
    for level, name in (("all", "whole steps"), ("actions", "actions alone")):
        threads = f"processor time of the loop's thread; all threads {statistics.median(whole[level]):.0f} us"
        figures += [
            figure(
                f"added per step, Pong, {name}",
                added[level],
                "us",
                _ADDED[level],
                higher_is_better=False,
                detail=threads,
            ),
            figure(f"  on disk, {name}", [size[level]], "bytes/step", _BYTES[level], higher_is_better=False),
        ]
    return figures


def _pong() -> Any:
    env = gymnasium.make("ALE/Pong-v5", frameskip=1)
    return FrameStackObservation(AtariPreprocessing(env, noop_max=0), 4)


def _play(env: Any, actions: list[int]) -> tuple[float, float]:
    """Take the actions; return the processor time of this thread and of the process."""
    thread, process = time.thread_time(), time.process_time()
    env.reset(seed=0)
    for action in actions:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()
    return time.thread_time() - thread, time.process_time() - process
