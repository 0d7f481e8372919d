"""Values of a query's rows as text."""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING, Final

from runner.util.humanize import UNKNOWN

if TYPE_CHECKING:
    from runner.query.find import Found
    from runner.query.sql import QueryResult

MAX_PROBLEMS: Final = 5
"""The most runs that an answer says something about because they could not be read."""


def csv_value(value: object) -> object:
    """Return a value as a cell of CSV."""
    return json.dumps(value) if isinstance(value, list | dict) else value


def cell_of(value: object) -> str:
    """Return a value as a cell of a table."""
    if value is None:
        return UNKNOWN
    return f"{value:.6g}" if isinstance(value, float) else str(csv_value(value))


def reasons_in_words(answered: QueryResult | Found) -> Iterator[str]:
    """Yield why the first runs were left out, once all rows are read."""
    yield from answered.left_out[:MAX_PROBLEMS]
    if len(answered.left_out) > MAX_PROBLEMS:
        yield f"Runs are left out for {len(answered.left_out) - MAX_PROBLEMS:,} more reasons."


class _NoPandas:
    """Finds no pandas."""

    @staticmethod
    def find_spec(name: str, *_: object) -> None:
        if name == "pandas":
            raise ModuleNotFoundError(name=name)


@contextlib.contextmanager
def without_pandas() -> Iterator[None]:
    """Keep Arrow from loading pandas, which takes as long as a query, only to see whether it is there."""
    sys.meta_path.insert(0, _NoPandas)
    try:
        yield
    finally:
        sys.meta_path.remove(_NoPandas)
