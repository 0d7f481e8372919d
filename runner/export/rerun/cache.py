"""Exports for the Rerun viewer in the user's cache."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from runner.export.rerun.selection import Request, Selection, select
from runner.recording.reader import open_recording
from runner.runs.run import Run
from runner.util import __version__, files
from runner.util.files import CACHE_VARIABLE, EXPORTS, RUN_SEPARATOR, storage_errors

MAX_CACHED: Final = 20
"""Exports in the cache; those that were not used for longest are removed."""


def cached_export(
    runs: Sequence[Run], request: Request, stage: Callable[[str], None] = lambda _: None
) -> tuple[Path, list[Selection]]:
    """Return the export of these runs in the user's cache, made now if missing, and the selection of each.

    Rerun, which takes a second to load, is loaded only to make an export. `stage` is as for `export`.
    """
    folder = files.cache_folder() / EXPORTS
    path = folder / f"{RUN_SEPARATOR.join(run.run_id for run in runs)}-{_cache_key(runs, request)}.rrd"
    if path.exists():
        path.touch()
        selections = []
        for run in runs:
            with open_recording(run.recording) as recording:
                selections.append(select(recording, request))
        return path, selections
    from runner.export.rerun.writing import export

    with storage_errors(folder, f"set {CACHE_VARIABLE} to another folder"):
        folder.mkdir(parents=True, exist_ok=True)
        files.remove_oldest(folder, "*.rrd", keep=MAX_CACHED - 1)
    return path, export(runs, request, path, stage)


def _cache_key(runs: Sequence[Run], request: Request) -> str:
    """Return a hash of the recordings as they are now, the request, and the code."""
    parts = [__version__, repr(request)]
    for run in runs:
        stat = run.recording.stat()
        parts += [str(run.recording.absolute()), str(stat.st_size), str(stat.st_mtime_ns), repr(run.marks)]
    parts += [str(file.stat().st_mtime_ns) for file in sorted(Path(__file__).parent.glob("*.py"))]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]
