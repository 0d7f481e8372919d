"""The cost of recording Stable-Baselines3: `model.learn` with the callback, against the same without.

Both sides alternate in one process, with one thread of PyTorch. It needs the extra `sb3`, which the
environment of `make bench` does not have: `.venv-integrations/bin/python -m benchmarks sb3`.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from typing import Any

import runner
from benchmarks.figures import Figure, figure

N_ENVS = 8


def measure(quick: bool) -> list[Figure]:
    """Return how much more processor time training takes when it is recorded; nothing without the library."""
    try:
        import stable_baselines3  # noqa: F401
        import torch
    except ImportError:
        return []
    torch.set_num_threads(1)
    steps, repetitions = (16_384, 2) if quick else (49_152, 5)
    with tempfile.TemporaryDirectory() as folder:
        figures = [_collecting(count, folder, steps // 2, repetitions) for count in (1, 4, 8)]
        return [*figures, _learning(folder, steps, repetitions)]


def _collecting(count: int, folder: str, steps: int, repetitions: int) -> Figure:
    """Return what recording adds to each step of an environment, in a `learn` of DQN that only collects."""
    from stable_baselines3 import DQN

    def collect(callback: Any) -> tuple[float, float]:
        never = {"learning_starts": 10**9, "buffer_size": 1_000}
        return _learn(DQN("MlpPolicy", _environments(count), seed=0, device="cpu", **never), steps, callback)

    added, whole = [], []
    for repetition in range(repetitions + 1):
        plain, recorded = collect(None), collect(runner.integrations.sb3.Recording(folder))
        if repetition:  # the first one warms up
            added.append((recorded[0] - plain[0]) / steps * 1e6)
            whole.append((recorded[1] - plain[1]) / steps * 1e6)
    return figure(
        f"added per environment step, {count} environment{'s' if count > 1 else ''}",
        added,
        "us",
        (5, 3),
        higher_is_better=False,
        detail="DQN on CartPole-v1 before it learns, from the start of learn to the end of the file; "
        f"processor time of the learning thread; all threads {statistics.median(whole):.1f} us",
    )


def _learning(folder: str, steps: int, repetitions: int) -> Figure:
    """Return how much slower PPO is when it is recorded."""
    _train(2_048, None)
    _train(2_048, runner.integrations.sb3.Recording(folder))
    slower, threads, alone = [], [], []
    for _ in range(repetitions):
        plain = _train(steps, None)
        recorded = _train(steps, runner.integrations.sb3.Recording(folder))
        slower.append((recorded[0] / plain[0] - 1) * 100)
        threads.append((recorded[1] / plain[1] - 1) * 100)
        alone.append(plain[0])
    added = statistics.median(slower) / 100 * statistics.median(alone) / steps * 1e6
    return figure(
        f"PPO, CartPole-v1, {N_ENVS} environments",
        slower,
        "% slower",
        (10, 3),
        higher_is_better=False,
        detail=f"processor time of the learning thread, {added:.1f} us a step; all threads "
        f"{statistics.median(threads):.1f} %",
    )


def _train(steps: int, callback: Any) -> tuple[float, float]:
    """Return the processor time of a training, of this thread and of the process."""
    from stable_baselines3 import PPO

    return _learn(PPO("MlpPolicy", _environments(N_ENVS), seed=0, device="cpu"), steps, callback)


def _environments(count: int) -> Any:
    from stable_baselines3.common.env_util import make_vec_env

    return make_vec_env("CartPole-v1", n_envs=count, seed=0)


def _learn(model: Any, steps: int, callback: Any) -> tuple[float, float]:
    thread, process = time.thread_time(), time.process_time()
    model.learn(steps, callback=callback)
    return time.thread_time() - thread, time.process_time() - process
