"""`dualtaxi play` in terminals."""

from __future__ import annotations

import contextlib
import os
import select
import struct
import subprocess
import sys

import gymnasium
import numpy as np
import pytest

import runner
from tests.runner.loops.making import play

if sys.platform == "win32":
    pytest.skip("needs a pseudoterminal", allow_module_level=True)
import fcntl
import pty
import termios


def played(lines: int, columns: int, *words: object) -> str:
    """Return what a terminal gets from `dualtaxi play`, which is quit after the second step."""
    terminal, inside = pty.openpty()
    fcntl.ioctl(inside, termios.TIOCSWINSZ, struct.pack("HHHH", lines, columns, 0, 0))
    command = [sys.executable, "-m", "runner", "play", *map(str, words)]
    environment = os.environ | {"TERM": "xterm-256color", "COLORTERM": "truecolor"}
    process = subprocess.Popen(command, stdin=inside, stdout=inside, stderr=inside, env=environment)
    os.close(inside)
    seen = b""
    with contextlib.suppress(OSError):  # the process has ended
        while select.select([terminal], [], [], 120)[0]:
            seen += os.read(terminal, 1 << 16)
            if b"step 2 of" in seen:
                os.write(terminal, b"q")
    os.close(terminal)
    assert process.wait(60) == 0
    assert b"Traceback" not in seen
    return seen.decode()


@pytest.fixture(scope="module")
def pole(tmp_path_factory):
    """Return the recording of a loop over CartPole without frames."""
    with runner.record(gymnasium.make("CartPole-v1"), tmp_path_factory.mktemp("terminal")) as rec:
        list(play(rec, 40))
    return rec.run.recording


@pytest.mark.parametrize("size", [(40, 120), (0, 0)])
def test_frames_are_text_in_terminals_of_any_size(pole, lake, size):
    seen = played(*size, pole, "--episode", 0)
    assert "reward 1, so far" in seen
    assert "export film" not in seen
    assert "space: pause" in played(*size, lake.recording)


def test_of_observations_that_are_pictures_the_film_is_named(tmp_path):
    class Camera(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(0, 255, (32, 32, 3), np.uint8)
        action_space = gymnasium.spaces.Discrete(2)

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return np.zeros((32, 32, 3), np.uint8), {}

        def step(self, action):
            return np.full((32, 32, 3), 7, np.uint8), 1.0, False, False, {}

    with runner.record(Camera(), tmp_path, name="camera") as rec:
        list(play(rec, 5))
    seen = played(40, 120, rec.run.recording)
    assert "dualtaxi export film" in seen
    assert "uint8 [32, 32, 3]" in seen
