"""Classes of the script that recorded a run are taken from it, and nothing else of it is executed."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from runner.errors import CannotRedo
from runner.execution.verify import verify
from runner.replay.scripts import definition, script_of_run

TRAINING = """
import gymnasium
import numpy as np
import runner

SIZE = 4
MOVES = {0: -1, 1: 1}

def moved(place, action):
    return int(np.clip(place + MOVES[int(action)], 0, SIZE))

class Doubled(gymnasium.RewardWrapper):
    def reward(self, reward):
        return 2 * reward

class Walk(gymnasium.Env):
    def __init__(self, reward=1.0):
        self.observation_space = gymnasium.spaces.Discrete(SIZE + 1)
        self.action_space = gymnasium.spaces.Discrete(2)
        self.reward = reward

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.place = int(self.np_random.integers(SIZE))
        return self.place, {}

    def step(self, action):
        self.place = moved(self.place, action)
        return self.place, self.reward, self.place == SIZE, False, {}

with open("trained.txt", "a") as log:
    log.write("once ")
env = runner.record(Doubled(Walk(reward=0.5)), "recordings")
env.reset(seed=3)
for step in range(40):
    terminated = env.step(step % 3 > 0)[2]
    if terminated:
        env.reset()
env.close()
print(env.run.recording)
"""


def test_own_classes_of_a_script_are_made_without_training_again(tmp_path):
    script = tmp_path / "train.py"
    script.write_text(TRAINING)
    done = subprocess.run(
        [sys.executable, script.name], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=True
    )
    recording = tmp_path / done.stdout.strip()
    outcome = verify(recording)
    assert (outcome.verdict, outcome.steps, outcome.assumed) == ("reproduced", 40, ())
    assert (tmp_path / "trained.txt").read_text() == "once "
    script.write_text(TRAINING.replace("SIZE = 4", "SIZE = 5"))
    outcome = verify(recording)
    assert outcome.verdict == "consistent"
    assert "train.py, which has changed since" in outcome.reason
    script.unlink()
    assert "cannot be read" in verify(recording).reason
    (recording.parent / "trust.json").unlink()
    assert "is not known here" in verify(recording, trust=True).reason


def defined(folder: Path, text: str) -> Any:
    """Return the class `Env` of a script."""
    script = folder / "script.py"
    script.write_text(text)
    with script_of_run(str(script), hashlib.sha256(script.read_bytes()).hexdigest()):
        return definition("Env")


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("N = 3\nM = N * 2\nprint(1 / 0)\nclass Env: value = M", 6),
        ("class Base: value = 4\nclass Env(Base): pass\nEnv()", 4),
        ("try:\n    import nowhere as m\nexcept ImportError:\n    m = None\nclass Env: value = m", None),
        ("import math, sys\nT = [math.floor(2.5)]\nprint(T[0])\nsys.exit(1)\nclass Env: value = T[0]", 2),
        ("N = 3\ndef train():\n    N = 4\nclass Env: value = N\nif __name__ == '__main__':\n    train()", 3),
        ("N, M = 1, 2\nN += 1\nclass Env: value = N + M", 4),
        ("def f():\n    env = 5\n    return env\nclass Env: value = f()\nenv = 1 / 0", 5),
        ("class Env: value = __file__.endswith('script.py')", True),
    ],
)
def test_a_definition_comes_with_what_it_needs_alone(text, value, tmp_path):
    assert defined(tmp_path, text).value == value


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("T = []\nT.append(1)\nclass Env: value = T", "T, which the rest of the script may change"),
        ("T = {}\nfor i in range(3):\n    T[i] = i\nclass Env: value = T", "T, which the rest"),
        ("T = {}\nprint(T)\nclass Env: value = T", "T, which the rest"),
        ("class Env: value = 1\nEnv.value = 2", "Env, which the rest"),
        ("N = 1\nclass Env: value = N\nfor N in range(3): pass", "N, which the rest"),
        ("N = 1\ndef f():\n    global N\n    N = 2\nf()\nclass Env: value = N", "N, which the rest"),
        (
            "import argparse\nargs = argparse.ArgumentParser().parse_args()\nclass Env: value = args",
            "from argparse",
        ),
        ("import sys\nN = sys.argv[1]\nclass Env: value = N", "N, which it gets from sys"),
        (
            "import runner\nenv = runner.record(None)\nclass Env: value = env",
            "env, which it gets from runner",
        ),
        ("T = open('table.txt').read()\nclass Env: value = T", "T, which it gets from open"),
    ],
)
def test_a_definition_that_needs_the_rest_of_the_script_is_refused(text, what, tmp_path):
    with pytest.raises(CannotRedo, match=what):
        defined(tmp_path, text)
