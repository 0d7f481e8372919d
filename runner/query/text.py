"""Values of a query's rows as text."""

from __future__ import annotations

import json

from runner.util.humanize import UNKNOWN


def csv_value(value: object) -> object:
    """Return a value as a cell of CSV."""
    return json.dumps(value) if isinstance(value, list | dict) else value


def cell_of(value: object) -> str:
    """Return a value as a cell of a table."""
    if value is None:
        return UNKNOWN
    return f"{value:.6g}" if isinstance(value, float) else str(csv_value(value))
