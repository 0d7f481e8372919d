"""A notice before Numba compiles a kernel, which takes seconds; it does not load Numba."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Final

MESSAGE: Final = "Compiling a kernel for this algorithm and number of agents: a few seconds, the first time."
_notices: Final[list[Callable[[], None]]] = []
"""The functions to call when a compilation begins."""


@contextlib.contextmanager
def announced(notify: Callable[[], None]) -> Iterator[None]:
    """Call `notify` once, just before Numba begins to compile anything within the context."""
    _notices.append(notify)
    try:
        yield
    finally:
        if notify in _notices:
            _notices.remove(notify)


def announce() -> None:
    """Call each function that waits for a compilation to begin."""
    while _notices:
        _notices.pop()()
