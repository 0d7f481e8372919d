"""Rows of the catalogue, shown: as a table, as JSON, as CSV."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from runner.catalogue.fields import FIELDS, SETTING, Kind, field_of
from runner.cli.output import UNKNOWN, age, console, draw, duration, number, size, table
from runner.errors import RunnerError
from runner.runs import RECORDING_FILE

if TYPE_CHECKING:
    from runner.catalogue.index import Index

MADE: Final = ("same_as", "path")
"""Columns that are no fields: the run that recorded the same content first, and the recording's path."""
PROGRAMS: Final = (
    *("run_id", "name", "config", "seed", "status", "tags", "note", "created"),
    *("episodes", "episodes_to_do", "train_steps", "eval_steps", "seconds"),
    *("finish_percent", "mean_length", "mean_penalties", "bytes", "content_digest", "same_as"),
    *("mode", "environment", "host", "git", "archive", "path"),
)
"""What programs are told of a run, unless they ask for other columns."""
_FIELD_OF: Final = {"run_id": "id", "tags": "tag", "content_digest": "digest"}
_HEADINGS: Final = {"finish_percent": "finished %", "bytes": "size", "tag": "tags", "same_as": "same as"}
_NARROWEST: Final = 14
"""The width at which a shrinking column can still be read."""
_MISSED: Final = ("config", "bytes", "episodes", "seed", "folder", "age")
_OFTEN_EMPTY: Final = ("tag", "same_as", "note", "archive")
_LEFT: Final = (Kind.START, Kind.TEXT, Kind.STATUS, Kind.PROSE, Kind.TAGS, Kind.DATE)
_SHRINKING: Final = ("name", "config", "tags", "note", "environment", "host", "archive", "folder", "path")


def columns_of(text: str) -> list[str]:
    """Return the columns that a list of names, separated by commas, asks for.

    Raises:
        RunnerError: there is no such column.
    """
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names:
        raise RunnerError("--columns: found nothing, expected names such as id,name,finish_percent.")
    return [name if name in MADE or name.startswith(SETTING) else field_of(name).name for name in names]


def with_originals(rows: list[dict[str, Any]], index: Index) -> list[dict[str, Any]]:
    """Return rows with `same_as`: the id of another run that recorded the same content first, or None."""
    originals = index.originals()
    for row in rows:
        first = originals.get(row["digest"])
        elsewhere = first is not None and first[:2] != (row["root"], row["entry"])
        row["same_as"] = first[2] if first and elsewhere else None
    return rows


def value(row: dict[str, Any], column: str) -> Any:
    """Return what programs are told of a run in a column."""
    name = _FIELD_OF.get(column, column)
    if name.startswith(SETTING):
        return json.loads(row["settings"]).get(name.removeprefix(SETTING))
    match name:
        case "tag":
            return row["tags"].split()
        case "created":
            return _moment(row).isoformat(timespec="milliseconds")
        case "age":
            return round((datetime.now(UTC) - _moment(row)).total_seconds())
        case "path":
            return str(Path(row["root"], row["entry"], RECORDING_FILE))
    return row[FIELDS[name].column or name] if name in FIELDS else row[name]


def as_json(row: dict[str, Any], columns: Sequence[str] = PROGRAMS) -> dict[str, Any]:
    """Return what programs are told of a run, by column."""
    return {column: value(row, column) for column in columns}


def print_csv(rows: Sequence[dict[str, Any]], columns: Sequence[str]) -> None:
    """Print rows as CSV on stdout, with a heading; several tags are separated by blanks."""
    import csv
    import io

    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in rows:
        told = as_json(row, columns).values()
        writer.writerow([" ".join(item) if isinstance(item, list) else item for item in told])
    click.echo(text.getvalue(), nl=False)


def usual_columns(rows: Sequence[dict[str, Any]], folders: int) -> list[str]:
    """Return the columns that people want to see, less those that tell nothing here."""
    telling = {
        "config": any(row["name"] != row["config"] for row in rows),
        "tag": any(row["tags"] for row in rows),
        "same_as": any(row["same_as"] for row in rows),
        "folder": folders > 1,
    }
    usual = ("id", "name", "config", "seed", "status", "tag", "episodes", "finish_percent", "bytes", "age")
    return [column for column in (*usual, "same_as", "folder") if telling.get(column, True)]


def print_table(rows: Sequence[dict[str, Any]], columns: Sequence[str]) -> None:
    """Print rows as a table; fitted to the terminal, if there is one, but ids are never cut."""
    headings = [_HEADINGS.get(column, column) for column in columns]
    left = [column not in FIELDS or FIELDS[column].kind in _LEFT for column in columns]
    cells = [[_cell(row, column) for column in columns] for row in rows]
    if not console().is_terminal:
        click.echo("\n".join(_aligned([headings, *cells], left)))
        return
    aligned = tuple(heading for heading, is_left in zip(headings, left, strict=True) if is_left)
    drawn = table(*headings, left=aligned, shrinking=_SHRINKING)
    for line in cells:
        drawn.add_row(*line)
    draw(drawn)


def fitting(rows: Sequence[dict[str, Any]], columns: Sequence[str]) -> list[str]:
    """Return the columns that fit a terminal, less those that can best be missed where it is narrow."""
    kept, drawn = list(columns), console()
    widths = {
        column: max(len(_HEADINGS.get(column, column)), *(len(_cell(row, column)) for row in rows)) + 2
        for column in columns
    }
    for column in _SHRINKING:
        widths[column] = min(widths.get(column, 0), _NARROWEST)
    for column in _MISSED:
        if drawn.is_terminal and column in kept and sum(map(widths.__getitem__, kept)) > drawn.width:
            kept.remove(column)
    return kept


def _aligned(lines: Sequence[Sequence[str]], left: Sequence[bool]) -> list[str]:
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


def _cell(row: dict[str, Any], column: str) -> str:
    """Return what people are shown of a run in a column."""
    found = value(row, column)
    if column == "episodes" and row["episodes_to_do"] not in (None, found):
        return f"{UNKNOWN if found is None else f'{found:,}'} of {row['episodes_to_do']:,}"
    if found is None or found == []:
        return "" if column in _OFTEN_EMPTY else UNKNOWN
    if column == "created":
        return f"{_moment(row):%Y-%m-%d %H:%M}"
    if column in _IN_WORDS:
        return _IN_WORDS[column](found)
    plain = column in FIELDS and isinstance(found, int)
    return f"{found:,}" if plain else printable(str(found))


_IN_WORDS: Final[dict[str, Callable[[Any], str]]] = {
    **dict.fromkeys(("finish_percent", "mean_length", "mean_penalties"), number),
    "age": age,
    "bytes": size,
    "seconds": duration,
    "seed": str,
    "tag": " ".join,
}


def printable(text: str) -> str:
    """Return a text on one line, without what would move a terminal's cursor or change its colours."""
    return "".join(character if character.isprintable() else " " for character in text)


def _moment(row: dict[str, Any]) -> datetime:
    return datetime.fromtimestamp(row["created"] / 1000, UTC)
