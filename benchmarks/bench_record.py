"""The cost of recording a user's loop: against the loop alone, and against Minari's DataCollector.

The sides alternate in one run, with the same environment, seed and actions. Times are processor times of the
whole process, from the first step to the end of the file; `added` is that of the calling thread.
Minari's figures need `pip install "minari[create]"`.
"""

from __future__ import annotations

import contextlib
import os
import statistics
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces, wrappers

import runner
from benchmarks.figures import Figure, figure, processor_seconds
from benchmarks.processes import run

Env = gymnasium.Env[Any, Any]
Targets = tuple[float, float]
TARGETS: dict[str, tuple[Targets, Targets]] = {
    "Taxi-v4": ((2, 1.3), (36, 30)),
    "CartPole-v1": ((4, 3), (60, 45)),
    "a Dict of three parts": ((4, 2.6), (60, 45)),
}
"""Targets (at least, aim) in microseconds and in bytes per step."""

MEMORY = """
import sys, runner
from gymnasium import Env, spaces

class Quick(Env):
    observation_space, action_space, t = spaces.Discrete(500), spaces.Discrete(6), 0
    def reset(self, *, seed=None, options=None):
        self.t = 0
        return 0, {}
    def step(self, action):
        self.t += 1
        return self.t * 7 % 500, -1, False, self.t == 200, {}

with runner.record(Quick(), sys.argv[1]) as env:
    env.reset()
    for k in range(int(sys.argv[2])):
        if env.step(k % 6)[3]:
            env.reset()
"""
"""A loop whose environment takes no time."""


def measure(quick: bool) -> list[Figure]:
    """Return overhead and bytes per step, the ratios to Minari, and the memory of a long loop."""
    steps, repetitions = (20_000, 3) if quick else (100_000, 5)
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        os.environ["MINARI_DATASETS_PATH"] = str(Path(folder, "minari"))
        figures = []
        for name, make in (
            ("Taxi-v4", partial(gymnasium.make, "Taxi-v4")),
            ("CartPole-v1", partial(gymnasium.make, "CartPole-v1")),
            ("a Dict of three parts", Driving),
        ):
            figures += _environment(name, make, Path(folder), steps, repetitions)
        figures += _actions_alone(Path(folder), steps)
        figures += _minigrid(Path(folder), steps // 10, repetitions)
        for name, kind, count in (("Blackjack-v1", "short", steps // 20), ("Taxi-v4", "long", steps // 2)):
            figures += _against_minari(name, kind, Path(folder), count, repetitions)
        figures += _pong(Path(folder), steps // 10, repetitions)
        figures += _extras(Path(folder), steps, repetitions)
        figures += _short(Path(folder), 100 if quick else 1_000, repetitions)
        figures += _logging(Path(folder), steps, repetitions)
        figures += _infos(Path(folder), steps // 20, repetitions)
        figures += _memory(Path(folder), 10_000_000 if not quick else 1_000_000)
    return figures


def drive(env: Env, steps: int) -> None:
    """Play at random."""
    env.action_space.seed(1)
    env.reset(seed=1)
    sample, step = env.action_space.sample, env.step
    for _ in range(steps):
        _, _, terminated, truncated, _ = step(sample())
        if terminated or truncated:
            env.reset()


@dataclass(frozen=True)
class _Overhead:
    """What recording adds to a step of an environment that is played at random."""

    added: list[float]
    """Processor time of the loop's thread in microseconds, a value for each repetition."""
    whole: float
    """That of all threads, the median."""
    alone: float
    """Processor time of a step that is not recorded, in microseconds."""
    size: float
    """Bytes a step on disk."""


def _overhead(make: Callable[[], Env], folder: Path, steps: int, repetitions: int) -> _Overhead:
    added, whole, size = [], [], 0.0
    for _ in range(repetitions):
        with contextlib.closing(make()) as env:
            alone = processor_seconds(partial(drive, env, steps))
        with runner.record(make(), folder / "recordings") as env:
            recorded = processor_seconds(partial(drive, env, steps))
        size = env.run.summary["bytes"] / steps
        added.append((recorded[0] - alone[0]) / steps * 1e6)
        whole.append((recorded[1] - alone[1]) / steps * 1e6)
    return _Overhead(added, statistics.median(whole), alone[0] / steps * 1e6, size)


class Driving(gymnasium.Env[Any, Any]):
    """An environment whose observations and actions have parts, and that takes no time."""

    observation_space = spaces.Dict(
        camera=spaces.Box(0, 255, (8, 8), np.uint8),
        speed=spaces.Box(-1, 1, (), np.float32),
        gear=spaces.Discrete(5),
    )
    action_space = spaces.Dict(steer=spaces.Box(-1, 1, (2,), np.float32), brake=spaces.Discrete(2))

    def __init__(self) -> None:
        self.observation_space.seed(0)
        self._observation, self._t = self.observation_space.sample(), 0

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:  # noqa: ARG002
        """Return the observation, the same each time."""
        return self._observation, {}

    def step(self, action: Any) -> Any:  # noqa: ARG002
        """Return the observation; every 50th step ends an episode."""
        self._t += 1
        return self._observation, 1.0, self._t % 50 == 0, False, {}


def _environment(
    name: str, make: Callable[[], Env], folder: Path, steps: int, repetitions: int
) -> list[Figure]:
    """Return the overhead per step of recording an environment, and its size on disk."""
    of = _overhead(make, folder, steps, repetitions)
    time_targets, size_targets = TARGETS[name]
    detail = f"processor time of the loop's thread; all threads {of.whole:.2f} us"
    added = figure(
        f"added per step, {name}", of.added, "us", time_targets, higher_is_better=False, detail=detail
    )
    return [
        added,
        figure(f"  on disk, {name}", [of.size], "bytes/step", size_targets, higher_is_better=False),
    ]


def _actions_alone(folder: Path, steps: int) -> list[Figure]:
    """Return the size of CartPole's steps recorded by their actions alone."""
    with runner.record(gymnasium.make("CartPole-v1"), folder / "recordings", steps="actions") as env:
        drive(env, steps)
    size = env.run.summary["bytes"] / steps
    return [figure("actions alone, CartPole-v1", [size], "bytes/step", (1, 0.7), higher_is_better=False)]


def _minigrid(folder: Path, steps: int, repetitions: int) -> list[Figure]:
    """Return the overhead per step of MiniGrid, whose observations have a text."""
    try:
        import minigrid
    except ImportError:
        print("    MiniGrid is left out: minigrid is not installed")
        return []
    minigrid.register_minigrid_envs()
    of = _overhead(
        partial(gymnasium.make, "MiniGrid-DoorKey-5x5-v0", max_episode_steps=100), folder, steps, repetitions
    )
    return [
        figure("added per step, MiniGrid", of.added, "us", higher_is_better=False),
        figure("  on disk, MiniGrid", [of.size], "bytes/step", higher_is_better=False),
    ]


def _pong(folder: Path, steps: int, repetitions: int) -> list[Figure]:
    """Return the overhead and the size of Pong's steps, with the usual stack of four frames."""
    try:
        import ale_py
    except ImportError:
        print("    Atari's Pong is left out: ale-py is not installed")
        return []
    gymnasium.register_envs(ale_py)

    def make() -> Env:
        frames = wrappers.AtariPreprocessing(gymnasium.make("ALE/Pong-v5", frameskip=1))
        return wrappers.FrameStackObservation(frames, 4)

    of = _overhead(make, folder, steps, repetitions)
    detail = f"processor time of the loop's thread; all threads {of.whole:.0f} us; a step "
    detail += f"of the environment takes {of.alone:.0f} us"
    return [
        figure("added per step, Pong", of.added, "us", (60, 25), higher_is_better=False, detail=detail),
        figure("  on disk, Pong", [of.size], "bytes/step", (110, 60), higher_is_better=False),
    ]


def _against_minari(name: str, kind: str, folder: Path, steps: int, repetitions: int) -> list[Figure]:
    """Return by which factor recording is cheaper than Minari's collector, including the end of the file."""
    try:
        import jax.tree_util  # noqa: F401 - the collector imports it with its first step
        import minari
    except ImportError:
        return []
    ratios, ours, theirs = [], [], []
    for _ in range(repetitions):
        alone = _whole(lambda: contextlib.nullcontext(gymnasium.make(name)), steps)
        with_ours = _whole(lambda: runner.record(gymnasium.make(name), folder / "recordings"), steps)
        with_theirs = _whole(lambda: _collector(minari, name), steps)
        ours.append((with_ours - alone) / steps * 1e6)
        theirs.append((with_theirs - alone) / steps * 1e6)
        ratios.append(theirs[-1] / ours[-1])
    return [
        figure(
            f"cheaper than Minari's collector, {kind} episodes",
            ratios,
            "x",
            (8, 20),
            detail=f"{name}: {statistics.median(ours):.2f} us added per step, all threads and closing; "
            f"Minari {statistics.median(theirs):.1f} us",
        )
    ]


@contextlib.contextmanager
def _collector(minari: Any, name: str) -> Iterator[Env]:
    env = minari.DataCollector(gymnasium.make(name), record_infos=False)
    yield env
    env._flush_to_storage()
    env.close()


def _whole(make: Callable[[], Any], steps: int) -> float:
    """Return the processor time of a loop, from the first step to the end of the file."""
    with contextlib.ExitStack() as stack:
        env = stack.enter_context(make())
        begin = time.process_time()
        drive(env, steps)
        stack.close()
    return time.process_time() - begin


class Observed(gymnasium.Env[Any, Any]):
    """An environment that takes no time, with observations of 4 float32 under each of these names."""

    action_space = spaces.Discrete(2)

    def __init__(self, numbers: Any, names: str) -> None:
        self.observation_space = spaces.Dict({name: spaces.Box(-9, 9, (4,), np.float32) for name in names})
        self._observations = [dict.fromkeys(names, row) for row in numbers]
        for k, name in enumerate(names):  # other numbers under each name
            for row, observation in zip(
                np.roll(numbers, k * len(numbers) // 2, axis=0), self._observations, strict=True
            ):
                observation[name] = row
        self._t = 0

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:  # noqa: ARG002
        """Return the first observation."""
        return self._observations[0], {}

    def step(self, action: Any) -> Any:  # noqa: ARG002
        """Return the next observation; every 200th step ends an episode."""
        self._t += 1
        return self._observations[self._t], 1.0, self._t % 200 == 0, False, {}


def _extras(folder: Path, steps: int, repetitions: int) -> list[Figure]:
    """Return what extras of 4 float32 add to a step, next to an observation of the same size."""
    numbers = np.random.default_rng(0).normal(size=(steps + 1, 4)).astype(np.float32)
    rows = list(numbers)

    def play(env: Any, with_extras: bool) -> None:
        env.reset()
        for k in range(steps):
            result = env.step(0, {"logits": rows[k]}) if with_extras else env.step(0)
            if result[2]:
                env.reset()

    added: dict[str, list[float]] = {"none": [], "extras": [], "second": []}
    sizes = dict.fromkeys(added, 0.0)
    for _ in range(repetitions):
        for kind, own in added.items():
            names = "ab" if kind == "second" else "a"
            alone = processor_seconds(partial(play, Observed(numbers, names), False))
            with runner.record(Observed(numbers, names), folder / "recordings") as env:
                recorded = processor_seconds(partial(play, env, kind == "extras"))
            own.append((recorded[0] - alone[0]) / steps * 1e6)
            sizes[kind] = env.run.summary["bytes"] / steps
    by_extras, by_observation = (
        [more - less for more, less in zip(added[kind], added["none"], strict=True)]
        for kind in ("extras", "second")
    )
    step = statistics.median(added["none"])
    return [
        figure(
            "extras of 4 float32, added per step",
            by_extras,
            "us",
            (step, statistics.median(by_observation)),
            higher_is_better=False,
            detail=f"targets: a step with an observation of 4 float32, {step:.2f} us, and a second such part "
            f"of a Dict observation, {statistics.median(by_observation):.2f} us, in the same run",
        ),
        figure(
            "  on disk, extras of 4 float32",
            [sizes["extras"] - sizes["none"]],
            "bytes/step",
            (sizes["none"], sizes["second"] - sizes["none"]),
            higher_is_better=False,
            detail="targets: the same steps, and a second such part of a Dict observation",
        ),
    ]


def _short(folder: Path, loops: int, repetitions: int) -> list[Figure]:
    """Return the cost of starting and ending a recorded loop that logs one value."""
    spent, lasted = [], []
    for _ in range(repetitions):
        begin, began = time.process_time(), time.perf_counter()
        for _ in range(loops):
            with runner.record(gymnasium.make("CartPole-v1"), folder / "recordings") as env:
                env.log("value", 1.0)
        whole = time.process_time() - begin
        lasted.append((time.perf_counter() - began) * 1_000 / loops)
        begin = time.process_time()
        for _ in range(loops):
            gymnasium.make("CartPole-v1").close()
        spent.append((whole - (time.process_time() - begin)) / loops * 1e3)
    return [
        figure("start and end of a loop", spent, "ms", (4, 2), higher_is_better=False),
        figure(
            "1,000 loops",
            lasted,
            "s",
            (10, 4),
            higher_is_better=False,
            detail="elapsed time of loops that log one value, each with one fsync",
        ),
    ]


def _logging(folder: Path, steps: int, repetitions: int) -> list[Figure]:
    """Return what logging a number costs."""
    spent = []
    for _ in range(repetitions):
        with runner.record(gymnasium.make("CartPole-v1"), folder / "recordings") as env:
            begin = time.process_time()
            for k in range(steps):
                env.log("value", k + 0.5)
            spent.append((time.process_time() - begin) / steps * 1e6)
    return [figure("log of a number", spent, "us", (4, 2), higher_is_better=False)]


class Pictured(Observed):
    """An environment whose infos have a picture."""

    picture = np.random.default_rng(0).integers(0, 256, (84, 84, 4), dtype=np.uint8)

    def step(self, action: Any) -> Any:
        """Return the same step each time, with the picture."""
        return *super().step(action)[:4], {"picture": self.picture}


def _infos(folder: Path, steps: int, repetitions: int) -> list[Figure]:
    """Return what recording a picture in the info adds to a step."""
    added = []
    for _ in range(repetitions):
        spent = []
        for info in ((), ("*",)):
            with runner.record(
                Pictured(np.zeros((steps + 1, 4), np.float32), "a"), folder / "recordings", info=info
            ) as env:
                env.reset()
                begin = time.thread_time()
                for _ in range(steps):
                    env.step(0)
                spent.append(time.thread_time() - begin)
        added.append((spent[1] - spent[0]) / steps * 1e6)
    return [figure("info with a picture, 84x84x4", added, "us", (60, 30), higher_is_better=False)]


def _memory(folder: Path, steps: int) -> list[Figure]:
    early, late = (
        run([sys.executable, "-c", MEMORY, str(folder / "recordings"), str(count)])
        for count in (steps // 10, steps)
    )
    return [
        figure(
            f"peak memory, a loop of {steps / 1e6:g} M steps",
            [late.peak_megabytes],
            "MB",
            (250, 250),
            higher_is_better=False,
            detail=f"{early.peak_megabytes:.0f} MB for a tenth of them; "
            f"{late.cpu_seconds / steps * 1e6:.2f} us of processor time a step, all of it",
        )
    ]
