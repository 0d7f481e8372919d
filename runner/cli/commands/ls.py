"""`dualtaxi ls`: the recorded runs."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from runner.cli.options import filter_argument, folders_option, json_option
from runner.cli.output import print_json, say

if TYPE_CHECKING:
    from runner.catalogue.filters import Filter
    from runner.catalogue.index import Index

MAX_PROBLEMS: Final = 5
"""Damaged runs whose problems are printed."""
ON_A_TERMINAL: Final = 50
"""Runs that are listed there unless it is said how many."""


@click.command("ls")
@filter_argument
@folders_option
@click.option("--sort", default="", metavar="FIELD,...", help="By these fields; -FIELD: the largest first.")
@click.option("--columns", metavar="FIELD,...", help="Show these fields.")
@click.option(
    "--limit",
    type=click.IntRange(min=0),
    metavar="N",
    help=f"At most so many runs, 0 for all.  [default: {ON_A_TERMINAL} in a terminal's table, else all]",
)
@click.option("--offset", type=click.IntRange(min=0), default=0, metavar="N", help="Leave out the first N.")
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
    """List the runs that fit FILTER, or all, the newest first.

    A filter is of words, looked for in id, name, configuration, tags and note; of FIELD:VALUE, FIELD:>VALUE
    and FIELD:[LOW TO HIGH]; of AND, OR, NOT and parentheses. Text is compared as a whole, * and ? stand for
    any; FIELD:* is: known. The fields:

    \b
      id name config seed status tag note created age episodes steps finish_percent
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
      dualtaxi ls 'status:finished config.discount:>0.9' --sort -finish_percent --limit 5
      dualtaxi ls 'created:[2026-01-01 TO *] (seed:<3 OR age:<12h)' --columns id,seed,config,digest
      dualtaxi ls --quiet name:quick
    """  # noqa: D301 - Click wants the backspace itself
    from runner.catalogue.columns import PROGRAMS, columns_of
    from runner.catalogue.columns import as_json as told
    from runner.catalogue.filters import parse
    from runner.cli import listing

    if sum((quiet, as_csv, as_json)) > 1:
        raise click.UsageError("--quiet, --csv and --json are three ways to print; choose one.")
    chosen = parse(" ".join(words))
    shown = columns_of(columns) if columns else None
    if limit is None and not (quiet or as_csv or as_json) and sys.stdout.isatty():
        limit = ON_A_TERMINAL
    rows, total = _found(recordings, chosen, sort, limit, offset)
    if quiet:
        click.echo("".join(f"{row['id']}\n" for row in rows), nl=False)
    elif as_json:
        print_json([told(row, shown or PROGRAMS) for row in rows])
    elif as_csv:
        listing.print_csv(rows, shown or PROGRAMS)
    elif rows:
        usual = listing.usual_columns(rows, len(recordings))
        listing.print_table(rows, shown or listing.fitting(rows, usual))
    _report_damage(rows)
    _tell_the_rest(rows, total, offset, chosen, recordings)


def _found(
    recordings: tuple[Path, ...], chosen: Filter, sort: str, limit: int | None, offset: int
) -> tuple[list[dict[str, Any]], int]:
    """Return the rows to show, and how many fit the filter."""
    from runner.catalogue.columns import with_originals
    from runner.catalogue.index import look, order_of

    order = order_of(sort)

    def work(index: Index) -> tuple[list[dict[str, Any]], int]:
        rows, total = index.page(chosen, *order, limit=limit or None, offset=offset)
        return with_originals(rows, index), total

    return look(recordings, work, say)


def _report_damage(rows: list[dict[str, Any]]) -> None:
    """Print what is wrong with the damaged runs among those that are shown."""
    problems = [row["problem"] for row in rows if row["problem"]]
    for problem in problems[:MAX_PROBLEMS]:
        say(f"{problem[:1].upper()}{problem[1:]}")
    if len(problems) > MAX_PROBLEMS:
        say(f"{len(problems) - MAX_PROBLEMS:,} more runs are damaged: `dualtaxi ls status:damaged`.")


def _tell_the_rest(
    rows: list[dict[str, Any]], total: int, offset: int, chosen: Filter, recordings: tuple[Path, ...]
) -> None:
    """Say what is not shown, and why nothing is."""
    folders = ", ".join(map(str, recordings))
    if len(rows) < total:
        behind = offset + len(rows)
        more = f", --offset {behind} the next" if len(rows) > 0 and behind < total else ""
        say(f"Shown are {len(rows):,} of {total:,} runs; --limit 0 shows all{more}.")
    elif not rows and chosen.condition is not None:
        say(f"No run in {folders} fits.")
    elif not rows:
        say(f"No runs in {folders} yet. `dualtaxi run CONFIG` makes one.")
