"""What names of runs and experiments may look like."""

from __future__ import annotations

import re
from typing import Final

from runner.errors import ConfigError

NAME_PATTERN: Final = r"^[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}$"
NAME_EXPECTED: Final = "1 to 100 letters, digits, '_', '.' or '-', not starting with '.' or '-'"
RUN_NAME_PATTERN: Final = r"^[A-Za-z0-9_][A-Za-z0-9_.+/-]{0,99}$"
"""Names of runs; a configuration's name, from which folders are named, has no `+` and no `/`."""
RUN_NAME_EXPECTED: Final = (
    "1 to 100 letters, digits, '_', '.', '-', '+' or '/', not starting with one of the last four"
)


def checked_name(name: str | None) -> str | None:
    """Return the name if a run can have it.

    Raises:
        ConfigError: it cannot.
    """
    if name is not None and not re.fullmatch(NAME_PATTERN, name):
        raise ConfigError(f"name: found {name!r}, expected {NAME_EXPECTED}")
    return name


def checked_run_name(name: str | None) -> str | None:
    """Return the name if a recorded loop, or a renamed run, can have it, such as `ALE/Pong-v5__ppo+1`.

    Raises:
        ConfigError: it cannot.
    """
    if name is not None and not re.fullmatch(RUN_NAME_PATTERN, name):
        raise ConfigError(f"name: found {name!r}, expected {RUN_NAME_EXPECTED}")
    return name
