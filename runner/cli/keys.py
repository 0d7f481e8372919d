"""Single keys from the terminal, without waiting for Enter."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterator
from typing import Final

ReadKey = Callable[[float | None], str]
"""Waits so many seconds for a key, or without end; returns its name, empty if none was pressed."""

_NAMES: Final = {
    b" ": "pause",
    b"q": "quit",
    b"Q": "quit",
    b"\x1b": "quit",
    b"b": "back",
    b"\x1b[D": "back",
    b"\xe0K": "back",
    b"n": "forward",
    b"\x1b[C": "forward",
    b"\xe0M": "forward",
}
"""What terminals send (arrows as escape sequences, on Windows after 0xE0), and what it means."""
_POLL_SECONDS: Final = 0.02


@contextlib.contextmanager
def pressed_keys() -> Iterator[ReadKey | None]:
    """Give what reads keys; None where stdin is no terminal."""
    if not sys.stdin.isatty():
        yield None
    elif sys.platform == "win32":
        yield _windows_key
    else:
        import termios
        import tty

        descriptor = sys.stdin.fileno()
        before = termios.tcgetattr(descriptor)
        try:
            tty.setcbreak(descriptor)  # keys one by one and without echo; Ctrl-C still interrupts
            yield _posix_key
        finally:
            termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


def _posix_key(seconds: float | None) -> str:
    import select

    descriptor = sys.stdin.fileno()
    ready, _, _ = select.select([descriptor], [], [], seconds)
    if not ready:
        return ""
    key = os.read(descriptor, 1)
    if key == b"\x1b" and select.select([descriptor], [], [], 0)[0]:  # an arrow key sends three bytes
        key += os.read(descriptor, 2)
    return _NAMES.get(key, "")


def _windows_key(seconds: float | None) -> str:
    import msvcrt

    end = None if seconds is None else time.monotonic() + seconds
    while not msvcrt.kbhit():  # type: ignore[attr-defined,unused-ignore]
        if end is not None and time.monotonic() >= end:
            return ""
        time.sleep(_POLL_SECONDS)
    key = msvcrt.getch()  # type: ignore[attr-defined,unused-ignore]
    key += msvcrt.getch() if key == b"\xe0" else b""  # type: ignore[attr-defined,unused-ignore]
    return _NAMES.get(key, "")
