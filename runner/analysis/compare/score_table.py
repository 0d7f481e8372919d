"""Tables of the scores of a random policy and an expert, which normalise the values of environments."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from runner.errors import RunnerError
from runner.util.arrays import Floats

MIN_MAX: Final = "minmax"
"""Stands for a normalisation by the worst and the best value of each environment."""
_MAX_TABLE: Final = 1 << 20
_SCORES: Final = ("random", "expert")


@dataclass(frozen=True)
class Bounds:
    """The values that are the scores 0 and 1 in an environment."""

    zero: float
    one: float

    def score(self, values: Floats) -> Floats:
        """Return the normalised scores of values."""
        return (values - self.zero) / (self.one - self.zero)


def scores_of(given: str | Path) -> dict[str, Bounds] | None:
    """Return the table in a file, or in a text of CSV; None for `minmax`."""
    if str(given) == MIN_MAX:
        return None
    return read_table(given) if isinstance(given, Path) else parse_table(given, "scores.csv")


def read_table(path: Path) -> dict[str, Bounds]:
    """Return the scores of a random policy and of an expert by environment, from CSV, YAML or JSON.

    CSV has the columns task, random and expert; YAML and JSON map an environment to `random` and `expert`.

    Raises:
        RunnerError: the file cannot be read, or is no such table.
    """
    try:
        if path.stat().st_size > _MAX_TABLE:
            raise RunnerError(f"{path}: found more than {_MAX_TABLE:,} bytes, expected a table of scores.")
        text = path.read_text("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8"
        raise RunnerError(f"{path}: cannot be read ({reason}).") from error
    return parse_table(text, path.name)


def parse_table(text: str, name: str) -> dict[str, Bounds]:
    """Return the table of a text, see `read_table`; its format follows the ending of the name.

    Raises:
        RunnerError: it is no such table.
    """
    ending = Path(name).suffix.lower()
    if ending not in (".csv", ".yaml", ".yml", ".json"):
        raise RunnerError(f"{name}: found the ending {ending!r}, expected .csv, .yaml or .json.")
    rows: list[tuple[str, Any]]
    if ending == ".csv":
        reader = csv.DictReader(text.splitlines())
        if sorted(reader.fieldnames or ()) != sorted(("task", *_SCORES)):
            columns = ", ".join(reader.fieldnames or ()) or "none"
            raise RunnerError(f"{name}: found the columns {columns}, expected task, {', '.join(_SCORES)}.")
        rows = [(str(row.pop("task")), row) for row in reader]
    else:
        rows = [(str(task), scores) for task, scores in _mapping(text, name).items()]
    table: dict[str, Bounds] = {}
    for task, scores in rows:
        try:
            bounds = Bounds(*(float(scores[score]) for score in _SCORES))
        except (KeyError, TypeError, ValueError):
            bounds = Bounds(math.nan, math.nan)
        if not math.isfinite(bounds.one - bounds.zero) or len(scores) != len(_SCORES):
            raise RunnerError(f"{name}: {task}: found {scores}, expected finite numbers, random and expert.")
        is_equal = bounds.zero == bounds.one
        if is_equal or task in table:
            problem = f"{bounds.zero:g} as random and as expert" if is_equal else "a second row"
            raise RunnerError(f"{name}: {task}: found {problem}, expected one row with two different scores.")
        table[task] = bounds
    if not table:
        raise RunnerError(f"{name}: found no row, expected one for each environment.")
    return table


def _mapping(text: str, name: str) -> Mapping[object, object]:
    import yaml

    try:
        table = json.loads(text) if name.endswith(".json") else yaml.safe_load(text)
    except (ValueError, RecursionError, yaml.YAMLError) as error:
        raise RunnerError(f"{name}: cannot be parsed ({' '.join(str(error).split())}).") from error
    if not isinstance(table, Mapping):
        raise RunnerError(f"{name}: expected a mapping of environments to `random` and `expert`.")
    return table
