"""Long loops by their actions alone, in bytes a step, and opening a recording of steps with 300 columns."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

import runner
from benchmarks.figures import Figure, figure

COLUMNS = 300
_OPEN = """
import sys, time
from runner.recording.reader import open_recording
begun = time.process_time()
with open_recording(sys.argv[1]) as recording:
    recording.train.steps.count()
    next(recording.train.steps.rows())
print(1000 * (time.process_time() - begun))
"""


class Wide(gymnasium.Env[dict[str, Any], int]):
    """Observes a Dict of many numbers."""

    observation_space = spaces.Dict({f"k{k}": spaces.Box(-1, 1, (), np.float32) for k in range(COLUMNS)})
    action_space = spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:  # noqa: ARG002
        """Return a sample."""
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action: int) -> Any:  # noqa: ARG002
        """Return a sample."""
        return self.observation_space.sample(), 0.0, False, False, {}


def measure(quick: bool) -> list[Figure]:
    """Return bytes a step of CartPole, its pole kept up, and the processor time to open and read a block."""
    steps = 100_000
    with tempfile.TemporaryDirectory() as folder:
        size = balanced(folder, steps) / steps
        with runner.record(Wide(), folder) as rec:
            rec.reset(seed=1)
            for _ in range(500):
                rec.step(0)
        command = [sys.executable, "-c", _OPEN, str(rec.run.recording)]
        milliseconds = [float(subprocess.check_output(command, text=True)) for _ in range(2 if quick else 5)]
    return [
        figure("CartPole, actions alone", [size], "bytes/step", (0.7, 0.5), higher_is_better=False),
        figure("open, 300 columns", milliseconds, "ms", (50, 20), higher_is_better=False),
    ]


def balanced(folder: str, steps: int) -> int:
    """Return the bytes of a loop over CartPole by a policy that keeps the pole up."""
    with runner.record(gymnasium.make("CartPole-v1"), folder, steps="actions") as rec:
        observation, _ = rec.reset(seed=1)
        for _ in range(steps):
            weights = (0.02, 0.05, 1.0, 0.5)
            observation, _, terminated, truncated, _ = rec.step(int(np.dot(weights, observation) > 0))
            if terminated or truncated:
                observation, _ = rec.reset()
    return Path(rec.run.recording).stat().st_size
