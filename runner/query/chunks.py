"""The tables of a run in batches of columns; a condition reads the chunks alone that may satisfy it.

A recording has chunks of messages, an archive groups of rows. What is known of each without reading it, such
as the numbers of its steps, is compared with the condition first.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial, reduce
from operator import and_
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds
import pyarrow.parquet as pq
from pyarrow.fs import LocalFileSystem

from runner.analysis.contents import damage_of
from runner.archive import layout
from runner.archive.batches import Batches, batch_of
from runner.archive.columns import Shape, Table
from runner.archive.places import archive_store
from runner.archive.reading import Archive, check_table
from runner.archive.store import ArchiveStore
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.reader import Phase, Recording, open_recording
from runner.recording.schema import STEP_NANOSECONDS
from runner.recording.topic_chunks import TopicChunks
from runner.runs.run import Run
from runner.util.arrays import Ints

Known = Mapping[str, tuple[Any, Any]]
"""The least and the greatest value of columns of a chunk that was not read."""

_COMPARED: Final = ("phase", "position", "step", "episode")
"""The columns of which an archive knows the least and the greatest value in a group of rows."""
_ROWS: Final = 1 << 14
_BUFFER: Final = 1 << 16
_NOT_NEEDED: Final = frozenset(layout.TOPICS) - {layout.EXTRA_COLUMNS} | {
    layout.Q_TABLES,
    layout.CONTENTS,
    layout.RUN,
    layout.TRANSITIONS,
    layout.STATES,
    layout.ACTIONS,
}
"""Files of an archive that its tables are read without."""


@dataclass(frozen=True)
class Condition:
    """What the rows of a table must satisfy that a query needs."""

    expression: Any
    """An expression of Arrow; None for all rows."""
    columns: pa.Schema
    """The columns of the table."""

    def mentions(self, column: str) -> bool:
        """Return whether the condition may be about a column."""
        return self.expression is not None and column in str(self.expression)

    def may_hold(self, chunks: Sequence[Known]) -> list[int]:
        """Return the numbers of the chunks that may have rows which satisfy the condition."""
        if self.expression is None:
            return list(range(len(chunks)))
        form, files = ds.ParquetFileFormat(), LocalFileSystem()  # Arrow compares; no file is opened
        parts = [form.make_fragment(str(k), files, _ranges(known)) for k, known in enumerate(chunks)]
        kept = ds.FileSystemDataset(parts, self.columns, form, files).get_fragments(self.expression)
        return [int(part.path) for part in kept]


def _ranges(known: Known) -> Any:
    """Return what is known of a chunk as an expression."""
    ranges = [
        (pc.field(name) >= low) & (pc.field(name) <= high) if low != high else pc.field(name) == low
        for name, (low, high) in known.items()
    ]
    return reduce(and_, ranges)


class Relation(ds.Dataset):  # type: ignore[misc]
    """A view that DuckDB asks for columns, and for the rows that satisfy a condition."""

    def __init__(
        self, columns: pa.Schema, read: Callable[[pa.Schema, Condition], Iterator[pa.RecordBatch]]
    ) -> None:
        self._columns = columns
        self._read = read

    @property
    def schema(self) -> pa.Schema:
        """The columns."""
        return self._columns

    def scanner(self, columns: Sequence[str] | None = None, filter: Any = None, **_: object) -> Any:  # noqa: A002
        """Return what DuckDB uses of a scanner, which would read ahead in threads of its own."""
        names = columns or self._columns.names
        condition = Condition(filter, self._columns)
        projected = _selected(self._columns, lambda name: name in names)
        read = _selected(self._columns, lambda name: name in names or condition.mentions(name))
        batches = self._read(read, condition)
        rows = batches if filter is None else (batch.filter(filter) for batch in batches)
        return SimpleNamespace(
            projected_schema=projected,
            to_reader=lambda: pa.RecordBatchReader.from_batches(
                projected, (batch.select(projected.names) for batch in rows)
            ),
        )


def _selected(columns: pa.Schema, is_selected: Callable[[str], bool]) -> pa.Schema:
    return pa.schema([column for column in columns if is_selected(column.name)])


@dataclass(frozen=True)
class RunTables:
    """The tables of one run."""

    shape: Shape
    count: Callable[[Table], int]
    """Returns the number of chunks of a table, or of its rows."""
    batches: Callable[[Table, Condition, Sequence[str]], Iterator[pa.RecordBatch]]
    """Yields the columns of these names in the chunks of a table with rows that may satisfy a condition."""


@contextlib.contextmanager
def opened_tables(run: Run) -> Iterator[RunTables]:
    """Open the recording of a run, or its archive where it is.

    Raises:
        RecordingError: it is damaged, or missing.
        StorageError: it cannot be reached.
    """
    if run.status != "archived":
        with open_recording(run.recording) as recording:
            if damage := damage_of(run, recording):
                raise RecordingError(damage)
            batches = Batches(recording)
            yield RunTables(
                batches.shape,
                lambda table: sum(len(recording.table(topic)) for topic in table.topics),
                partial(_batches_of_recording, recording, batches),
            )
        return
    store = archive_store(run)
    with store.reading(run.run_id, _NOT_NEEDED) as folder:
        archive = Archive(folder)
        if archive.manifest.digest != run.archive.digest:
            raise RecordingError(
                f"{store.place(run.run_id)}: found an archive of digest {archive.manifest.digest}, expected "
                f"{run.archive.digest}."
            )
        yield RunTables(
            archive.shape,
            lambda table: archive.count(*table.topics),
            partial(_batches_of_archive, archive, store),
        )


# --- recordings -------------------------------------------------------------------------------------------


def _batches_of_recording(
    recording: Recording, batches: Batches, table: Table, condition: Condition, names: Sequence[str]
) -> Iterator[pa.RecordBatch]:
    for topic in batches.shape.topics_of(table):
        if (chunks := batches.chunks_of(topic)) is not None:
            kept = condition.may_hold(_known_of(recording, chunks, condition))
            for records in batches.records(topic, kept):
                yield batch_of(table, topic, records, batches.shape, names)


def _known_of(recording: Recording, chunks: TopicChunks, condition: Condition) -> list[Known]:
    """Return what is known of the chunks of a topic."""
    times = chunks.file.index.chunks.columns[chunks.places]  # of the first and the last message of each
    starts, ends = (times[name].astype(np.int64) for name in ("start_time", "end_time"))
    ranges = {"position": (starts // STEP_NANOSECONDS, ends // STEP_NANOSECONDS)}
    topic = chunks.topic
    same = {"run": (recording.run_id, recording.run_id)}
    if topic.phase in schema.PHASES:
        same["phase"] = (topic.phase, topic.phase)
    if topic.message in schema.NUMBERED_BY and chunks.dtype is not None:
        first, stop = chunks.chunk_numbers
        ranges[schema.NUMBERED_BY[topic.message]] = first, stop - 1
    if topic.message is schema.STEP and condition.mentions("episode"):
        ranges |= _episodes_of_steps(recording.phase(topic.phase), starts, ends)
    return [
        same | {name: (int(low[k]), int(high[k])) for name, (low, high) in ranges.items()}
        for k in range(len(starts))
    ]


def _episodes_of_steps(phase: Phase, starts: Ints, ends: Ints) -> dict[str, tuple[Ints, Ints]]:
    """Return the first and the last episode of chunks of steps: an episode has the time of its last step.

    Environments that take turns count their own episodes. A chunk after the last episode may be of any later
    one, as of a run that was killed. Nothing is known where a repair lost episodes.
    """
    if phase.episodes.lost:
        return {}
    turns = phase.steps.environments if phase.steps.have_turns else 1
    blocks: list[list[Ints]] = [[np.zeros(0, np.int64)] for _ in range(turns)]
    for block in phase.episodes.rows():
        for k, times in enumerate(blocks):
            rows = block[block["environment"] == k] if turns > 1 else block
            times.append(rows["log_time"].astype(np.int64))
    first, last = [], []
    for ended in map(np.concatenate, blocks):
        after = np.searchsorted(ended, ends)
        first.append(np.searchsorted(ended, starts))
        last.append(np.where(after < len(ended), after, np.iinfo(np.int64).max))
    return {"episode": (np.min(first, axis=0), np.max(last, axis=0))}


# --- archives ---------------------------------------------------------------------------------------------


def _batches_of_archive(
    archive: Archive, store: ArchiveStore, table: Table, condition: Condition, names: Sequence[str]
) -> Iterator[pa.RecordBatch]:
    rows = archive.count(*table.topics)
    if not rows:
        return
    run_id = archive.run_id
    where = f"{store.place(run_id)}/{table.name}"
    places = {name: k for k, name in enumerate(table.columns.names) if name in _COMPARED}
    try:
        with (
            store.opened(run_id, table.name) as source,
            pq.ParquetFile(source, buffer_size=_BUFFER, pre_buffer=False) as file,
        ):
            check_table(file, where, source.size(), table.columns, rows)
            known = []
            for group in map(file.metadata.row_group, range(file.num_row_groups)):
                facts = {name: group.column(k).statistics for name, k in places.items()}
                known.append(
                    {"run": (run_id, run_id)}
                    | {name: (s.min, s.max) for name, s in facts.items() if s is not None and s.has_min_max}
                )
            for batch in file.iter_batches(_ROWS, row_groups=condition.may_hold(known), columns=list(names)):
                yield batch.select(names)
    except (pa.ArrowException, OverflowError) as error:
        raise RecordingError(f"{where}: cannot be read as a table ({error}).") from error
