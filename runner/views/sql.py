"""`sql`: all recorded runs, and every step of them, asked in SQL."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Final

from runner.analysis.sections import Answer, Grid, Section
from runner.query.text import cell_of, csv_value, reasons_in_words, without_pandas
from runner.util.extras import require
from runner.util.humanize import counted, size
from runner.util.row_text import csv_lines, json_list
from runner.views.view import NO_PROGRESS, ONLY_HERE, ShownProgress, View, view_input

if TYPE_CHECKING:
    from runner.query.sql import QueryResult
    from runner.util.values import Json

_SHOWN: Final = 1000
"""The most rows of a table."""
_SECONDS: Final = 600
_MEGABYTES: Final = 500


class Rows(Answer):
    """The rows of a query, which are read once: as lines, a table or a file."""

    def __init__(self, result: QueryResult, say: Callable[[str], None]) -> None:
        self._result, self._say = result, say
        rows, names = result.rows(), result.columns.names
        self.lines = {
            "json": json_list("rows", (dict(zip(names, row, strict=True)) for row in rows)),
            "csv": csv_lines(names, (map(csv_value, row) for row in rows)),
        }
        self.remarks = reasons_in_words(result)

    def as_json(self) -> Json:
        """Return an empty object: the rows are printed by `lines`."""
        return {}

    def sections(self) -> Iterator[Section]:
        """Yield a table of the first rows."""
        rows = [tuple(map(cell_of, row)) for row in islice(self._result.rows(), _SHOWN + 1)]
        yield Section("", grids=[Grid(tuple(self._result.columns.names), rows[:_SHOWN])])
        if len(rows) > _SHOWN:
            self._say(f"Shown are the first {_SHOWN:,} rows; --csv and --json print all.")

    def write(self, stream: BinaryIO) -> None:
        """Write the rows as Parquet."""
        rows = counted(self._result.write_parquet(stream), "row")
        self.contents = f"{size(stream.tell())}, {rows}"


def sql(
    folders: tuple[Path, ...],
    query: str = view_input(
        "query",
        "One SELECT in the SQL of DuckDB.",
        required=True,
        max_length=10_000,
        label="Query",
        placeholder="SELECT config, avg(success_percent), avg(mean_return) FROM runs GROUP BY ALL",
    ),
    runs: str = ONLY_HERE,
    timeout: int = view_input(
        "timeout",
        f"Limit of time.  [default: {_SECONDS}]",
        kind=int,
        default=_SECONDS,
        minimum=1,
        metavar="SECONDS",
    ),
    memory: int = view_input(
        "memory",
        f"Limit of memory.  [default: {_MEGABYTES}]",
        kind=int,
        default=_MEGABYTES,
        minimum=1,
        metavar="MB",
    ),
    progress: ShownProgress = NO_PROGRESS,
) -> Rows:
    """Ask the recorded runs, and every step of them, by one SELECT in the SQL of DuckDB.

    Each view has a column `run`, the id of the run.

    Views:
      runs         a row for each run, as `dualtaxi ls` lists it; `settings` is its configuration as JSON
      evaluations  a row for each evaluation: mean_return, success_percent, mean_length, ...
      episodes     a row for each episode that ended: phase, episode, length, return, n_EVENT, ...
      steps        a row for each step: phase, step, episode, t, state, action, reward, observation_0, ...
      extras       a row for each step with values of a loop's own: phase, step, extra_NAME
      scalars      a row for each value that a loop logged: phase, step, episode, name, value
      marks        a row for each mark: ref, phase, episode, t, text, tags

    `DESCRIBE steps` lists columns; a run without a column has NULL there. Steps are read where they are
    stored, in recordings and archives: conditions on run, phase, episode, step and position keep a query
    from reading the rest, and --runs from opening other runs. A query reads no files and writes nothing.

    Examples:
      dualtaxi sql 'SELECT config, avg(success_percent), avg(mean_return) FROM runs GROUP BY ALL'
      dualtaxi sql 'SELECT run, max(length) FROM episodes GROUP BY run' --runs 'age < "7d"'
      dualtaxi sql 'SELECT state, action, count(*) FROM steps GROUP BY ALL' --parquet visits.parquet
    """
    require("pyarrow", extra="sql", purpose="SQL")
    from runner.query import sql as questions

    with without_pandas(), progress.stage("reading") as report:
        return Rows(
            questions.sql(
                query, recordings=folders, runs=runs, timeout=timeout, memory=memory, report=report
            ),
            progress.say,
        )


VIEW: Final = View(
    "sql",
    "SQL",
    sql,
    subject="folders",
    button="Ask",
    lead="One SELECT in the SQL of DuckDB. Each view has a column `run`; `DESCRIBE steps` lists the columns "
    "of `steps`.",
    list_title="Views",
    forms=("csv", "json", "markdown"),
    file_ending=".parquet",
    file_flags=("--parquet",),
    file_help="Write a file of Parquet.",
)
