"""What an installed package gives to add an export: its name, the ending of its files, and a function."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from runner.util import extras

if TYPE_CHECKING:
    from runner.recording.reader import Recording


@dataclass(frozen=True)
class Export:
    """A form in which runs are exported."""

    name: str
    """Name of the command, and last part of the address of the API's route."""
    ending: str
    """Ending of the file, such as `.txt`."""
    write: Callable[[Recording, Path], object]
    """Writes the export of a recording to a path."""
    help: str
    """Help of the command; its first line says what the file is."""


@cache  # reading the metadata of all packages takes 0.1 s
def installed_export(name: str) -> Export:
    """Return the export of this name that an installed package adds.

    Raises:
        RunnerError: it cannot be imported.
    """
    return extras.load_plugin(extras.EXPORTS, name, Export)
