"""Exporting runs to one `.rrd` file, or into the user's cache."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import itertools
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import rerun as rr

from runner.drawing import palette
from runner.errors import RecordingError
from runner.export.rerun.columns import new_stream
from runner.export.rerun.layout import blueprint, loop_blueprint
from runner.export.rerun.loops import LoopExporter
from runner.export.rerun.runs import RunExporter, Source
from runner.export.rerun.selection import Request, Selection, select
from runner.recording.reader import open_recording
from runner.runs.run import Run
from runner.util import files
from runner.util.files import CACHE_VARIABLE, EXPORTS, RUN_SEPARATOR, storage_errors
from runner.util.version import __version__

MAX_CACHED: Final = 20
"""Exports in the cache; those that were not used for longest are removed."""


def export(sources: Sequence[Source], request: Request, path: Path) -> list[Selection]:
    """Write runs to an `.rrd` file; return the selection of each.

    Raises:
        RecordingError: a recording cannot be read, or does not have what is requested.
        StorageError: the file cannot be written.
    """
    selections = [select(source.recording, request) for source in sources]
    are_jobs = [source.recording.is_job for source in sources]
    if len(set(are_jobs)) > 1:
        where = sources[are_jobs.index(True)].recording.path
        raise RecordingError(
            f"{where}: was trained here, the other was recorded from a loop; view them separately."
        )
    stream = new_stream("-".join(source.recording.run_id for source in sources))
    with _saved(stream, path):
        stream.send_recording_name(" and ".join(source.title for source in sources))
        if are_jobs[0]:
            runs = [RunExporter(stream, *pair) for pair in zip(sources, selections, strict=True)]
            entities = {entity for run in runs for entity in run.send_metrics()}
            stream.send_blueprint(blueprint([run.view for run in runs], entities), make_active=False)
            for run in runs:
                run.send_steps()
        else:
            loops = [
                LoopExporter(stream, source.recording, selection, source.root)
                for source, selection in zip(sources, selections, strict=True)
            ]
            for loop in loops:
                loop.export()
            views = [loop.blueprint(source.title) for loop, source in zip(loops, sources, strict=True)]
            stream.send_blueprint(loop_blueprint(views))
    return selections


def cached_export(runs: Sequence[Run], request: Request) -> tuple[Path, list[Selection]]:
    """Return the export of these runs in the user's cache, made now if missing, and the selection of each.

    Raises:
        RecordingError: a recording cannot be read, or does not have what is requested.
        StorageError: the cache cannot be written.
    """
    folder = files.cache_folder() / EXPORTS
    path = folder / f"{RUN_SEPARATOR.join(run.run_id for run in runs)}-{_cache_key(runs, request)}.rrd"
    with contextlib.ExitStack() as stack:
        recordings = [stack.enter_context(open_recording(run.recording)) for run in runs]
        if path.exists():
            path.touch()
            return path, [select(recording, request) for recording in recordings]
        sources = [
            Source(recording, f"{run.title} ({run.run_id})")
            for run, recording in zip(runs, recordings, strict=True)
        ]
        if len(runs) > 1:
            colours = itertools.cycle(palette.COMPARED)
            sources = [
                dataclasses.replace(source, root=f"/{run.run_id}", tint=next(colours))
                for source, run in zip(sources, runs, strict=True)
            ]
        with storage_errors(folder, f"set {CACHE_VARIABLE} to another folder"):
            folder.mkdir(parents=True, exist_ok=True)
            cached = sorted(folder.glob("*.rrd"), key=lambda file: file.stat().st_mtime, reverse=True)
            for old in cached[MAX_CACHED - 1 :]:
                old.unlink(missing_ok=True)
        return path, export(sources, request, path)


def _cache_key(runs: Sequence[Run], request: Request) -> str:
    """Return a hash of the recordings as they are now, the request, and the code."""
    parts = [__version__, repr(request)]
    for run in runs:
        stat = run.recording.stat()
        parts += [str(run.recording.absolute()), str(stat.st_size), str(stat.st_mtime_ns)]
    parts += [str(file.stat().st_mtime_ns) for file in sorted(Path(__file__).parent.glob("*.py"))]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


@contextlib.contextmanager
def _saved(stream: rr.RecordingStream, path: Path) -> Iterator[None]:
    """Save everything sent to a stream as a file, which replaces another only when it is complete."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with storage_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary.touch()  # where no file can be created, Rerun would not raise an OSError
            stream.save(temporary)
            yield
            stream.flush()
            stream.disconnect()
            temporary.replace(path)
    finally:
        if os.path.lexists(temporary):
            temporary.unlink()
