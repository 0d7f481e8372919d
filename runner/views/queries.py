"""Views that search all recorded runs: their episodes by an expression, every step of them in SQL."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Final

from runner.analysis.sections import Answer, Grid, Section
from runner.errors import ConfigError
from runner.util.extras import require, without_pandas
from runner.util.humanize import counted, first_remarks, size
from runner.util.row_text import cell_of, csv_lines, csv_value, json_list
from runner.views.view import NO_PROGRESS, ONLY_HERE, PHASES, ReadyAnswer, ShownProgress, View, view_input

if TYPE_CHECKING:
    from runner.query.find import Found
    from runner.query.sql import QueryResult
    from runner.util.values import Json

MAX_ROWS: Final = 1000
"""The most rows of a printed table of a query, and of an answer of the service."""
MAX_QUERY: Final = 10_000
"""The most characters of a query in SQL."""


def _reasons(answered: QueryResult | Found) -> Iterator[str]:
    """Yield why the first runs were left out, once all rows are read."""
    yield from first_remarks(answered.left_out, "Runs are left out for {} more reasons.")


def find(
    folders: tuple[Path, ...],
    expression: str = view_input(
        "expression",
        "A condition on episodes.",
        required=True,
        label="Episodes",
        placeholder="ret < -100 and count(collision) >= 2 and length > 50",
    ),
    runs: str = ONLY_HERE,
    phase: str | None = view_input(
        "phase",
        "Training or evaluation.  [default: both]",
        values=PHASES,
        label="Phase",
        placeholder="both",
    ),
    sort: str = view_input(
        "sort",
        "Sort by a number, such as ret, or -ret from the highest.",
        default="",
        metavar="NUMBER",
        label="Sort by",
        placeholder="newest run; or -ret",
    ),
    limit: int = view_input(
        "limit",
        "Maximum number of rows, 0 for all.  [default: 20]",
        kind=int,
        default=20,
        maximum=MAX_ROWS,
        label="Show at most",
        placeholder=f"0 to {MAX_ROWS:,}; 0 shows {MAX_ROWS:,}",
    ),
    mark: str | None = view_input(
        "mark", "Mark the first step of the episodes shown, as `dualtaxi mark` does.", metavar="TEXT"
    ),
    tags: Sequence[str] = ONLY_HERE,
    progress: ShownProgress = NO_PROGRESS,
) -> ReadyAnswer:
    """Find the episodes of all recorded runs that match EXPRESSION.

    It is a condition in Python's syntax. Words alone are searched for in the id, name, tags and note of runs.

    What the condition may contain:
      ret, ret.taxi_1, length          sum of rewards, or of an agent's rewards; number of steps
      success, terminated, truncated   how it ended
      any(C), all(C), never(C)         whether a condition holds at some, every or no step
      count(C)                         at how many steps it holds
      then(C, D, within=5)             whether D holds at most 5 steps after C
      min(V), max(V), sum(V), first(V), last(V)    of a value over the steps

    Of a step, in these functions: reward, t, state, next_state, next_observation[0], action, which is
    compared with its name or number; events such as collision, taxi_1.pickup, or pickup for any agent;
    explored; extra.NAME, a value that the loop recorded with the step. They are the columns of steps and
    extras that `dualtaxi sql` has.

    An index of episodes in the cache answers most of it; it is made when a run is first searched. Only the
    steps of episodes that the index cannot decide are read. Runs without a column that the expression names
    are left out. --quiet prints a line RUN PHASE EPISODES for each run.

    Examples:
      dualtaxi find 'ret < -100 and count(collision) >= 2 and length > 50'
      dualtaxi find 'any(action == "north + east") and success' --phase eval --sort length
      dualtaxi find 'max(next_observation[2]) > 0.2' --runs 'environment == "CartPole-v1"'
      dualtaxi find 'then(pickup, drop_off, within=5)' --sort -ret --json
      dualtaxi find 'min(reward) < -15' --mark expensive --tag look-again
      dualtaxi find 'ret > 15' --phase train --quiet --limit 0
    """
    if tags and mark is None:
        raise ConfigError(
            "--tag needs --mark TEXT, as it is a tag of the marks; words find the tags of runs."
        )
    require("pyarrow", extra="sql", purpose="`find`")
    from runner.query import find as query

    with without_pandas(), progress.stage("reading") as report:
        result = query.find(
            expression, folders, runs=runs, phase=phase, sort=sort, limit=limit or None, report=report
        )
    marked = None if mark is None else result.mark(mark, tags=tags)

    def say_how_many() -> None:
        progress.say(result.sentence)
        if len(result.hits) < result.count:
            progress.say(f"Showing the first {len(result.hits):,}; --limit 0 shows all.")
        if marked is not None:
            had = sum(bool(hit.replay) for hit in result.hits) - marked
            progress.say(f"Marked {counted(marked, 'episode')}; {had:,} had this mark.")

    def sections() -> Iterator[Section]:
        if result.hits:
            yield Section("", grids=[result.grid])
        say_how_many()

    def lines() -> Iterator[str]:
        for (run, of_phase), episodes in result.episodes.items():
            yield f"{run} {of_phase} {','.join(map(str, episodes))}\n"
        say_how_many()

    data = result.as_json() | ({} if marked is None else {"marked": marked})
    return ReadyAnswer(data, sections(), lines={"quiet": lines()}, remarks=_reasons(result))


FIND: Final = View(
    "find",
    "Find episodes",
    find,
    subject="folders",
    button="Find",
    lead="A condition on episodes. C and D are conditions on a step, and V is a value of a step: `reward`, "
    "`t`, `action`, `state`, `next_state`, `next_observation[0]`, `extra.NAME`, `explored`, or an event such "
    "as `collision` or `taxi_1.pickup`.",
    list_title="What the condition may contain",
    forms=("quiet", "json", "markdown"),
)


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
        self.remarks = _reasons(result)

    def as_json(self) -> Json:
        """Return an empty object: the rows are printed by `lines`."""
        return {}

    def sections(self) -> Iterator[Section]:
        """Yield a table of the first rows."""
        rows = [tuple(map(cell_of, row)) for row in islice(self._result.rows(), MAX_ROWS + 1)]
        yield Section("", grids=[Grid(tuple(self._result.columns.names), rows[:MAX_ROWS])])
        if len(rows) > MAX_ROWS:
            self._say(f"Showing the first {MAX_ROWS:,} rows; --csv and --json print all.")

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
        max_length=MAX_QUERY,
        lines=4,
        label="Query",
        placeholder="SELECT config, avg(success_percent), avg(mean_return) FROM runs GROUP BY ALL",
    ),
    runs: str = ONLY_HERE,
    timeout: int = view_input(
        "timeout",
        f"Time limit.  [default: {_SECONDS}]",
        kind=int,
        default=_SECONDS,
        minimum=1,
        metavar="SECONDS",
    ),
    memory: int = view_input(
        "memory",
        f"Memory limit.  [default: {_MEGABYTES}]",
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
      extras       a row for each step with values that a loop recorded: phase, step, extra_NAME
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


SQL: Final = View(
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
    file_help="Write a Parquet file.",
)
