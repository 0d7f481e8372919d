"""Steps, episodes and measures as tables, for spreadsheets and data frames: CSV or Parquet, a file each.

Of somebody's own loop also its resets and infos. A column has a number or a text; what has more numbers than
`runner.archive.values` spreads over columns is bytes, which CSV cannot hold.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet

from runner.archive import layout
from runner.archive.batches import Batches
from runner.export.contents import whole_ranges
from runner.export.scalars import measures
from runner.recording.reader import Recording

Ranges = tuple[tuple[int, int | None], ...]
Report = Callable[[int], None]
_TABLES: Final = {
    "steps": layout.STEPS,
    "episodes": layout.EPISODES,
    "resets": layout.RESETS,
    "infos": layout.INFOS,
}
"""Name -> the table of an archive that it is."""
OURS: Final = tuple(
    name + ending for name in (*_TABLES, "metrics") for ending in (".csv", ".csv.gz", ".parquet")
)
_METRICS: Final = pa.schema(
    [
        *(("run_id", pa.string()), ("phase", pa.string()), ("position", pa.int64()), ("step", pa.int64())),
        *(("episode", pa.int64()), ("metric", pa.string()), ("value", pa.float64())),
    ]
)
_ROWS: Final = 8192


@dataclass(frozen=True)
class Choice:
    """Which steps and episodes are exported; measures always are."""

    phase: str = ""
    """`train`, `eval`, or both."""
    episodes: Ranges = ()
    """Ranges of episodes, the second number not included; None is the end; all if there are none."""


def write_tables(
    recording: Recording,
    folder: Path,
    form: str,
    choice: Choice,
    gz: bool = False,
    report: Report = lambda _: None,
) -> dict[str, int]:
    """Write the tables of a recording into a folder; return how many rows each has, by file.

    Args:
        recording: whose.
        folder: where to.
        form: `csv` or `parquet`.
        choice: which steps and episodes.
        gz: pack CSV files with gzip.
        report: called with the steps written so far.

    Raises:
        RecordingError: the recording is damaged, or has no such episodes.
        OSError: the folder cannot be written.
    """
    ending = f".{form}.gz" if gz else f".{form}"
    if choice.episodes:
        phase = choice.phase or "train"
        whole_ranges(choice.episodes, _episodes(recording, phase), phase, str(recording.path))
    reading = Batches(recording)
    own = {table.name: table for table in reading.shape.tables}
    tables = {
        name: _chosen(reading.of(own[file]), choice) for name, file in _TABLES.items() if file in own
    } | {"metrics": metric_batches(recording)}
    rows = {}
    for name, batches in tables.items():
        rows[name + ending] = _write(
            folder / (name + ending), form, gz, batches, report if name == "steps" else lambda _: None
        )
    return {name: count for name, count in rows.items() if count}


def _episodes(recording: Recording, phase: str) -> int:
    """Return how many episodes of a phase have steps, one that never ended among them."""
    ended = recording.count(recording.topic(f"/{phase}/episode"))
    taken = int(recording.episodes(phase, ended - 1, ended)[0]["last_step"]) + 1 if ended else 0
    return ended + (recording.count(recording.topic(f"/{phase}/step")) > taken)


def metric_batches(recording: Recording) -> Iterator[pa.RecordBatch]:
    """Yield every measure as a row: phase, position, step, episode, name and value."""
    run_id = recording.run_id
    rows = (
        (run_id, found.phase, found.position, found.step, found.episode, name, value)
        for found in measures(recording)
        for name, value in found.values.items()
    )
    while some := list(islice(rows, _ROWS)):
        columns = zip(*some, strict=True)
        arrays = [pa.array(column, field.type) for column, field in zip(columns, _METRICS, strict=True)]
        yield pa.RecordBatch.from_arrays(arrays, schema=_METRICS)


def _chosen(batches: Iterator[pa.RecordBatch], choice: Choice) -> Iterator[pa.RecordBatch]:
    """Yield the rows that are chosen."""
    for batch in batches:
        kept = batch if not choice.phase else batch.filter(pc.equal(batch["phase"], choice.phase))
        if choice.episodes and "episode" in kept.schema.names:
            kept = kept.filter(_within(kept["episode"], choice.episodes))
        if kept.num_rows:
            yield kept


def _within(numbers: pa.Array, ranges: Sequence[tuple[int, int | None]]) -> pa.Array:
    """Return which numbers lie in one of the ranges."""
    found = pa.scalar(False)
    for start, stop in ranges:
        inside = pc.greater_equal(numbers, start)
        if stop is not None:
            inside = pc.and_(inside, pc.less(numbers, stop))
        found = pc.or_(found, inside)
    return found


def _write(path: Path, form: str, gz: bool, batches: Iterator[pa.RecordBatch], report: Report) -> int:
    """Write batches into a file; return how many rows. Without any there is no file."""
    first = next(batches, None)
    if first is None:
        return 0
    columns = _plain(first.schema) if form == "csv" else first.schema
    rows = 0
    with contextlib.ExitStack() as stack:
        if form == "csv":
            target = pa.CompressedOutputStream(str(path), "gzip") if gz else pa.OSFile(str(path), "wb")
            stack.enter_context(target)
            options = pa.csv.WriteOptions(quoting_style="needed")
            writer: Any = pa.csv.CSVWriter(target, columns, write_options=options)
        else:
            writer = pa.parquet.ParquetWriter(str(path), columns, compression="zstd")
        stack.enter_context(writer)
        for batch in _with(first, batches):
            writer.write_batch(batch.select(columns.names).cast(columns) if form == "csv" else batch)
            rows += batch.num_rows
            report(rows)
    return rows


def _with(first: pa.RecordBatch, rest: Iterator[pa.RecordBatch]) -> Iterator[pa.RecordBatch]:
    yield first
    yield from rest


def left_out(recording: Recording) -> list[str]:
    """Return the columns of a recording that CSV cannot hold: arrays of many numbers."""
    tables = Batches(recording).shape.tables
    found = [one.name for table in tables if table.name in _TABLES.values() for one in table.columns]
    kept = [name for table in tables for name in _plain(table.columns).names]
    return list(dict.fromkeys(name for name in found if name not in kept))


def _plain(columns: pa.Schema) -> pa.Schema:
    """Return a schema that CSV can hold: texts that repeat are texts, and bytes are left out."""
    return pa.schema(
        [
            (one.name, pa.string() if pa.types.is_dictionary(one.type) else one.type)
            for one in columns
            if not pa.types.is_fixed_size_binary(one.type)
        ]
    )
