"""SQL over the recorded runs, by DuckDB: a query reads the views of some runs, and nothing else.

    runner.sql("SELECT config, avg(success_percent), avg(mean_return) FROM runs GROUP BY ALL").pandas()

It cannot read files, reach the network, load extensions or write anything, and has limits of time and memory.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Final

import pyarrow as pa
import pyarrow.parquet as pq

from runner.errors import RunnerError
from runner.query.sql_views import VIEWS, Recordings, SelectedRuns
from runner.runs.catalogue.filters import parse
from runner.util.extras import require
from runner.util.processes import Tell
from runner.util.values import finite

if TYPE_CHECKING:
    import pandas as pd
    import polars as pl

MEMORY_MB: Final = 500
_ROWS: Final = 1 << 14
_CLOSED: Final = {"enable_external_access": "false"}
_SETTINGS: Final = {
    "autoload_known_extensions": "false",
    "autoinstall_known_extensions": "false",
    "allow_community_extensions": "false",
    "python_enable_replacements": "false",
    "temp_directory": "",
    "preserve_insertion_order": "false",
}
_WHOLE: Final = pa.decimal128(38, 0)
"""The type in which DuckDB returns sums of whole numbers."""


class QueryFailed(RunnerError):
    """DuckDB refuses a query, or cannot answer it."""


class Database:
    """A connection to DuckDB, with limits; an error says how far a query has read.

    Args:
        name: the command, for errors.
        runs: the runs that are read.
        memory: the megabytes that DuckDB may use.
        seconds: the time after which a call is stopped; unlimited by default.
        settings: further settings of DuckDB.
    """

    def __init__(
        self,
        name: str,
        runs: SelectedRuns,
        memory: int,
        seconds: float | None = None,
        settings: Mapping[str, str] = _CLOSED,
    ) -> None:
        duckdb = require("duckdb", extra="sql", purpose=f"`{name}`")
        self._errors = (duckdb.Error, pa.ArrowException, RuntimeError)
        self._name = name
        self._runs = runs
        self._seconds = seconds
        self._memory = memory
        self._deadline = time.monotonic() + (seconds or threading.TIMEOUT_MAX)
        config = {**_SETTINGS, **settings, "memory_limit": f"{memory}MB"}
        self.connection = duckdb.connect(":memory:", config=config)
        self._thread = ThreadPoolExecutor(1, name)  # as nothing interrupts a call of DuckDB in this one

    def call(self, function: Callable[..., Any], *args: object) -> Any:
        """Return what a function that uses DuckDB or Arrow returns, within the limits.

        Raises:
            QueryFailed: it fails.
            RunnerError: it exceeds its time or memory.
        """
        future = self._thread.submit(function, *args)
        try:
            return future.result(max(self._deadline - time.monotonic(), 0))
        except KeyboardInterrupt as interrupt:
            interrupt.add_note(f"Interrupted; {self._runs}.")
            raise
        except TimeoutError:
            raise RunnerError(f"{self._name}: stopped after {self._seconds:g} s; {self._runs}.") from None
        except (OSError, *self._errors) as error:  # Arrow raises the former for what fails in the middle
            if isinstance(error, OSError) and error.errno is not None:
                raise
            message = str(error).removeprefix("Error: ").strip()
            if "Out of Memory" in message:
                limit = f"needs more than {self._memory:,} MB of memory, and was stopped"
                raise RunnerError(f"{self._name}: {limit}; {self._runs}.") from error
            raise QueryFailed(f"{self._name}: {message}") from error

    def rows(self, query: str, values: Mapping[str, object] | None = None) -> list[Any]:
        """Return the rows of a query; errors as for `call`."""
        rows: list[Any] = self.call(lambda: self.connection.execute(query, values).fetchall())
        return rows

    def close(self) -> None:
        """End the query; ending it again does nothing."""
        if self._runs.is_stopped:
            return
        self._runs.is_stopped = True
        last = self._thread.submit(bool)  # comes after what the thread does now
        while not last.done():  # DuckDB forgets an interrupt that comes between two calls
            self.connection.interrupt()
            wait([last], timeout=0.1)
        self._thread.shutdown()
        self.connection.close()


class QueryResult:
    """The rows of a query, which are read once: as batches, a table, or a frame."""

    def __init__(self, query: str, runs: SelectedRuns, seconds: float | None, memory: int) -> None:
        self._runs = runs
        self._database = Database("sql", runs, memory, seconds)
        try:
            self._reader = self._database.call(self._begin, query)
            self.columns = pa.schema(
                (column.name, pa.int64() if column.type == _WHOLE else column.type)
                for column in self._reader.schema
            )
            self._first = self._next()  # most errors of a query appear with its first rows
        except BaseException:
            self.close()
            raise

    def _begin(self, query: str) -> pa.RecordBatchReader:
        connection = self._database.connection
        kinds = [statement.type.name for statement in connection.extract_statements(query)]
        if kinds != ["SELECT"]:
            raise RunnerError(f"sql: found {', '.join(kinds) or 'nothing'}, expected one SELECT.")
        for name in VIEWS:
            is_named = name in query.casefold()
            view = self._runs.view(name) if is_named else pa.table({"run": pa.array([], pa.string())})
            connection.register(name, view)
        connection.execute("SET lock_configuration = true")
        return connection.sql(query).to_arrow_reader(_ROWS)

    @property
    def left_out(self) -> list[str]:
        """Sentences on the runs that are left out, as far as the query has read."""
        return self._runs.sentences

    def batches(self) -> Iterator[pa.RecordBatch]:
        """Yield the rows, thousands at a time.

        Raises:
            RunnerError: the query fails, exceeds its time or memory, or has ended.
        """
        if self._runs.is_stopped:
            raise RunnerError("sql: found no rows, as the query has ended; rows are read once, so ask again.")
        with contextlib.closing(self):
            batch, self._first = self._first, None
            while batch is not None:
                yield batch
                batch = self._next()

    def _next(self) -> pa.RecordBatch | None:
        batch = self._database.call(next, self._reader, None)
        return None if batch is None else self._database.call(batch.cast, self.columns)

    def rows(self) -> Generator[list[object], None, None]:
        """Yield the rows one by one, their values as JSON can hold them; errors as for `batches`."""
        for batch in self.batches():
            columns = [[_as_json(value) for value in column.to_pylist()] for column in batch.columns]
            yield from map(list, zip(*columns, strict=True))

    def write_parquet(self, file: Path | BinaryIO) -> int:
        """Write the rows into a Parquet file; return their number."""
        count = 0
        with pq.ParquetWriter(file, self.columns, compression="zstd") as writer:
            for batch in self.batches():
                writer.write_batch(batch)
                count += batch.num_rows
        return count

    def arrow(self) -> pa.Table:
        """Return the rows as a table of Arrow."""
        return pa.Table.from_batches(self.batches(), self.columns)

    def pandas(self) -> pd.DataFrame:
        """Return the rows as a frame of pandas."""
        require("pandas", extra="frames", purpose="a frame")
        frame: pd.DataFrame = self.arrow().to_pandas()
        return frame

    def polars(self) -> pl.DataFrame:
        """Return the rows as a frame of Polars."""
        frame: pl.DataFrame = require("polars", extra="polars", purpose="a frame").DataFrame(self.arrow())
        return frame

    def close(self) -> None:
        """End the query."""
        self._database.close()


def _as_json(value: Any) -> Any:
    """Return a value of Arrow as JSON can hold it: bytes in hexadecimal, times and other types as text."""
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, dict):
        return {key: _as_json(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return list(map(_as_json, value))
    return finite(value) if value is None or isinstance(value, int | float) else str(value)


def sql(
    query: str,
    *,
    recordings: Recordings = None,
    runs: str = "",
    timeout: float | None = None,
    memory: int = MEMORY_MB,
    report: Tell = lambda _: None,
) -> QueryResult:
    """Ask the recorded runs in SQL; return the rows, which are read as they are asked for.

    The views are `runs`, `episodes`, `evaluations`, `scalars`, `steps`, `extras` and `marks`; each has a
    column `run`.

    Args:
        query: one SELECT in the SQL of DuckDB.
        recordings: the folder of runs, or several: $DUALTAXI_RECORDINGS, or ./recordings, by default.
        runs: a filter as of `dualtaxi ls`; the views have the runs that match it.
        timeout: the seconds after which the query is stopped.
        memory: the megabytes that DuckDB may use.
        report: called with how far the query has read, a few times a second.

    Raises:
        RunnerError: the query is wrong, or exceeds its time or memory.
        MissingExtra: DuckDB is not installed.
    """
    return QueryResult(query, SelectedRuns(recordings, parse(runs), report), timeout, memory)
