"""`dualtaxi ls`: the recorded runs as a table, ids, CSV or JSON."""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import click

from runner.cli.command import Command, option
from runner.cli.options import filter_argument, folders_option, json_option, limit_option
from runner.cli.output import aligned, console, csv_lines, draw, echo, json_list, on_one_line, say, table
from runner.cli.parameter_types import INDEX
from runner.runs.catalogue.columns import (
    DEFAULT_JSON,
    FIELDS,
    HEADINGS,
    LEFT_KINDS,
    as_json,
    as_text,
    columns_of,
    needed_for,
    with_same_as,
)
from runner.util.humanize import capitalised
from runner.util.values import Json

if TYPE_CHECKING:
    from runner.runs.catalogue.filters import Filter
    from runner.runs.catalogue.index import CatalogueIndex

MAX_PROBLEMS: Final = 5
"""Damaged runs whose problems are printed."""
ON_A_TERMINAL: Final = 50
"""Runs listed on a terminal by default."""
_READ_BYTES: Final = 1 << 20
_SPOOL_BYTES: Final = 8 << 20
"""Output up to this size is kept in memory, longer output in a temporary file."""

_DEFAULT_COLUMNS: Final = (
    "id",
    "name",
    "config",
    "seed",
    "status",
    "tag",
    "episodes",
    "success_percent",
    "mean_return",
    "logged",
    "bytes",
    "age",
    "same_as",
    "parent",
    "folder",
)
"""Columns of the table, unless they hold nothing of interest."""
_OPTIONAL: Final = ("config", "logged", "bytes", "episodes", "seed", "folder", "age")
"""Columns left out where a terminal is narrow, in this order."""
_SHRINKING: Final = (
    "name",
    "config",
    "tags",
    "note",
    "logged",
    "environment",
    "host",
    "archive",
    "folder",
    "path",
)
_MIN_WIDTH: Final = 14
"""The width at which a shrinking column can still be read."""

Row = Json
Render = Callable[[Iterable[Row], Sequence[str]], Iterator[str]]


class _Query(NamedTuple):
    """Which runs are listed, in which order."""

    filter: Filter
    sort: str
    limit: int | None
    offset: int


@click.command("ls", cls=Command)
def ls_command(
    words: tuple[str, ...] = filter_argument,
    recordings: tuple[Path, ...] = folders_option,
    sort: str = option(
        "--sort", default="", metavar="FIELD,...", help="Sort by these fields; -FIELD for descending order."
    ),
    columns: str | None = option("--columns", metavar="FIELD,...", help="Show these fields."),
    limit: int | None = limit_option(f"{ON_A_TERMINAL} in a terminal's table, else all"),
    offset: int = option("--offset", type=INDEX, default=0, metavar="N", help="Skip the first N."),
    quiet: bool = option("-q", "--quiet", is_flag=True, help="Print ids only."),
    as_csv: bool = option("--csv", is_flag=True, help="Print CSV."),
    as_json: bool = json_option,
) -> None:
    """List the runs that match FILTER, or all, newest first.

    A filter is a list of words, searched for in id, name, configuration, tags and note, or a condition in
    Python's syntax: comparisons of fields, "TEXT" in FIELD, FIELD in ("A", "B"), like(FIELD, "A*"),
    FIELD is None, and, or, not, arithmetic, max(), min(), abs(). The fields:

    \b
      id name config seed status tag note created age episodes steps success_percent
      mean_length mean_penalties mean_return logged seconds bytes digest parent mode
      environment host git archive folder, and config.PATH for any value of the
      configuration

    The table shows the training episodes done (and to do, if some are missing), the percentage of the last
    evaluation's trials that succeeded, the size of the recording, how long ago the run began, which run
    recorded the same content before, and which run it is a branch of. For a loop it also shows the mean
    return in its last evaluation (in its last 100 training episodes, if it has none) and the last values that
    it logged. A narrow terminal has fewer columns.

    Examples:
      dualtaxi ls
      dualtaxi ls tutorial
      dualtaxi ls 'status == "finished" and config.discount > 0.9' --sort -success_percent --limit 5
      dualtaxi ls 'created >= "2026-01-01" and (seed < 3 or age < "12h")' --columns id,seed,config,digest
      dualtaxi ls --quiet '"tutorial" and "keep" not in tags'
    """  # noqa: D301 - Click's mark for preformatted text
    from runner.runs.catalogue.filters import parse

    if sum((quiet, as_csv, as_json)) > 1:
        raise click.UsageError("--quiet, --csv and --json exclude each other: choose one.")
    chosen = parse(" ".join(words))
    shown = columns_of(columns) if columns else None
    render: Render | None = _ids if quiet else _csv_lines if as_csv else _objects if as_json else None
    if limit is None and render is None and sys.stdout.isatty():
        limit = ON_A_TERMINAL
    query = _Query(chosen, sort, limit or None, offset)
    if render is not None:
        columns_shown = ["id"] if quiet else shown or list(DEFAULT_JSON)
        listed, total, problems = _stream(recordings, query, columns_shown, render)
    else:
        rows, total = _page(recordings, query, shown or _DEFAULT_COLUMNS)
        listed, problems = len(rows), [row["problem"] for row in rows if row["problem"]]
        if rows:
            _print_table(rows, shown or _fitting(rows, _informative(rows, len(recordings))))
    for problem in problems[:MAX_PROBLEMS]:
        say(capitalised(problem))
    if len(problems) > MAX_PROBLEMS:
        say(f"{len(problems) - MAX_PROBLEMS:,} more runs are damaged: `dualtaxi ls 'status == \"damaged\"'`.")
    _print_remainder(listed, total, offset, chosen, recordings)


# --- reading ----------------------------------------------------------------------------------------------


def _stream(
    recordings: tuple[Path, ...], query: _Query, columns: Sequence[str], render: Render
) -> tuple[int, int, list[str]]:
    """Print runs in bounded memory; return how many, how many match, and the problems of damaged ones.

    The text goes to a temporary file first: the index is locked while it is read, and the reader of the
    output may be slow.
    """
    from runner.runs.catalogue.index import look, order_of

    order = order_of(query.sort)
    needed = needed_for([*columns, "same_as"] if "same_as" in columns else columns)
    problems: list[str] = []

    def with_problems(rows: Iterable[Row]) -> Iterator[Row]:
        for row in rows:
            problems.extend([row["problem"]] if row["problem"] else [])
            yield row

    def work(index: CatalogueIndex) -> int:
        spool.seek(0)
        spool.truncate()
        problems.clear()
        rows: Iterable[Row]
        if query.limit is None:
            total = index.count(query.filter)
            rows = islice(index.rows(query.filter, *order, columns=needed), query.offset, None)
        else:
            rows, total = index.page(query.filter, *order, limit=query.limit, offset=query.offset)
        if "same_as" in columns:
            rows = with_same_as(rows, index.originals())
        spool.writelines(render(with_problems(rows), columns))
        return total

    with tempfile.SpooledTemporaryFile(_SPOOL_BYTES, "w+", encoding="utf-8", newline="") as spool:
        total = look(recordings, work, say)
        spool.seek(0)
        while part := spool.read(_READ_BYTES):
            echo(part, nl=False)
    left = max(total - query.offset, 0)
    return left if query.limit is None else min(left, query.limit), total, problems


def _page(recordings: tuple[Path, ...], query: _Query, columns: Sequence[str]) -> tuple[list[Row], int]:
    """Return the rows to show, and how many match."""
    from runner.runs.catalogue.index import look, order_of

    order, needed = order_of(query.sort), needed_for([*columns, "same_as"])

    def work(index: CatalogueIndex) -> tuple[list[Row], int]:
        rows, total = index.page(query.filter, *order, limit=query.limit, offset=query.offset, columns=needed)
        return index.with_same_as(rows), total

    return look(recordings, work, say)


# --- printing ---------------------------------------------------------------------------------------------


def _ids(rows: Iterable[Row], _columns: Sequence[str]) -> Iterator[str]:
    return (f"{row['id']}\n" for row in rows)


def _objects(rows: Iterable[Row], columns: Sequence[str]) -> Iterator[str]:
    return json_list("runs", (as_json(row, columns) for row in rows))


def _csv_lines(rows: Iterable[Row], columns: Sequence[str]) -> Iterator[str]:
    """Return lines of CSV after a heading; tags are separated by blanks, logged values are a JSON object."""

    def cell(value: object) -> object:
        return (
            " ".join(value)
            if isinstance(value, list)
            else json.dumps(value)
            if isinstance(value, dict)
            else value
        )

    return csv_lines(columns, (map(cell, as_json(row, columns).values()) for row in rows))


def _informative(rows: Sequence[Row], folders: int) -> list[str]:
    """Return the default columns without those that hold nothing of interest here."""
    has_success = any(row["success_percent"] is not None for row in rows)
    has_return = any(row["mean_return"] is not None for row in rows)
    is_informative = {
        "config": any(row["name"] != row["config"] for row in rows),
        "tag": any(row["tags"] for row in rows),
        "same_as": any(row["same_as"] for row in rows),
        "parent": any(row["parent"] for row in rows),
        "folder": folders > 1,
        "success_percent": has_success or not has_return,
        "mean_return": has_return,
        "logged": any(row["logged"] != "{}" for row in rows),
    }
    return [column for column in _DEFAULT_COLUMNS if is_informative.get(column, True)]


def _fitting(rows: Sequence[Row], columns: Sequence[str]) -> list[str]:
    """Return the columns that fit the terminal."""
    fitting, terminal = list(columns), console()
    widths = {
        column: 2 + max(len(HEADINGS.get(column, column)), *(len(_cell(row, column)) for row in rows))
        for column in columns
    }
    for column in _SHRINKING:
        widths[column] = min(widths.get(column, 0), _MIN_WIDTH)
    for column in _OPTIONAL:
        if (
            terminal.is_terminal
            and column in fitting
            and sum(map(widths.__getitem__, fitting)) > terminal.width
        ):
            fitting.remove(column)
    return fitting


def _print_table(rows: Sequence[Row], columns: Sequence[str]) -> None:
    """Print a table, fitted to the terminal if there is one; ids are never truncated."""
    headings = [HEADINGS.get(column, column) for column in columns]
    left = [column not in FIELDS or FIELDS[column].kind in LEFT_KINDS for column in columns]
    cells = [[_cell(row, column) for column in columns] for row in rows]
    if not console().is_terminal:
        echo("\n".join(aligned([headings, *cells], left)))
        return
    left_headings = tuple(heading for heading, is_left in zip(headings, left, strict=True) if is_left)
    draw(table(*headings, rows=cells, left=left_headings, shrinking=_SHRINKING))


def _cell(row: Row, column: str) -> str:
    return on_one_line(as_text(row, column))


def _print_remainder(
    listed: int, total: int, offset: int, chosen: Filter, recordings: tuple[Path, ...]
) -> None:
    """Print how many matching runs are not listed, or why none is."""
    folders = ", ".join(map(str, recordings))
    if listed < total:
        end = offset + listed
        more = f", --offset {end} the next" if listed > 0 and end < total else ""
        say(f"Shown are {listed:,} of {total:,} runs; --limit 0 shows all{more}.")
    elif not listed and chosen.condition is not None:
        say(f"No run in {folders} matches.")
    elif not listed:
        say(f"No runs in {folders} yet. `dualtaxi run CONFIG` makes one.")
