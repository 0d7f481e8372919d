"""Runs of the catalogue as its tests read them."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

from runner.config import from_mapping
from runner.runs.catalogue.filters import Filter, parse
from runner.runs.catalogue.index import look

CONFIG = from_mapping({"name": "some", "episodes": 5})
ALL = Filter(None)


def rows(*folders: Path, text: str = "") -> tuple[list[Any], list[str]]:
    """Return the rows of the runs that a filter selects, and what the catalogue reported."""
    messages: list[str] = []
    found = look(folders, lambda index: index.select(parse(text)), messages.append)
    return found, messages


def ids(folder: Path, text: str = "") -> list[str]:
    """Return the ids of the runs that a filter selects."""
    return [row["id"] for row in rows(folder, text=text)[0]]


def aged(folder: Path) -> None:
    """Make everything in a folder look as if it had last changed an hour ago, and index it so."""
    for path in folder.rglob("*"):
        os.utime(path, (time.time() - 3600,) * 2)
    ids(folder)
