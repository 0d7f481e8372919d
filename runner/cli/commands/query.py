"""Questions about all recorded runs: `dualtaxi sql` in SQL, `dualtaxi find` for episodes."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from runner.analysis.sections import Grid
from runner.cli.command import Command, argument, option
from runner.cli.commands.ls import MAX_PROBLEMS
from runner.cli.options import folders_option, force_option, limit_option, require_one, tags_option
from runner.cli.output import Remark, Reply, path_and_size
from runner.cli.parameter_types import COUNT, FILE
from runner.cli.progress import stage_line
from runner.query.text import cell_of, csv_value
from runner.util.extras import require
from runner.util.humanize import counted
from runner.util.row_text import csv_lines, json_list

if TYPE_CHECKING:
    from runner.cli.output import Part
    from runner.query.find import Found
    from runner.query.sql import QueryResult

_SHOWN: Final = 1000
"""The most rows of a table."""
_SECONDS: Final = 600


_runs_option: Final = option("--runs", default="", metavar="FILTER", help="Runs, as for `dualtaxi ls`.")


@click.command("sql", cls=Command, forms=("csv", "json", "markdown"))
def sql_command(
    query: str = argument(metavar="QUERY"),
    runs: str = _runs_option,
    parquet: Path | None = option("--parquet", type=FILE, metavar="FILE", help="Write a file of Parquet."),
    force: bool = force_option,
    timeout: int = option(
        "--timeout", type=COUNT, default=_SECONDS, show_default=True, metavar="SECONDS", help="Limit of time."
    ),
    memory: int = option(
        "--memory", type=COUNT, default=500, show_default=True, metavar="MB", help="Limit of memory."
    ),
    recordings: tuple[Path, ...] = folders_option,
) -> Iterator[Reply]:
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
    require_one("as_csv", "as_json", "parquet")
    require("pyarrow", extra="sql", purpose="SQL")
    from runner.export.places import new_file, require_new
    from runner.query.sql import sql

    if parquet is not None:
        require_new(parquet, force)
    with _without_pandas():
        with stage_line("reading") as report:
            result = sql(
                query, recordings=recordings, runs=runs, timeout=timeout, memory=memory, report=report
            )
            if parquet is not None:
                with new_file(parquet, force) as temporary:
                    count = result.write_parquet(temporary)
                text = f"{path_and_size(parquet)}, {count:,} rows"
                yield Reply(text=[text], notes=_left_out(result))
                return
            rows, names = result.rows(), result.columns.names
            first = list(islice(rows, _SHOWN + 1))
        cells = (tuple(map(cell_of, row)) for row in first[:_SHOWN])
        more = Remark(f"Shown are the first {_SHOWN:,} rows; --csv and --json print all.")
        yield Reply(
            json_list("rows", (dict(zip(names, row, strict=True)) for row in chain(first, rows))),
            [Grid(tuple(names), [*cells]), *[more] * (len(first) > _SHOWN)],
            csv=csv_lines(names, (map(csv_value, row) for row in chain(first, rows))),
            notes=_left_out(result),
        )


class _NoPandas:
    """Finds no pandas."""

    @staticmethod
    def find_spec(name: str, *_: object) -> None:
        if name == "pandas":
            raise ModuleNotFoundError(name=name)


@contextlib.contextmanager
def _without_pandas() -> Iterator[None]:
    """Keep Arrow from loading pandas, which takes as long as a query, only to see whether it is there."""
    sys.meta_path.insert(0, _NoPandas)
    try:
        yield
    finally:
        sys.meta_path.remove(_NoPandas)


def _left_out(answered: QueryResult | Found) -> Iterator[str]:
    """Yield the first runs that were left out, once all rows are read."""
    yield from answered.left_out[:MAX_PROBLEMS]
    if len(answered.left_out) > MAX_PROBLEMS:
        yield f"Runs are left out for {len(answered.left_out) - MAX_PROBLEMS:,} more reasons."


@click.command("find", cls=Command)
def find_command(
    expression: str = argument(metavar="EXPRESSION"),
    runs: str = _runs_option,
    phase: str | None = option(
        "--phase",
        type=click.Choice(["train", "eval"]),
        help="Training or evaluation.  [default: both]",
    ),
    sort: str = option(
        "--sort",
        default="",
        metavar="NUMBER",
        help="Sort by a number, such as ret, or -ret from the highest.",
    ),
    limit: int = limit_option(20),
    mark: str | None = option(
        "--mark", metavar="TEXT", help="Mark the first step of the episodes shown, as `dualtaxi mark` does."
    ),
    tags: tuple[str, ...] = tags_option,
    quiet: bool = option(
        "-q",
        "--quiet",
        is_flag=True,
        help="Print ids only: a line RUN PHASE EPISODES for each run.",
    ),
    recordings: tuple[Path, ...] = folders_option,
) -> Reply:
    """Find the episodes of all recorded runs that match EXPRESSION.

    It is a condition in Python's syntax. Words alone are searched for in the id, name, tags and note of runs.

    Of an episode:
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
    are left out.

    Examples:
      dualtaxi find 'ret < -100 and count(collision) >= 2 and length > 50'
      dualtaxi find 'any(action == "north + east") and success' --phase eval --sort length
      dualtaxi find 'max(next_observation[2]) > 0.2' --runs 'environment == "CartPole-v1"'
      dualtaxi find 'then(pickup, drop_off, within=5)' --sort -ret --json
      dualtaxi find 'min(reward) < -15' --mark expensive --tag look-again
      dualtaxi find 'ret > 15' --phase train --quiet --limit 0
    """
    require_one("as_json", "as_markdown", "quiet")
    if tags and mark is None:
        raise click.UsageError(
            "--tag needs --mark TEXT, as it is a tag of the marks; words find the tags of runs."
        )
    require("pyarrow", extra="sql", purpose="`find`")
    from runner.query.find import find

    with _without_pandas(), stage_line("reading") as report:
        found = find(
            expression, recordings, runs=runs, phase=phase, sort=sort, limit=limit or None, report=report
        )
    marked = None if mark is None else found.mark(mark, tags=tags)
    text: list[Part] = [found.grid] if found.hits else []
    if quiet:
        text = [
            f"{run} {of_phase} {','.join(map(str, episodes))}"
            for (run, of_phase), episodes in found.episodes.items()
        ]
    text.append(Remark(found.sentence))
    if len(found.hits) < found.count:
        text.append(Remark(f"Shown are the first {len(found.hits):,}; --limit 0 shows all."))
    if marked is not None:
        had = len(found.hits) - marked
        text.append(Remark(f"Marked {counted(marked, 'episode')}; {had:,} had this mark."))
    values = found.as_json() | ({} if marked is None else {"marked": marked})
    return Reply(values, text, notes=_left_out(found))
