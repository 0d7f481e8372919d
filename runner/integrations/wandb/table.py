"""A table of wandb's, recorded as a text."""

from __future__ import annotations

import json
from typing import Any, Final

from runner.errors import ConfigError
from runner.integrations.shapes import WithoutEffect, without_effect
from runner.util.jsonable import as_json

_MAX_TABLE: Final = 1 << 20


class Table:
    """Rows, recorded as a text."""

    def __init__(
        self, columns: Any = None, data: Any = None, rows: Any = None, dataframe: Any = None, **_: object
    ) -> None:
        if dataframe is not None:
            columns, data = dataframe.columns, dataframe.to_numpy()
        data = rows if data is None else data
        self.columns = list(() if columns is None else columns)
        self.data = list(() if data is None else data)

    def add_data(self, *row: object) -> None:
        """Add a row."""
        self.data.append(list(row))

    def text(self) -> str:
        """Return columns and rows as JSON."""
        text = json.dumps(as_json({"columns": self.columns, "data": self.data}))
        if len(text) > _MAX_TABLE:
            raise ConfigError(f"log: found a table of {len(text):,} bytes, expected at most {_MAX_TABLE:,}")
        return text

    def __getattr__(self, name: str) -> WithoutEffect:
        return without_effect("wandb.Table", name)
