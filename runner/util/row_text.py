"""Rows as JSON or CSV, a line each, for tables of any length; their values as cells."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Iterator, Mapping

from runner.util.humanize import UNKNOWN
from runner.util.values import finite


def json_lines(rows: Iterable[object]) -> Iterator[str]:
    """Yield values as JSON, a line each. NaN and infinity become null."""
    return (json.dumps(finite(row), allow_nan=False) + "\n" for row in rows)


def json_list(name: str, rows: Iterable[Mapping[str, object]]) -> Iterator[str]:
    """Yield the text of a JSON object with one named list in parts, so that it is never in memory as a whole.

    Each value stands on a line of its own.
    """
    encode = json.JSONEncoder(allow_nan=False, separators=(",\n   ", ": ")).encode  # indent= is far slower
    yield f'{{\n "{name}": ['
    separator = ""
    for row in rows:
        yield separator + "\n  {\n   " + encode(finite(row))[1:-1] + "\n  }"
        separator = ","
    yield "\n ]\n}\n" if separator else "]\n}\n"


class _Passed:
    """A file for `csv.writer` whose `write` returns the line."""

    @staticmethod
    def write(line: str) -> str:
        return line


def csv_lines(columns: Iterable[str], rows: Iterable[Iterable[object]]) -> Iterator[str]:
    """Yield the lines of a table as CSV, the headings first."""
    write = csv.writer(_Passed(), lineterminator="\n").writerow
    yield write(columns)
    yield from map(write, rows)


def csv_value(value: object) -> object:
    """Return a value as a cell of CSV."""
    return json.dumps(value) if isinstance(value, list | dict) else value


def cell_of(value: object) -> str:
    """Return a value as a cell of a table."""
    if value is None:
        return UNKNOWN
    return f"{value:.6g}" if isinstance(value, float) else str(csv_value(value))
