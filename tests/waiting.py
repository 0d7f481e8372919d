"""How tests wait for what another process or thread does."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, TypeVar

Found = TypeVar("Found")


def until(is_so: Callable[[Found], Any], ask: Callable[[], Found], seconds: float = 60) -> Found:
    """Ask until the answer is so, and return it; fail with the last one when that takes too long.

    The longer it takes, the more rarely it asks: a question may cost a server more than its work.
    """
    begun = time.monotonic()
    while not is_so(found := ask()):
        waited = time.monotonic() - begun
        assert waited < seconds, found
        time.sleep(0.05 + waited / 20)
    return found
