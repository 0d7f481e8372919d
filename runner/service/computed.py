"""Responses that take long to compute, for child processes."""

from __future__ import annotations

import contextlib
import io
import json
import os
import tempfile
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from itertools import islice
from pathlib import Path
from typing import Final, Literal

from runner.analysis.axes import axis_of
from runner.analysis.episodes import EpisodeRef
from runner.analysis.evaluations import training_records
from runner.analysis.frames import Phase, episode_columns, step_columns
from runner.analysis.histograms import histograms
from runner.analysis.sections import Answer
from runner.archive.places import default_target
from runner.errors import ConfigError, RunnerError
from runner.export.encoder import FORMATS
from runner.export.film import Shot, usual_speed, write_film
from runner.export.pictures import Pictures
from runner.export.plugin import installed_export
from runner.export.reports.report import render_report
from runner.export.rerun.cache import cached_export
from runner.export.rerun.selection import Request
from runner.export.rerun.viewer import require_rerun
from runner.recording import schema
from runner.recording.reader import open_recording
from runner.runs.run import Run
from runner.service.settings import ServiceSettings
from runner.util.extras import require
from runner.util.values import finite
from runner.views.view import Given

MAX_ROWS: Final = 1000
"""The most rows of a query, and the most episodes of a search."""
MAX_FILM_STEPS: Final = 5_000
"""The most steps of a film, as one film is made at a time."""
RecordKind = Literal["training", "optimality"]


def run_histograms(path: Path, axis: str) -> bytes:
    """Return the histograms of a run's training over an axis, as JSON."""
    with open_recording(path) as recording:
        result, notes = histograms(recording, axis_of(axis))
        return as_json({"run_id": recording.run_id, "histograms": result, "notes": notes})


def records(path: Path, kind: RecordKind, rows: range, limit: int) -> bytes:
    """Return reports of training or exact measures by their numbers, as JSON."""
    with open_recording(path) as recording:
        if kind == "optimality":
            everything = list(recording.table(schema.OPTIMALITY_TOPIC).decoded())
        else:
            recording.require_job("a report of training", "Its metrics can be had all the same.")
            everything = [record.as_json() for record in training_records(recording)]
        shown = everything[rows.start : rows.stop]
        require_few(len(shown), limit)
        page = {"run_id": recording.run_id, "start": rows.start, "total": len(everything), "records": shown}
        return as_json(page)


def require_few(found: int, limit: int) -> None:
    """Refuse a range of more records than a response may have."""
    if found > limit:
        raise ConfigError(
            f"query: found a range of {found:,} records, expected at most {limit:,}; request them in parts.",
        )


def answer(subject: Path | Sequence[Run], question: Callable[..., Answer], values: Given) -> bytes:
    """Return the answer to a question about a recording or some runs, as --json prints it."""
    with open_recording(subject) if isinstance(subject, Path) else nullcontext(subject) as content:
        return as_json(question(content, **dict(values)).as_json())


def answer_file(path: Path, question: Callable[..., Answer], values: Given) -> bytes:
    """Return the file of the answer to a question about a recording."""
    with open_recording(path) as recording, io.BytesIO() as stream:
        question(recording, **dict(values)).write(stream)
        return stream.getvalue()


def installed_file(path: Path, name: str) -> bytes:
    """Return the file that an export of an installed package makes of a recording."""
    with tempfile.TemporaryDirectory() as folder, open_recording(path) as recording:
        file = Path(folder) / "export"
        installed_export(name).write(recording, file)
        return file.read_bytes()


def report(path: Path, settings: ServiceSettings) -> bytes:
    """Return the report of a run, a page without links to others."""
    return settings.without_folders(render_report([path])[0]).encode()


def film(path: Path, title: str, step: EpisodeRef, ending: str) -> bytes:
    """Return the film of an episode from a step on, below the title of its run.

    The ending of its file, such as `.mp4`, is its format.
    """
    if ending not in FORMATS:
        raise RunnerError(f"format: found {ending[:20]!r}, expected one of {', '.join(FORMATS)}.")
    with tempfile.TemporaryDirectory() as folder, open_recording(path) as recording:
        file = Path(folder, f"film{ending}")
        shown = step.resolved(recording)
        pictures = Pictures(recording, shown.phase, shown.number_in(recording))
        if shown.t > pictures.steps:
            raise shown.no_step(recording, pictures.steps, shown.t)
        if (steps := pictures.steps - shown.t) > MAX_FILM_STEPS:
            raise RunnerError(
                f"found {steps:,} steps to film, expected at most {MAX_FILM_STEPS:,}: begin at a later step, "
                "or use `dualtaxi export film`, which has no limit."
            )
        shot = Shot(f"{title}: {shown.title}", pictures, shown.t)
        write_film(file, shot, usual_speed(pictures.source), None, lambda _: None)
        return file.read_bytes()


def archive(run: Run, remove: bool) -> bytes:
    """Archive a run as `dualtaxi archive` does; `remove` its recording once the archive was compared."""
    require("pyarrow", extra="archive", purpose="an archive")
    from runner.archive.runs import archive_run

    return as_json(archive_run(run, default_target(run.folder.parent), remove).as_json())


def arrow(path: Path, table: str, phase: Phase, rows: range) -> bytes:
    """Return the columns of steps or episodes by their numbers as an Arrow stream."""
    require("pyarrow", extra="archive", purpose="Arrow")
    import pyarrow as pa

    with open_recording(path) as recording:
        if table == "steps":
            columns = step_columns(recording, phase, start=rows.start, stop=rows.stop)
        else:
            columns = episode_columns(recording, phase, rows.start, rows.stop)
    arrays = {
        name: pa.array(values if values.ndim == 1 else values.tolist()) for name, values in columns.items()
    }
    whole = pa.table(arrays)
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, whole.schema) as writer:
        writer.write_table(whole)
    return bytes(sink.getvalue())


def replay(runs: Sequence[Run], request: Request) -> bytes:
    """Return the path of an export for the Rerun viewer, from the user's cache or new."""
    require_rerun("a replay")
    return os.fsencode(cached_export(runs, request)[0])


def query(settings: ServiceSettings, text: str, runs: str) -> bytes:
    """Return the first rows of a query in SQL, as JSON."""
    require("pyarrow", extra="sql", purpose="SQL")
    from runner.query.sql import sql

    result = sql(text, recordings=settings.recordings, runs=runs)
    with contextlib.closing(result.rows()) as rows:
        first = list(islice(rows, MAX_ROWS + 1))
    found = {
        "columns": result.columns.names,
        "rows": first[:MAX_ROWS],
        "more": len(first) > MAX_ROWS,
        "left_out": result.left_out,
    }
    return settings.without_folders(as_json(found).decode()).encode()


def find(settings: ServiceSettings, expression: str, runs: str, phase: str, sort: str, limit: int) -> bytes:
    """Return the episodes that match an expression, as `dualtaxi find --json` prints them."""
    require("pyarrow", extra="sql", purpose="`find`")
    from runner.query import find

    found = find.find(
        expression,
        settings.recordings,
        runs=runs,
        phase=phase or None,
        sort=sort,
        limit=limit or MAX_ROWS,
    )
    return settings.without_folders(as_json(found.as_json()).decode()).encode()


def as_json(value: object) -> bytes:
    """Return a value as JSON; NaN and infinity become null."""
    return json.dumps(finite(value), allow_nan=False, ensure_ascii=False).encode(errors="replace")
