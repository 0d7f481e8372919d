"""Loops over real environments, and environments of bad habits, for the tests of reruns."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import time
import zlib
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import runner
from runner.recording.reader import open_recording
from runner.replay.environment import rerun
from tests.runner.loops.making import Rooms

SEEDING = ("once", "each", "never")
"""Whether the first reset has a seed, each, or none."""


def record(env: Any, folder: Path, steps: int, seeding: str = "once", **options: Any) -> Path:
    """Record random steps of an environment; return the recording."""
    with runner.record(env, folder, **options) as recorded:
        recorded.action_space.seed(1)
        episode, over = 0, True
        for _ in range(steps):
            if over:
                seed = None if seeding == "never" or (seeding == "once" and episode) else 7 + episode
                recorded.reset(seed=seed)
                episode += 1
            _, _, terminated, truncated, _ = recorded.step(recorded.action_space.sample())
            over = terminated or truncated
    return recorded.run.recording


def rerun_steps(path: Path, *arguments: Any, **options: Any) -> tuple[int, Any]:
    """Return how many steps were rerun, and the first difference."""
    steps, difference = 0, None
    with open_recording(path) as recording:
        for block in rerun(recording, *arguments, **options):
            assert len(block) == len(block.got["rewards"]) == len(block.recorded["t"])
            steps, difference = steps + len(block), block.difference
    return steps, difference


def rooms() -> Rooms:
    """Return an environment whose observations and actions are dictionaries."""
    return Rooms()


def rooms_with_text() -> Rooms:
    """Return one whose observations vary in size."""
    return Rooms(with_text=True)


class Counter(gymnasium.Env[Any, Any]):
    """Counts its steps from a random number up, and ends at 10 more."""

    observation_space = spaces.Box(0, 1e6, (1,), np.float64)
    action_space = spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.t, self.start = 0, float(self.np_random.integers(1000)) + (options or {}).get("add", 0)
        return np.array([self.start]), {}

    def step(self, action: Any) -> Any:
        self.t += 1
        return np.array([self.start + self.t]), self.reward(), self.t == 10, False, {}

    def reward(self) -> float:
        return 1.0


class Telling(Counter):
    """Begins at a number that tells which options of which types it got."""

    observation_space = spaces.Box(0, 2.0**32, (1,), np.float64)

    def reset(self, *, seed: int | None = None, options: dict[Any, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.start = float(zlib.crc32(repr(options).encode()))
        return np.array([self.start]), {}


def counters() -> SyncVectorEnv:
    """Return three of them that are reset by hand."""
    return SyncVectorEnv([counter] * 3, autoreset_mode=AutoresetMode.DISABLED)


class Twisted(Counter):
    """Has a generator whose state is not recorded, until a reset with a seed."""

    def __init__(self) -> None:
        self._np_random = np.random.Generator(np.random.MT19937())


def twisted() -> Twisted:
    """Return one."""
    return Twisted()


class Ordered(Counter):
    """Rewards depend on the order of a set of texts."""

    def reward(self) -> float:
        return float(sum(place * ord(text) for place, text in enumerate(set("abcdefghijklmnop"))))


class Clocked(Counter):
    """Rewards depend on the day."""

    def reward(self) -> float:
        return float(time.time() // 86_400)


class Wide(Counter):
    """Draws large pictures at once."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"]}

    def __init__(self, render_mode: str | None = "rgb_array") -> None:
        self.render_mode = render_mode
        self._picture = np.zeros((1500, 2000, 3), np.uint8)

    def render(self) -> np.ndarray:
        """Return a picture of 9 MB."""
        return self._picture


def ordered() -> Ordered:
    """Return one whose rewards depend on the hash seed."""
    return Ordered()


def clocked() -> Clocked:
    """Return one whose rewards depend on the clock, coarsely."""
    return Clocked()


def counter() -> Counter:
    return Counter()


class Hanging(Counter):
    """Hangs in its 25th step in a child process."""

    steps = 0

    def reward(self) -> float:
        self.steps += 1
        if self.steps == 25 and multiprocessing.parent_process():
            time.sleep(60)
        return 1.0


def hanging() -> Hanging:
    return Hanging()


class Crashing(Counter):
    """Ends a child process in its 25th step."""

    steps = 0

    def reward(self) -> float:
        self.steps += 1
        if self.steps == 25 and multiprocessing.parent_process():
            os._exit(3)
        return 1.0


def crashing() -> Crashing:
    return Crashing()


class Hungry(Counter):
    """Allocates 3 GB in a child process."""

    def reward(self) -> float:
        if multiprocessing.parent_process():
            self.food = np.ones(400_000_000)
        return 1.0


def hungry() -> Hungry:
    return Hungry()


class Reticent(Counter):
    """Uses up the memory of a child process, and reports that by an error of its own, as SDL does."""

    def reward(self) -> float:
        if multiprocessing.parent_process():
            self.food = []
            with contextlib.suppress(MemoryError):
                while True:
                    self.food.append(bytes(8 << 20))
            raise RuntimeError("Out of memory")
        return 1.0


def reticent() -> Reticent:
    return Reticent()


class Noisy(Counter):
    """Draws its rewards from the global generator."""

    def reward(self) -> float:
        return float(np.random.random())


def noisy() -> Noisy:
    return Noisy()


class Blind(Counter):
    """Needs a display to draw."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012 - as Gymnasium has it

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode

    def render(self) -> Any:
        raise RuntimeError("cannot open display :0")


def blind(render_mode: str | None = None) -> Blind:
    return Blind(render_mode)
