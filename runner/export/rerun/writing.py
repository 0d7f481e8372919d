"""Exporting runs to one `.rrd` file."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from pathlib import Path

import rerun as rr

from runner.drawing import palette
from runner.export.places import new_file
from runner.export.rerun.layout import blueprint
from runner.export.rerun.runs import RunReader
from runner.export.rerun.selection import Request, Selection, select
from runner.export.rerun.tracks import APPLICATION, Writer
from runner.recording.reader import open_recording
from runner.runs.run import Run


def export(
    runs: Sequence[Run], request: Request, path: Path, stage: Callable[[str], None] = lambda _: None
) -> list[Selection]:
    """Write runs to an `.rrd` file; return the selection of each.

    Several runs have different colours. `stage` is called with what takes long.
    """
    with contextlib.ExitStack() as stack:
        recordings = [stack.enter_context(open_recording(run.recording)) for run in runs]
        selections = [select(recording, request) for recording in recordings]
        stream = rr.RecordingStream(APPLICATION, recording_id="-".join(r.run_id for r in recordings))
        temporary = stack.enter_context(new_file(path, force=True))
        temporary.touch()  # where no file can be created, Rerun would not raise an OSError
        stream.save(temporary)
        stream.set_log_time_enabled(False)
        writers = [
            Writer(stream, recording, selection, f"{run.title} ({run.run_id})", run.marks, stage=stage)
            for run, recording, selection in zip(runs, recordings, selections, strict=True)
        ]
        for i, writer in enumerate(writers if len(runs) > 1 else ()):
            writer.root = f"/{runs[i].run_id}"
            writer.tint = palette.COMPARED[i % len(palette.COMPARED)]
        stream.send_recording_name(" and ".join(writer.title for writer in writers))
        readers = [RunReader(writer) for writer in writers]
        for reader in readers:
            reader.writer.send(reader.overview())
        are_jobs = all(recording.has_tables for recording in recordings)
        if are_jobs:  # before the steps, so that a viewer need not arrange them itself as they load
            stream.send_blueprint(blueprint(writers))
        for reader in readers:
            reader.writer.send(reader.steps())
        if not are_jobs:  # their views follow from steps
            stream.send_blueprint(blueprint(writers))
        stream.flush()
        stream.disconnect()
    return selections
