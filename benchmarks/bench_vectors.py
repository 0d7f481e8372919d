"""The cost of recording vector environments and batches of steps, whose environments take no time."""

from __future__ import annotations

import shutil
import statistics
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

import runner
from benchmarks.figures import Figure, figure, processor_seconds


def measure(quick: bool) -> list[Figure]:
    """Return the overhead of a vector step, and the steps a second of batches."""
    steps, repetitions = (4_000, 3) if quick else (20_000, 5)
    with tempfile.TemporaryDirectory() as folder:
        figures = [_vector(count, Path(folder), steps, repetitions) for count in (1, 4, 16)]
        figures.append(_vector(16, Path(folder), steps, repetitions, AutoresetMode.SAME_STEP, length=8))
        return figures + [_batches(count, Path(folder), steps * 200, repetitions) for count in (16, 1024)]


def ends_of(draws: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return ends of episodes, [T, N] over and over, none of them in the step after another."""
    ends = draws & ~np.roll(draws, 1, axis=0)
    return ends & ~np.roll(ends, 1, axis=0)


class Prepared(gymnasium.vector.VectorEnv[Any, Any, Any]):
    """Vector environments that take no time: one step in `length` of the prepared arrays ends an episode."""

    def __init__(self, count: int, mode: AutoresetMode = AutoresetMode.NEXT_STEP, length: int = 22) -> None:
        self.metadata = {"autoreset_mode": mode}
        self.num_envs = count
        self.single_observation_space = spaces.Box(-9, 9, (4,), np.float32)
        self.single_action_space = spaces.Discrete(2)
        self.observation_space = batch_space(self.single_observation_space, count)
        self.action_space = batch_space(self.single_action_space, count)
        draws = np.random.default_rng(0)
        self._observations = draws.normal(size=(1024, count, 4)).astype(np.float32)
        self._rewards = np.ones(count)
        self._ends = ends_of(draws.random((1024, count)) < 1 / length)
        last = np.empty(count, object)
        last[:] = list(self._observations[0])
        self._infos = [
            {"final_obs": last, "_final_obs": ends} if mode == AutoresetMode.SAME_STEP and ends.any() else {}
            for ends in self._ends
        ]
        self._never = np.zeros(count, np.bool_)
        self._t = 0

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:  # noqa: ARG002
        """Return the first observations."""
        return self._observations[0], {}

    def step(self, actions: Any) -> Any:  # noqa: ARG002
        """Return the next of the prepared arrays."""
        self._t = t = (self._t + 1) % 1024
        return self._observations[t], self._rewards, self._ends[t], self._never, self._infos[t]


def _vector(
    count: int,
    folder: Path,
    steps: int,
    repetitions: int,
    mode: AutoresetMode = AutoresetMode.NEXT_STEP,
    length: int = 22,
) -> Figure:
    """Return the overhead of recording per step of a vector environment; `length` is the mean episode's."""
    make = partial(Prepared, count, mode, length)
    added, whole = [], []
    for _ in range(repetitions):
        alone = processor_seconds(partial(_drive_vector, make(), steps))
        with runner.record_vector(make(), folder / "recordings") as envs:
            recorded = processor_seconds(partial(_drive_vector, envs, steps))
        added.append((recorded[0] - alone[0]) / steps * 1e6)
        whole.append((recorded[1] - alone[1]) / steps * 1e6)
    return figure(
        f"vector step, {count} environment{'s' if count > 1 else ''}"
        + (f", SameStep, {length} steps" if mode == AutoresetMode.SAME_STEP else ""),
        added,
        "us",
        (20, 6),
        higher_is_better=False,
        detail=f"processor time of the loop's thread; all threads {statistics.median(whole):.2f} us",
    )


def _drive_vector(envs: Any, steps: int) -> None:
    actions = np.zeros(envs.num_envs, np.int64)
    envs.reset(seed=0)
    for _ in range(steps):
        envs.step(actions)


def _batches(count: int, folder: Path, steps: int, repetitions: int) -> Figure:
    """Return how many steps of this many environments are recorded a second, from batches of 128 steps."""
    draws = np.random.default_rng(0)
    moves = draws.normal(scale=0.01, size=(129, count, 4)).astype(np.float32)
    observations, actions = moves.cumsum(axis=0), draws.integers(0, 2, (128, count))
    rewards, ends = np.ones((128, count), np.float32), ends_of(draws.random((128, count)) < 1 / 200)
    batches = max(1, steps // rewards.size)
    rates, spent, size = [], [], 0.0
    for _ in range(repetitions):
        begin, began = time.process_time(), time.perf_counter()
        with runner.record_batches(
            "CartPole", folder / "recordings", action_space=spaces.Discrete(2), autoreset_mode="NextStep"
        ) as rec:
            rec.reset(observations[0])
            for _ in range(batches):
                rec.batch(observations[1:], actions, rewards, ends)
        rates.append(batches * rewards.size / (time.perf_counter() - began) / 1e6)
        spent.append((time.process_time() - begin) / (batches * rewards.size) * 1e9)
        size = rec.run.summary["bytes"] / (batches * rewards.size)
        shutil.rmtree(rec.run.folder)
    return figure(
        f"batches of {count:,} environments",
        rates,
        "M steps/s",
        (3, 10),
        detail=f"CartPole's observations, to the end of the file; {statistics.median(spent):.0f} ns of "
        f"processor time a step, all threads; {size:.0f} bytes a step",
    )
