"""What installed packages add: views and exports, by entry points of the groups `VIEWS` and `EXPORTS`.

A package names them in its `pyproject.toml`:

    [project.entry-points."dualtaxi.views"]
    streaks = "my_package:STREAKS"
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, TypeVar

from runner.errors import RunnerError
from runner.util.files import cache_folder, read_object, write_object

VIEWS: Final = "dualtaxi.views"
EXPORTS: Final = "dualtaxi.exports"
_CACHE_FILE: Final = "plugins.json"
_MAX_CACHE_BYTES: Final = 1 << 20
T = TypeVar("T")


def plugin_names(group: str) -> Mapping[str, str]:
    """Return the names in a group of entry points, and the package of each.

    Nothing is imported. Reading the metadata of all packages takes 0.1 s, so the names are cached until a
    folder of packages changes.
    """
    folders = {path: Path(path).stat().st_mtime_ns for path in sys.path if Path(path).is_dir()}
    file = cache_folder() / _CACHE_FILE
    cached: dict[str, Any] = {}
    with contextlib.suppress(OSError, ValueError):
        cached = read_object(file, _MAX_CACHE_BYTES)
    if cached.get("folders") != folders or not isinstance(cached.get(group), dict):
        from importlib.metadata import entry_points

        cached = {"folders": folders}
        for key in (VIEWS, EXPORTS):
            cached[key] = {point.name: point.dist.name for point in entry_points(group=key) if point.dist}
        with contextlib.suppress(OSError):
            file.parent.mkdir(parents=True, exist_ok=True)
            write_object(file, cached)
    names: dict[str, str] = cached[group]
    return names


def load_plugin(group: str, name: str, kind: type[T]) -> T:
    """Import what an entry point names.

    Raises:
        RunnerError: it cannot be imported, or is no `kind` of this name.
    """
    from importlib.metadata import entry_points

    (point, *_) = entry_points(group=group, name=name)
    package = point.dist.name if point.dist else point.value
    try:
        loaded = point.load()
    except Exception as error:
        raise RunnerError(
            f"{name}: {point.value} of the package {package} cannot be imported: "
            f"{type(error).__name__}: {error}. Update or uninstall that package."
        ) from error
    if not isinstance(loaded, kind) or getattr(loaded, "name", name) != name:
        raise RunnerError(
            f"{name}: found {loaded!r} at {point.value} of the package {package}, "
            f"expected a {kind.__name__} of this name."
        )
    return loaded
