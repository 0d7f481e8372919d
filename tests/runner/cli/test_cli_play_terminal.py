"""`dualtaxi play` in terminals: with graphics of each kind, without, and without colours."""

from __future__ import annotations

import contextlib
import os
import select
import struct
import subprocess
import sys

import gymnasium
import pytest

import runner
from tests.runner.loops.making import play

if sys.platform == "win32":
    pytest.skip("needs a pseudoterminal", allow_module_level=True)
import fcntl
import pty
import termios

ANSWERS = {
    "sixel": {b"\x1b[c": b"\x1b[?62;4;22c"},
    "kitty": {b"\x1b[c": b"\x1b[?62;22c", b"a=q": b"\x1b_Gi=1;OK\x1b\\"},
    "none": {},
}
"""How a terminal of each kind answers a query."""
GRAPHICS = {"sixel": b"\x1bP", "kitty": b"a=p", "none": "▀".encode()}
"""What it is sent to show a picture."""


def played(kind: str, *words: object, **variables: str) -> bytes:
    """Return what a terminal gets from `dualtaxi play`, which is quit after the second step."""
    terminal, inside = pty.openpty()
    fcntl.ioctl(inside, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 120, 1200, 800))
    command = [sys.executable, "-m", "runner", "play", *map(str, words)]
    environment = os.environ | {"TERM": "xterm-256color", "COLORTERM": "truecolor"} | variables
    process = subprocess.Popen(command, stdin=inside, stdout=inside, stderr=inside, env=environment)
    os.close(inside)
    answers, seen = dict(ANSWERS[kind]), b""
    with contextlib.suppress(OSError):  # the process has ended
        while select.select([terminal], [], [], 120)[0]:
            seen += os.read(terminal, 1 << 16)
            for query in [query for query in answers if query in seen]:
                os.write(terminal, answers.pop(query))
            if b"step 2 of" in seen:
                os.write(terminal, b"q")
    os.close(terminal)
    assert process.wait(60) == 0
    assert b"Traceback" not in seen
    return seen


@pytest.fixture(scope="module")
def pole(tmp_path_factory):
    """Return the recording of a loop over CartPole without frames."""
    with runner.record(gymnasium.make("CartPole-v1"), tmp_path_factory.mktemp("terminal")) as rec:
        list(play(rec, 40))
    return rec.run.recording


@pytest.mark.parametrize("kind", ANSWERS)
def test_pictures_are_shown_by_what_the_terminal_has(pole, kind):
    seen = played(kind, pole, "--episode", 0)
    assert seen.count(GRAPHICS[kind]) >= 2
    assert not any(graphics in seen for other, graphics in GRAPHICS.items() if other != kind)


def test_scenes_are_text_without_graphics_and_pictures_with_them(lake):
    assert GRAPHICS["none"] not in played("none", lake.recording)
    assert played("sixel", lake.recording).count(GRAPHICS["sixel"]) >= 2


def test_pictures_are_turned_off(pole):
    for words, variables in ((["--no-pictures"], {}), ([], {"NO_COLOR": "1"}), ([], {"TERM": "dumb"})):
        seen = played("sixel", pole, "--episode", 0, *words, **variables)
        assert not any(graphics in seen for graphics in GRAPHICS.values())
        assert b"reward 1, so far" in seen
