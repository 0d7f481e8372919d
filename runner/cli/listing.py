"""Rows of the catalogue, shown: as a table, as CSV."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Final

import click

from runner.cli.output import console, draw, table
from runner.runs.catalogue.columns import FIELDS, HEADINGS, Kind, as_json, as_text

USUAL: Final = (
    *("id", "name", "config", "seed", "status", "tag", "episodes", "success_percent", "mean_return"),
    *("logged", "bytes", "age", "same_as", "folder"),
)
"""The columns that people want to see, where they tell something."""
_NARROWEST: Final = 14
"""The width at which a shrinking column can still be read."""
_MISSED: Final = ("config", "logged", "bytes", "episodes", "seed", "folder", "age")
_LEFT: Final = (Kind.START, Kind.TEXT, Kind.STATUS, Kind.PROSE, Kind.TAGS, Kind.DATE)
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


def csv_lines(rows: Iterable[dict[str, Any]], columns: Sequence[str]) -> Iterator[str]:
    """Yield rows as lines of CSV, after a heading.

    Several tags are separated by blanks, logged values are a JSON object.
    """
    import csv
    import io

    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")

    def line(cells: Iterable[Any]) -> str:
        text.seek(0)
        text.truncate()
        writer.writerow(cells)
        return text.getvalue()

    yield line(columns)
    for row in rows:
        told = as_json(row, columns).values()
        yield line(_csv_cell(item) for item in told)


def _csv_cell(item: Any) -> Any:
    if isinstance(item, list):
        return " ".join(item)
    return json.dumps(item) if isinstance(item, dict) else item


def usual_columns(rows: Sequence[dict[str, Any]], folders: int) -> list[str]:
    """Return the columns that people want to see, less those that tell nothing here."""
    telling = {
        "config": any(row["name"] != row["config"] for row in rows),
        "tag": any(row["tags"] for row in rows),
        "same_as": any(row["same_as"] for row in rows),
        "folder": folders > 1,
        "success_percent": any(row["success_percent"] is not None for row in rows)
        or all(row["mean_return"] is None for row in rows),
        "mean_return": any(row["mean_return"] is not None for row in rows),
        "logged": any(row["logged"] != "{}" for row in rows),
    }
    return [column for column in USUAL if telling.get(column, True)]


def print_table(rows: Sequence[dict[str, Any]], columns: Sequence[str]) -> None:
    """Print rows as a table; fitted to the terminal, if there is one, but ids are never cut."""
    headings = [HEADINGS.get(column, column) for column in columns]
    left = [column not in FIELDS or FIELDS[column].kind in _LEFT for column in columns]
    cells = [[printable(as_text(row, column)) for column in columns] for row in rows]
    if not console().is_terminal:
        click.echo("\n".join(aligned([headings, *cells], left)))
        return
    left_headings = tuple(heading for heading, is_left in zip(headings, left, strict=True) if is_left)
    drawn = table(*headings, left=left_headings, shrinking=_SHRINKING)
    for line in cells:
        drawn.add_row(*line)
    draw(drawn)


def fitting(rows: Sequence[dict[str, Any]], columns: Sequence[str]) -> list[str]:
    """Return the columns that fit a terminal, less those that can best be missed where it is narrow."""
    kept, drawn = list(columns), console()
    widths = {
        column: max(
            len(HEADINGS.get(column, column)), *(len(printable(as_text(row, column))) for row in rows)
        )
        + 2
        for column in columns
    }
    for column in _SHRINKING:
        widths[column] = min(widths.get(column, 0), _NARROWEST)
    for column in _MISSED:
        if drawn.is_terminal and column in kept and sum(map(widths.__getitem__, kept)) > drawn.width:
            kept.remove(column)
    return kept


def aligned(lines: Sequence[Sequence[str]], left: Sequence[bool]) -> list[str]:
    """Return lines of cells in columns: where there is no terminal to fit, and may be very many."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    ways = list(zip(widths, left, strict=True))
    return [
        "  ".join(
            cell.ljust(width) if is_left else cell.rjust(width)
            for cell, (width, is_left) in zip(line, ways, strict=True)
        ).rstrip()
        for line in lines
    ]


def printable(text: str) -> str:
    """Return a text on one line, without what would move a terminal's cursor or change its colours."""
    return "".join(character if character.isprintable() else " " for character in text)
