"""Exporting runs to one `.rrd` file."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
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
        readers = []
        for source, selection in zip(sources, selections, strict=True):
            writer = Writer(stream, source, selection, stage)
            readers.append((writer, RunReader(writer)))
        for writer, reader in readers:
            writer.send(reader.overview())
        writers = [writer for writer, _ in readers]
        are_jobs = all(source.recording.has_tables for source in sources)
        if are_jobs:  # before the steps; active, as a viewer has arranged the metrics by itself
            stream.send_blueprint(blueprint(writers))
        for writer, reader in readers:
            writer.send(reader.steps())
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
    colours = itertools.cycle(palette.COMPARED)
    sources = []
    for run, recording in zip(runs, recordings, strict=True):
        source = TrackSource(recording, f"{run.title} ({run.run_id})", marks=run.marks)
        if len(runs) > 1:
            source = dataclasses.replace(source, root=f"/{run.run_id}", tint=next(colours))
        sources.append(source)
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
