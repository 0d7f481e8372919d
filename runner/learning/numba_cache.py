"""Numba's cache of compiled functions, made to notice a change in any file beside the function's own.

Numba looks at the file of a function alone. A function that calls, or compiles in, functions of other
files would be taken from the cache as it was before those were edited.
"""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path
from typing import Any

from numba.core import caching


def watch(module: str) -> None:
    """Have functions compiled anew when any Python file of their folder changed.

    Args:
        module: the file of the package whose functions they are; to be called before they are decorated.
    """
    folder = Path(module).resolve().parent

    class Locator:
        """Numba's own choice of a place; what it compares is the whole folder."""

        @classmethod
        def from_function(cls, function: Any, file: str) -> Any:
            """Return the locator of a function; None if it is not of this folder."""
            if Path(file).resolve().parent != folder:
                return None
            others = (other for other in caching.CacheImpl._locator_classes if other is not cls)
            found = next(filter(None, (other.from_function(function, file) for other in others)), None)
            if found is not None:
                found.get_source_stamp = lambda: stamp(folder)
            return found

    caching.CacheImpl._locator_classes.insert(0, Locator)


@cache
def stamp(folder: Path) -> str:
    """Return a hash of a folder's Python files, their names and contents."""
    files = {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in folder.glob("*.py")}
    return hashlib.sha256(repr(sorted(files.items())).encode()).hexdigest()
