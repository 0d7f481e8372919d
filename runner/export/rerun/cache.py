"""Exports that `view` made, kept in the user's cache so that a second look is there at once."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from runner.drawing import palette
from runner.export.rerun.selection import Request, Selection, select
from runner.export.rerun.writing import Source, export
from runner.recording.reader import open_recording
from runner.runs.run import Run
from runner.util.files import CACHE_VARIABLE, EXPORTS, RUN_SEPARATOR, storage_errors
from runner.util.files import cache_folder as users_cache
from runner.util.version import __version__

KEPT: Final = 20
"""Exports in the cache; the ones that were not looked at for longest are removed."""


def exported(runs: Sequence[Run], request: Request) -> tuple[Path, list[Selection]]:
    """Return an export of these runs, made now unless it is in the cache, and what was chosen of each.

    Raises:
        RecordingError: a recording cannot be read, or has not what is asked for.
        StorageError: the cache cannot be written.
    """
    path = cache_folder() / f"{RUN_SEPARATOR.join(run.run_id for run in runs)}-{_key(runs, request)}.rrd"
    recordings = [open_recording(run.recording) for run in runs]
    try:
        if path.exists():
            path.touch()
            return path, [select(recording, request) for recording in recordings]
        several = len(runs) > 1
        titles = _titles(runs)
        sources = [
            Source(
                recording,
                title,
                f"/{run.run_id}" if several else "",
                palette.COMPARED[i % len(palette.COMPARED)] if several else None,
            )
            for i, (run, recording, title) in enumerate(zip(runs, recordings, titles, strict=True))
        ]
        _make_room()
        return path, export(sources, request, path)
    finally:
        for recording in recordings:
            recording.close()


def cache_folder() -> Path:
    """Return the folder of kept exports."""
    return users_cache() / EXPORTS


def _titles(runs: Sequence[Run]) -> list[str]:
    return [f"{run.title} ({run.run_id})" for run in runs]


def _key(runs: Sequence[Run], request: Request) -> str:
    """Return what tells this export from others: the recordings as they are now, and the request."""
    parts = [__version__, repr(request)]
    for run in runs:
        facts = run.recording.stat()
        parts += [str(run.recording.absolute()), str(facts.st_size), str(facts.st_mtime_ns)]
    code = Path(__file__).parent
    parts += [str(file.stat().st_mtime_ns) for file in sorted(code.glob("*.py"))]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def _make_room() -> None:
    folder = cache_folder()
    with storage_errors(folder, f"set {CACHE_VARIABLE} to another folder"):
        folder.mkdir(parents=True, exist_ok=True)
        kept = sorted(folder.glob("*.rrd"), key=lambda path: path.stat().st_mtime, reverse=True)
        for old in kept[KEPT - 1 :]:
            old.unlink(missing_ok=True)
