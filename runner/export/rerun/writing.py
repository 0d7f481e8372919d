"""Exporting runs to one `.rrd` file."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import rerun as rr

from runner.drawing import palette
from runner.export.rerun.layout import blueprint
from runner.export.rerun.runs import RunReader
from runner.export.rerun.selection import Request, Selection, select
from runner.export.rerun.tracks import TrackSource, Writer, new_stream
from runner.recording.reader import Recording
from runner.runs.run import Run
from runner.util.files import replacing, storage_errors


def export(
    sources: Sequence[TrackSource],
    request: Request,
    path: Path,
    stage: Callable[[str], None] = lambda _: None,
) -> list[Selection]:
    """Write runs to an `.rrd` file; return the selection of each. `stage` is called with what takes long."""
    selections = [select(source.recording, request) for source in sources]
    stream = new_stream("-".join(source.recording.run_id for source in sources))
    with _saved(stream, path):
        stream.send_recording_name(" and ".join(source.title for source in sources))
        readers = [
            RunReader(Writer(stream, source, selection, stage))
            for source, selection in zip(sources, selections, strict=True)
        ]
        writers = [reader.writer for reader in readers]
        for reader in readers:
            reader.writer.send(reader.overview())
        are_jobs = all(source.recording.has_tables for source in sources)
        if are_jobs:  # before the steps, so that a viewer need not arrange them itself as they load
            stream.send_blueprint(blueprint(writers))
        for reader in readers:
            reader.writer.send(reader.steps())
        if not are_jobs:  # their views follow from steps
            stream.send_blueprint(blueprint(writers))
    return selections


def export_runs(
    runs: Sequence[Run],
    recordings: Sequence[Recording],
    request: Request,
    path: Path,
    stage: Callable[[str], None] = lambda _: None,
) -> list[Selection]:
    """Write runs and their opened recordings as `export` does; several have different colours."""
    sources = []
    for i, (run, recording) in enumerate(zip(runs, recordings, strict=True)):
        root, tint = f"/{run.run_id}", palette.COMPARED[i % len(palette.COMPARED)]
        title = f"{run.title} ({run.run_id})"
        sources.append(
            TrackSource(recording, title, root, tint, run.marks)
            if len(runs) > 1
            else TrackSource(recording, title, marks=run.marks)
        )
    return export(sources, request, path, stage)


@contextlib.contextmanager
def _saved(stream: rr.RecordingStream, path: Path) -> Iterator[None]:
    """Save everything sent to a stream as a file, which replaces another only when it is complete."""
    with storage_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary:
            temporary.touch()  # where no file can be created, Rerun would not raise an OSError
            stream.save(temporary)
            yield
            stream.flush()
            stream.disconnect()
