"""Rows of the index as programs are told of them: columns by name, as plain values."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from runner.errors import RunnerError
from runner.recording.metrics import METRICS
from runner.runs.catalogue.fields import FIELDS, SETTING, field_of
from runner.runs.run import RECORDING_FILE
from runner.util.humanize import UNKNOWN, age, duration, number, size

if TYPE_CHECKING:
    from runner.runs.catalogue.index import Index

MADE: Final = ("same_as", "path")
"""Columns that are no fields: the run that recorded the same content first, and the recording's path."""
PROGRAMS: Final = (
    *("run_id", "name", "config", "seed", "status", "tags", "note", "created"),
    *("episodes", "episodes_to_do", "train_steps", "eval_steps", "seconds"),
    *(metric.name for metric in METRICS),
    "logged",
    *("bytes", "content_digest", "same_as"),
    *("mode", "environment", "host", "git", "archive", "path"),
)
"""What programs are told of a run, unless they ask for other columns."""
HEADINGS: Final = {
    "success_percent": "success %",
    "mean_return": "return",
    "bytes": "size",
    "tag": "tags",
    "same_as": "same as",
}
"""What stands above a column, if that is not its name."""
_OFTEN_EMPTY: Final = ("tag", "same_as", "note", "archive", "logged")
_FIELD_OF: Final = {"run_id": "id", "tags": "tag", "content_digest": "digest"}


def columns_of(text: str) -> list[str]:
    """Return the columns that a list of names, separated by commas, asks for.

    Raises:
        RunnerError: there is no such column.
    """
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names:
        raise RunnerError("columns: found nothing, expected names such as id,name,success_percent.")
    return [name if name in MADE or name.startswith(SETTING) else field_of(name).name for name in names]


def needed_for(columns: Iterable[str]) -> list[str]:
    """Return the columns of the index that `value` and `with_originals` need for these columns."""
    needed = ["root", "entry", "id", "problem"]
    for column in columns:
        name = _FIELD_OF.get(column, column)
        if name.startswith(SETTING):
            needed.append("settings")
        elif name == "same_as":
            needed.append("digest")
        elif name != "path":
            needed.append(FIELDS[name].column or name)
    if "episodes" in needed:
        needed.append("episodes_to_do")  # shown with it where some are missing
    return list(dict.fromkeys(needed))


def with_originals(rows: list[dict[str, Any]], index: Index) -> list[dict[str, Any]]:
    """Return rows with `same_as`: the id of another run that recorded the same content first, or None."""
    originals = index.originals([row["digest"] for row in rows if row["digest"]])
    return list(with_same_as(rows, originals))


def with_same_as(
    rows: Iterable[dict[str, Any]], originals: Mapping[str, tuple[str, str, str]]
) -> Iterator[dict[str, Any]]:
    """Yield rows with `same_as`, by what `Index.originals` returns."""
    for row in rows:
        first = originals.get(row["digest"])
        elsewhere = first is not None and first[:2] != (row["root"], row["entry"])
        row["same_as"] = first[2] if first and elsewhere else None
        yield row


def value(row: dict[str, Any], column: str) -> Any:
    """Return what programs are told of a run in a column."""
    name = _FIELD_OF.get(column, column)
    if name.startswith(SETTING):
        return json.loads(row["settings"]).get(name.removeprefix(SETTING))
    match name:
        case "tag":
            return row["tags"].split()
        case "created":
            return moment(row).isoformat(timespec="milliseconds")
        case "age":
            return round((datetime.now(UTC) - moment(row)).total_seconds())
        case "path":
            return str(Path(row["root"], row["entry"], RECORDING_FILE))
    found = row[FIELDS[name].column or name] if name in FIELDS else row[name]
    return json.loads(found) if name == "logged" else found


def as_json(row: dict[str, Any], columns: Sequence[str] = PROGRAMS) -> dict[str, Any]:
    """Return what programs are told of a run, by column."""
    return {column: value(row, column) for column in columns}


def moment(row: dict[str, Any]) -> datetime:
    """Return when a run began, in UTC."""
    return datetime.fromtimestamp(row["created"] / 1000, UTC)


def in_words(row: dict[str, Any], column: str) -> str:
    """Return what people are shown of a run in a column."""
    found = value(row, column)
    if column == "episodes" and row["episodes_to_do"] not in (None, found):
        return f"{UNKNOWN if found is None else f'{found:,}'} of {row['episodes_to_do']:,}"
    if found is None or found in ([], {}):
        return "" if column in _OFTEN_EMPTY else UNKNOWN
    if column == "created":
        return f"{moment(row):%Y-%m-%d %H:%M}"
    if column in _IN_WORDS:
        return _IN_WORDS[column](found)
    plain = column in FIELDS and isinstance(found, int)
    return f"{found:,}" if plain else str(found)


def _logged_in_words(values: dict[str, float | None]) -> str:
    """Return logged values on one line: `loss 0.0123, entropy 1.5`."""
    return ", ".join(
        f"{name} {'not finite' if value is None else f'{value:,.4g}'}" for name, value in values.items()
    )


_IN_WORDS: Final[dict[str, Callable[[Any], str]]] = {
    **dict.fromkeys((metric.name for metric in METRICS), number),
    "logged": _logged_in_words,
    "age": age,
    "bytes": size,
    "seconds": duration,
    "seed": str,
    "tag": " ".join,
}
