"""Rerunning a loop, against stepping the bare environment with the same actions."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any, Final

import gymnasium

import runner
from benchmarks.figures import Figure, figure
from runner.recording.reader import open_recording
from runner.replay.environment import rerun

_ENVIRONMENTS: Final = {
    "CartPole-v1": 100_000,
    "Taxi-v4": 60_000,
    "LunarLander-v3": 20_000,
    "ALE/Pong-v5": 2_000,
}
"""Environment -> steps."""


def measure(quick: bool) -> list[Figure]:
    """Return the speed of rerunning loops, as a share of that of the bare environment."""
    repetitions = 3 if quick else 7
    return [_figure(name, steps // (4 if quick else 1), repetitions) for name, steps in _ENVIRONMENTS.items()]


def _figure(name: str, steps: int, repetitions: int) -> Figure:
    if name.startswith("ALE/"):
        import ale_py  # noqa: F401 - registers its environments

    with tempfile.TemporaryDirectory() as folder:
        path, actions = _recorded(name, steps, folder)
        pairs = [(_bare(name, actions), _rerun(path, steps)) for _ in range(repetitions)]
    ratios = [bare / again for bare, again in pairs]
    bare, again = (1e6 * min(seconds) / steps for seconds in zip(*pairs, strict=True))
    return figure(
        f"{name}: steps rerun and compared, of the bare environment's speed",
        ratios,
        "x",
        (0.5, 0.85),
        detail=f"{again:.1f} us a step, bare {bare:.1f}; both in one process, in turns",
    )


def _recorded(name: str, steps: int, folder: str) -> tuple[Path, list[Any]]:
    """Return the recording of random actions, and the actions."""
    env = gymnasium.make(name)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(steps)]
    with runner.record(env, folder) as recorded:
        _play(recorded, actions)
    return recorded.run.recording, actions


def _play(env: gymnasium.Env[Any, Any], actions: list[Any]) -> None:
    env.reset(seed=0)
    for action in actions:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()


def _bare(name: str, actions: list[Any]) -> float:
    """Return the seconds that the environment takes for the actions."""
    env = gymnasium.make(name)
    started = time.process_time()
    _play(env, actions)
    return time.process_time() - started


def _rerun(path: Path, steps: int) -> float:
    """Return the seconds that reading, rerunning and comparing takes, without making the environment."""
    with open_recording(path) as recording:
        found = rerun(recording)
        done = len(next(found))
        started = time.process_time()
        for block in found:
            assert block.difference is None
            done += len(block)
        seconds = time.process_time() - started
    assert done == steps
    return seconds
