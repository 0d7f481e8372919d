"""When a kernel is compiled: seconds the first time, nothing once Numba has it in its cache."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from numba.core import event

MESSAGE: Final = "Compiling a kernel for this algorithm and number of agents: a few seconds, the first time."


class _Once(event.Listener):  # type: ignore[misc]  # Numba has no types
    """Calls a function at the first compilation."""

    def __init__(self, tell: Callable[[], None]) -> None:
        self._tell: Callable[[], None] | None = tell

    def on_start(self, _event: Any) -> None:
        """Tell, and forget to."""
        if self._tell is not None:
            tell, self._tell = self._tell, None
            tell()

    def on_end(self, _event: Any) -> None:
        """Do nothing: the beginning is what counts."""


def announced(tell: Callable[[], None]) -> Any:
    """Return a context in which `tell` is called once, just before Numba begins to compile anything.

    Numba says so itself, after it has looked for the very signature in its cache and not found it, so
    that what is announced does happen.
    """
    return event.install_listener("numba:compile", _Once(tell))
