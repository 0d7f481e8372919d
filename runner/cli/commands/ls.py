"""`dualtaxi ls`: the recorded runs."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from runner.cli.options import filter_argument, folders_option, json_option, limit_option
from runner.cli.output import json_list, say

if TYPE_CHECKING:
    from runner.runs.catalogue.filters import Filter
    from runner.runs.catalogue.index import Index

MAX_PROBLEMS: Final = 5
"""Damaged runs whose problems are printed."""
Render = Callable[[Iterable[dict[str, Any]], Sequence[str]], Iterator[str]]

ON_A_TERMINAL: Final = 50
"""Runs that are listed there unless it is said how many."""
_PART: Final = 1 << 20
_SPOOL_BYTES: Final = 8 << 20
"""Output up to this size is kept in memory, longer output in a temporary file."""


@click.command("ls")
@filter_argument
@folders_option
@click.option(
    "--sort", default="", metavar="FIELD,...", help="Sort by these fields; -FIELD for descending order."
)
@click.option("--columns", metavar="FIELD,...", help="Show these fields.")
@limit_option(None, f"{ON_A_TERMINAL} in a terminal's table, else all")
@click.option("--offset", type=click.IntRange(min=0), default=0, metavar="N", help="Skip the first N.")
@click.option("-q", "--quiet", is_flag=True, help="Print ids only.")
@click.option("--csv", "as_csv", is_flag=True, help="Print CSV.")
@json_option
def command(
    words: tuple[str, ...],
    recordings: tuple[Path, ...],
    sort: str,
    columns: str | None,
    limit: int | None,
    offset: int,
    quiet: bool,
    as_csv: bool,
    as_json: bool,
) -> None:
    """List the runs that match FILTER, or all, newest first.

    A filter consists of words, searched for in id, name, configuration, tags and note; of FIELD:VALUE,
    FIELD:>VALUE and FIELD:[LOW TO HIGH]; of AND, OR, NOT and parentheses. Text must match as a whole, with
    the wildcards * and ?; FIELD:* matches every run that has the field. The fields:

    \b
      id name config seed status tag note created age episodes steps success_percent
      mean_length mean_penalties mean_return logged seconds bytes digest mode
      environment host git archive folder, and config.PATH for any value of the
      configuration

    Shown are the training episodes done (of those to do, where some are missing), how many percent of the
    last evaluation's trials finished, the size of the recording, how long ago the run began, and which run
    recorded the same content before; of a loop also the mean return in its last evaluation (in its last 100
    training episodes, if it has none) and the last values it logged. Some of that is left out where a
    terminal is narrow.

    \b
    Examples:
      dualtaxi ls
      dualtaxi ls tutorial NOT tag:keep
      dualtaxi ls 'status:finished config.discount:>0.9' --sort -success_percent --limit 5
      dualtaxi ls 'created:[2026-01-01 TO *] (seed:<3 OR age:<12h)' --columns id,seed,config,digest
      dualtaxi ls --quiet name:quick
    """  # noqa: D301 - Click wants the backspace itself
    from runner.cli import listing
    from runner.runs.catalogue.columns import DEFAULT_JSON, columns_of
    from runner.runs.catalogue.filters import parse

    if sum((quiet, as_csv, as_json)) > 1:
        raise click.UsageError("--quiet, --csv and --json are three ways to print; choose one.")
    chosen = parse(" ".join(words))
    shown = columns_of(columns) if columns else None
    if limit is None and not (quiet or as_csv or as_json) and sys.stdout.isatty():
        limit = ON_A_TERMINAL
    wanted = _Wanted(chosen, sort, limit or None, offset)
    if quiet or as_csv or as_json:
        columns_shown = ["id"] if quiet else shown or list(DEFAULT_JSON)
        render: Render = listing.csv_lines if as_csv else _ids if quiet else _objects
        listed, total, problems = _stream(recordings, wanted, columns_shown, render)
    else:
        rows, total = _found(recordings, wanted, shown or listing.USUAL)
        listed, problems = len(rows), [row["problem"] for row in rows if row["problem"]]
        if rows:
            shown = shown or listing.fitting(rows, listing.usual_columns(rows, len(recordings)))
            listing.print_table(rows, shown)
    _report_damage(problems)
    _tell_the_rest(listed, total, offset, chosen, recordings)


@dataclass(frozen=True)
class _Wanted:
    """Which runs are listed, in which order."""

    filter: Filter
    sort: str
    limit: int | None
    offset: int


def _ids(rows: Iterable[dict[str, Any]], columns: Sequence[str]) -> Iterator[str]:  # noqa: ARG001
    return (f"{row['id']}\n" for row in rows)


def _objects(rows: Iterable[dict[str, Any]], columns: Sequence[str]) -> Iterator[str]:
    from runner.runs.catalogue.columns import as_json

    return json_list("runs", (as_json(row, columns) for row in rows))


def _stream(
    recordings: tuple[Path, ...],
    wanted: _Wanted,
    columns: Sequence[str],
    render: Render,
) -> tuple[int, int, list[str]]:
    """Print the runs in bounded memory; return how many, how many fit the filter, and what is damaged.

    A file takes the text up first: the index is locked while it is read, and whoever reads the output may
    take their time.
    """
    import tempfile

    from runner.runs.catalogue.columns import needed_for, with_same_as
    from runner.runs.catalogue.index import look, order_of

    order = order_of(wanted.sort)
    needed = needed_for([*columns, "same_as"] if "same_as" in columns else columns)

    def work(index: Index) -> int:
        spool.seek(0)
        spool.truncate()
        problems.clear()
        rows: Iterable[dict[str, Any]]
        if wanted.limit is None:
            total = index.count(wanted.filter)
            rows = islice(index.rows(wanted.filter, *order, columns=needed), wanted.offset, None)
        else:
            rows, total = index.page(wanted.filter, *order, limit=wanted.limit, offset=wanted.offset)
        if "same_as" in columns:
            rows = with_same_as(rows, index.originals())
        spool.writelines(render(_noting_problems(rows, problems), columns))
        return total

    problems: list[str] = []
    with tempfile.SpooledTemporaryFile(_SPOOL_BYTES, "w+", encoding="utf-8", newline="") as spool:
        total = look(recordings, work, say)
        spool.seek(0)
        while part := spool.read(_PART):
            click.echo(part, nl=False)
    left = max(total - wanted.offset, 0)
    return left if wanted.limit is None else min(left, wanted.limit), total, problems


def _noting_problems(rows: Iterable[dict[str, Any]], problems: list[str]) -> Iterator[dict[str, Any]]:
    """Yield the rows, and add what is wrong with damaged ones to a list."""
    for row in rows:
        if row["problem"]:
            problems.append(row["problem"])
        yield row


def _found(
    recordings: tuple[Path, ...], wanted: _Wanted, columns: Sequence[str]
) -> tuple[list[dict[str, Any]], int]:
    """Return the rows to show, and how many fit the filter."""
    from runner.runs.catalogue.columns import needed_for
    from runner.runs.catalogue.index import look, order_of

    order, needed = order_of(wanted.sort), needed_for([*columns, "same_as"])

    def work(index: Index) -> tuple[list[dict[str, Any]], int]:
        rows, total = index.page(
            wanted.filter, *order, limit=wanted.limit, offset=wanted.offset, columns=needed
        )
        return index.with_same_as(rows), total

    return look(recordings, work, say)


def _report_damage(problems: Sequence[str]) -> None:
    """Print what is wrong with the damaged runs among those that are shown."""
    for problem in problems[:MAX_PROBLEMS]:
        say(f"{problem[:1].upper()}{problem[1:]}")
    if len(problems) > MAX_PROBLEMS:
        say(f"{len(problems) - MAX_PROBLEMS:,} more runs are damaged: `dualtaxi ls status:damaged`.")


def _tell_the_rest(
    listed: int, total: int, offset: int, chosen: Filter, recordings: tuple[Path, ...]
) -> None:
    """Say what is not shown, and why nothing is."""
    folders = ", ".join(map(str, recordings))
    if listed < total:
        behind = offset + listed
        more = f", --offset {behind} the next" if listed > 0 and behind < total else ""
        say(f"Shown are {listed:,} of {total:,} runs; --limit 0 shows all{more}.")
    elif not listed and chosen.condition is not None:
        say(f"No run in {folders} fits.")
    elif not listed:
        say(f"No runs in {folders} yet. `dualtaxi run CONFIG` makes one.")
