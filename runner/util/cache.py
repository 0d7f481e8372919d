"""The user's cache: what can be made again at any time, and is kept to be there at once."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

CACHE_VARIABLE: Final = "XDG_CACHE_HOME"
EXPORTS: Final = "rerun"
"""The folder in it of exports for the Rerun viewer; their names begin with the ids of their runs."""
RUN_SEPARATOR: Final = "+"
"""What stands between the ids of several runs in the name of an export: no id has it."""
RESTORED: Final = "restored"
"""The folder in it of recordings restored from archives; their names begin with the ids of their runs."""
TABLES: Final = "tables"
"""The folder in it of Q-tables along long runs; their names begin with the ids of their runs."""


def cache_folder() -> Path:
    """Return the project's folder in the user's cache; it need not exist."""
    base = os.environ.get(CACHE_VARIABLE)
    return (Path(base) if base else Path.home() / ".cache") / "dualtaxi"
