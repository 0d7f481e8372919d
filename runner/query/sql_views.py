"""The views that a query in SQL names: the tables of the selected runs as one, with a column for the run.

Steps, extras, episodes and scalars are read while the query runs, in the columns and chunks that it needs. A
column that a run does not have is null in its rows. The other views are small.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from runner.analysis.evaluations import evaluation_records
from runner.analysis.frames import evaluation_column
from runner.archive import layout
from runner.archive.columns import Shape
from runner.archive.places import opened
from runner.environments.mdp import events_of
from runner.errors import NotInRecording, RecordingError, RunnerError
from runner.recording.marks import read_marks
from runner.runs.catalogue.columns import COLUMNS, IndexRow
from runner.runs.catalogue.filters import Filter
from runner.runs.catalogue.index import look
from runner.runs.run import Run, listed_run, recordings_folder
from runner.util.humanize import counted, listed
from runner.util.processes import Tell
from runner.util.values import flatten

if TYPE_CHECKING:
    from runner.query.chunks import Condition, Relation, RunTables

TABLES: Final = {
    "steps": layout.STEPS,
    "extras": layout.EXTRAS,
    "episodes": layout.EPISODES,
    "scalars": layout.SCALARS,
}
"""The views of tables, which may be long."""
VIEWS: Final = ("runs", "evaluations", "marks", *TABLES)
_MOMENT: Final = pa.timestamp("ms", tz="UTC")
_TEXTS: Final = pa.list_(pa.string())
_TYPES: Final = {str: pa.string(), int: pa.int64(), float: pa.float64()}
_MARKS: Final = {
    **dict.fromkeys(("run", "mark", "ref", "phase", "text", "created"), pa.string()),
    **dict.fromkeys(("episode", "t"), pa.int64()),
    "tags": _TEXTS,
}
_ROW: Final = ("root", "entry", "id", "name", "status")
_REPORT_SECONDS: Final = 0.2


Recordings = str | os.PathLike[str] | list[Path] | tuple[Path, ...] | None
"""A folder of runs, or several; $DUALTAXI_RECORDINGS, or ./recordings, if it is None."""


class SelectedRuns:
    """The runs that a query is about, and how far it has read them.

    Args:
        run_filter: the filter that they match.
        report: called with how far it has read, a few times a second.
    """

    def __init__(self, recordings: Recordings, run_filter: Filter, report: Tell) -> None:
        if not isinstance(recordings, list | tuple):
            recordings = [recordings_folder(recordings)]
        self._roots = recordings
        self._filter = run_filter
        self.rows = look(recordings, lambda index: index.select(run_filter, columns=_ROW))
        self._report = report
        self._reported = time.monotonic()
        self._read_runs: set[str] = set()
        self._read_rows = 0
        self.left_out: dict[str, dict[str, str]] = {}
        """Why runs are left out, or the rest of them, by their id and the view."""
        self.is_stopped = False
        """Set to make the query end before it reads another chunk or run."""

    def __str__(self) -> str:
        """Return how far the query has read."""
        return f"{self._read_rows:,} rows of {len(self._read_runs):,} of {len(self.rows):,} runs were read"

    @property
    def sentences(self) -> list[str]:
        """Sentences on the runs that are left out, one for each view and reason."""
        runs = defaultdict[tuple[str, str], list[str]](list)
        for run_id, reasons in self.left_out.items():
            for reason in reasons.items():
                runs[reason].append(run_id)
        return [
            f"run {ids[0]} is left out of {view}: {reason}"
            if len(ids) == 1
            else f"{len(ids):,} runs are left out of {view} ({listed(ids)}): each because {reason}"
            for (view, reason), ids in runs.items()
        ]

    def view(self, name: str) -> pa.Table | Relation:
        """Return a view."""
        if name in TABLES:
            relation = self.table(name, self.rows)
            self._read_runs.clear()  # none of their rows were read yet
            return relation
        return {"runs": self._runs, "evaluations": self._evaluations, "marks": self._marks}[name]()

    @contextlib.contextmanager
    def reading(self, name: str, row: IndexRow) -> Iterator[Run]:
        """Yield a run; leave it out of a view if the block raises an error."""
        try:
            yield listed_run(Path(row["root"], row["entry"]), row["id"])
        except RunnerError as error:
            self.left_out.setdefault(row["id"], {})[name] = str(error)

    def _count(self, row: IndexRow, rows: int) -> None:
        if self.is_stopped:
            raise CancelledError
        self._read_runs.add(row["id"])
        self._read_rows += rows
        if time.monotonic() - self._reported > _REPORT_SECONDS:
            self._reported = time.monotonic()
            self._report(str(self))

    def _runs(self) -> Relation:
        """Return the columns of `dualtaxi ls`, and each configuration as JSON."""
        from runner.query.chunks import Relation  # imports pandas

        kinds = {"run": pa.string()}
        kinds |= {name: _TYPES[column.type] for name, column in COLUMNS.items() if column.type}
        kinds |= {"seed": pa.uint64(), "created": _MOMENT, "tags": _TEXTS, "settings": pa.string()}
        del kinds["id"]
        return Relation(pa.schema(kinds), self._batches_of_runs)

    def _batches_of_runs(self, needed: pa.Schema, condition: Condition) -> Iterator[pa.RecordBatch]:
        """Yield some columns of the runs, without a condition."""
        del condition
        stored = ["id AS run", *(name for name in needed.names if name != "run")]
        rows = look(self._roots, lambda index: index.select(self._filter, columns=stored), cached=True)
        rows = [row | {"tags": (row.get("tags") or "").split()} for row in rows]
        yield from _table(rows, dict(zip(needed.names, needed.types, strict=True))).to_batches()

    def _evaluations(self) -> pa.Table:
        """Return the columns of `runner.frames.evaluations`, with _ for dots, and the sums over agents."""
        rows: list[dict[str, object]] = []
        for row in self.rows:
            with (
                self.reading("evaluations", row) as run,
                opened(run) as recording,
            ):
                for record in evaluation_records(recording):
                    values = flatten(record.as_json())
                    named = {evaluation_column(key).replace(".", "_"): values[key] for key in values}
                    rows.append({"run": row["id"], "mean_return": record.value("mean_return")} | named)
                self._count(row, 0)
        return _table(rows, {"run": pa.string()} | dict.fromkeys(name for row in rows for name in row))

    def _marks(self) -> pa.Table:
        marks = [
            {"run": row["id"], "ref": mark.at} | mark.as_row()
            for row in self.rows
            for mark in read_marks(Path(row["root"], row["entry"])).marks
        ]
        return _table(marks, _MARKS)

    def table(self, name: str, among: Sequence[IndexRow]) -> Relation:
        """Return the view of a table, with the columns of all of these runs."""
        from runner.query.chunks import Relation, opened_tables  # imports pandas

        kinds = {"run": pa.string()}
        rows = []
        for row in among:
            with self.reading(name, row) as run, opened_tables(run) as tables:
                table = tables.shape.tables.get(TABLES[name])
                if table is None or not tables.count(table):
                    raise NotInRecording(f"it has no {name}.")
                for column in table.columns:
                    kinds[column.name] = _wider(kinds.get(column.name), column.type)
                if name == "steps":
                    events = [event for event in tables.shape.event_masks if event not in kinds]
                    kinds |= dict.fromkeys(events, pa.bool_())
                rows.append(row)
                self._count(row, 0)
        for left_out in ("run_id", "taken"):
            kinds.pop(left_out, None)
        own_names: dict[str, str] = {}
        for stored_name in kinds:  # DuckDB ignores case
            unique_name = stored_name
            while unique_name.casefold() in map(str.casefold, own_names):
                unique_name += "_"
            own_names[unique_name] = stored_name
        columns = pa.schema(
            [(unique_name, kinds[stored_name]) for unique_name, stored_name in own_names.items()]
        )
        return Relation(columns, partial(self._batches, name, rows, own_names))

    def _batches(
        self,
        name: str,
        rows: Sequence[IndexRow],
        own_names: Mapping[str, str],
        needed: pa.Schema,
        condition: Condition,
    ) -> Iterator[pa.RecordBatch]:
        """Yield some columns of a table; some of the rows may not satisfy the condition."""
        from runner.query.chunks import opened_tables  # imports pandas

        for k in condition.may_hold([{"run": (row["id"], row["id"])} for row in rows]):
            read = 0
            with self.reading(name, rows[k]) as run, opened_tables(run) as tables:
                try:
                    for batch in _batches_of(tables, TABLES[name], own_names, needed, condition):
                        self._count(rows[k], batch.num_rows)
                        yield batch
                        read += batch.num_rows
                except RunnerError as error:
                    rest = f" The {counted(read, 'row')} before the damage were read." if read else ""
                    raise RecordingError(f"{error}{rest}") from error


def _batches_of(
    tables: RunTables, file: str, own_names: Mapping[str, str], needed: pa.Schema, condition: Condition
) -> Iterator[pa.RecordBatch]:
    table = tables.shape.tables[file]
    names = [own_names[name] for name in needed.names]
    run_id = pa.scalar(tables.shape.run_id)
    stored = [name for name in names if name in table.columns.names]
    unknown = {*names} - {*stored, "run"} if file == layout.STEPS else set[str]()
    masks = {name: mask for name, mask in tables.shape.event_masks.items() if name in unknown}
    of_events = _columns_of_events(tables.shape) if masks else []
    is_turn = ["taken"] if "taken" in table.columns.names else []  # else it is no step of its environment
    read = list(dict.fromkeys([*stored, *is_turn, *of_events])) or ["position"]  # to count the rows
    for batch in tables.batches(table, condition, read):
        rows = batch.filter(batch["taken"]) if is_turn else batch
        columns = {name: rows[name] for name in stored} | {"run": pa.repeat(run_id, rows.num_rows)}
        if masks:
            events = _events_of(tables.shape, rows)
            columns |= {name: pa.array(events & mask != 0) for name, mask in masks.items()}
        values = [
            columns[name].cast(column.type) if name in columns else pa.nulls(rows.num_rows, column.type)
            for name, column in zip(names, needed, strict=True)
        ]
        yield pa.RecordBatch.from_arrays(values, schema=needed)


def _columns_of_events(shape: Shape) -> list[str]:
    """Return the columns from which the events of steps follow."""
    rewards = shape.per_learner("reward") or ["reward"]
    return ["state", "action", "next_state", "terminated", *rewards]


def _events_of(shape: Shape, rows: pa.RecordBatch) -> NDArray[np.uint32]:
    """Return the events of steps, a bit mask each."""
    assert shape.mdp is not None
    names = _columns_of_events(shape)
    kinds = [*((name, np.int64) for name in names[:4]), ("rewards", np.float64, len(names) - 4)]
    rewards = np.stack([rows[name] for name in names[4:]], axis=1)
    return events_of(shape.mdp, np.rec.fromarrays([*map(rows.column, names[:4]), rewards], kinds))


def _table(rows: Sequence[Mapping[str, Any]], kinds: Mapping[str, pa.DataType | None]) -> pa.Table:
    """Return rows as a table; a type that is None follows from the values."""
    return pa.table({name: pa.array([row.get(name) for row in rows], kind) for name, kind in kinds.items()})


def _wider(known: pa.DataType | None, new: pa.DataType) -> pa.DataType:
    """Return the type of a column in a query that has these types in runs; text if they are unlike."""
    if pa.types.is_dictionary(new):
        new = pa.string()
    elif pa.types.is_fixed_size_binary(new):
        new = pa.binary()
    if known is None or known == new:
        return new
    try:
        pair = [pa.schema([("", kind)]) for kind in (known, new)]
        return pa.unify_schemas(pair, promote_options="permissive").types[0]
    except pa.ArrowException:
        return pa.string()
