"""The columns of a run, in one table: index, filters, JSON, `ls` and pages derive theirs from it."""

from __future__ import annotations

import enum
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from runner.errors import RunnerError, nearest, shortened
from runner.recording.metrics import METRICS
from runner.runs.branches import parse_origin
from runner.runs.run import RECORDING_FILE
from runner.util.humanize import UNKNOWN, age, duration, measure, number, setting, size
from runner.util.values import Json

IndexRow = dict[str, Any]
"""A run as the index has it, by the names of the stored columns."""

SETTING: Final = "config."
"""The prefix of a column that holds a value of the configuration, such as `config.discount`."""
STATUSES: Final = ("running", "finished", "interrupted", "failed", "archived", "damaged")


class ColumnKind(enum.Enum):
    """How a filter compares the values of a column; the text says what it expects."""

    START = "a text in quotes; like() finds it by its beginning"
    TEXT = "a text in quotes; like() takes the wildcards * and ?"
    STATUS = "one of " + ", ".join(STATUSES)
    PROSE = "a text in quotes; TEXT in FIELD finds a part of it"
    TAGS = "a text in quotes, as in TEXT in tags"
    WHOLE = "a whole number"
    NUMBER = "a number"
    SIZE = 'a number of bytes, or "10MB", "1.5GB"'
    DATE = 'a date such as "2026-01-31", or "2026-01-31T10:00" (UTC)'
    AGE = 'a time span such as "90s", "12h", "30d" or "2w", with < or >'


TEXT_KINDS: Final = (ColumnKind.START, ColumnKind.TEXT, ColumnKind.STATUS, ColumnKind.PROSE, ColumnKind.TAGS)
LEFT_KINDS: Final = (*TEXT_KINDS, ColumnKind.DATE)
"""The kinds that tables align to the left."""


@dataclass(frozen=True)
class Column:
    """A column of a run."""

    name: str
    kind: ColumnKind | None
    """None if it cannot be filtered or sorted by."""
    meaning: str
    type: type | None = str
    """What the index stores; None if it derives the value from `needs`."""
    key: str = ""
    """Its key in JSON, if that is not the name."""
    heading: str = ""
    """What a table calls it, if not by its name."""
    aliases: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()
    """The stored columns that it is read from; itself by default. Filters compare the first."""
    in_json: bool = True
    """Whether JSON has it by default."""
    read: Callable[[IndexRow], object] | None = None
    show: Callable[[Any], str] = lambda value: f"{value:,}" if isinstance(value, int) else str(value)
    if_empty: str = UNKNOWN

    @property
    def stored(self) -> tuple[str, ...]:
        """The stored columns that it is read from."""
        return self.needs or (self.name,)


def moment(row: IndexRow) -> datetime:
    """Return when a run began, in UTC."""
    return datetime.fromtimestamp(row["created"] / 1000, UTC)


def _change(origin: str | None) -> str | None:
    """Return the change of a branch in words."""
    parsed = None if origin is None else parse_origin(json.loads(origin))
    return None if parsed is None else shortened(str(parsed), _MAX_CHANGE)


def _logged_text(values: Mapping[str, float | None]) -> str:
    """Return logged values on one line: `loss 0.0123, entropy 1.5, 3 more`."""
    texts = [f"{name} {measure(value)}" for name, value in values.items()]
    more = len(texts) - _MAX_LOGGED
    return ", ".join(texts if more <= 0 else [*texts[:_MAX_LOGGED], f"{more} more"])


_MAX_CHANGE: Final = 100
"""The most characters of the change of a branch."""
_MAX_LOGGED: Final = 4
"""Logged values in a line of a listing."""
_METRIC_HEADINGS: Final = {"success_percent": "success %", "mean_return": "return"}

COLUMNS: Final = {
    column.name: column
    for column in (
        Column("id", ColumnKind.START, "the run's id", key="run_id"),
        Column("name", ColumnKind.TEXT, "the run's name"),
        Column("config", ColumnKind.TEXT, "the name of its configuration"),
        Column("seed", ColumnKind.WHOLE, "its seed", int, show=str),
        Column("status", ColumnKind.STATUS, "its status"),
        Column(
            "tag",
            ColumnKind.TAGS,
            "one of its tags",
            None,
            key="tags",
            heading="tags",
            needs=("tags",),
            read=lambda row: row["tags"].split(),
            show=" ".join,
            if_empty="",
        ),
        Column("note", ColumnKind.PROSE, "its note", if_empty=""),
        Column(
            "created",
            ColumnKind.DATE,
            "when it began",
            int,
            read=lambda row: moment(row).isoformat(timespec="milliseconds"),
            show=lambda text: text[:16].replace("T", " "),
        ),
        Column(
            "age",
            ColumnKind.AGE,
            "how long ago it began",
            None,
            needs=("created",),
            in_json=False,
            read=lambda row: round((datetime.now(UTC) - moment(row)).total_seconds()),
            show=age,
        ),
        Column("episodes", ColumnKind.NUMBER, "training episodes done", int),
        Column("episodes_to_do", ColumnKind.NUMBER, "training episodes in its configuration", int),
        Column("steps", ColumnKind.NUMBER, "steps of training and evaluation", int, in_json=False),
        Column("train_steps", ColumnKind.NUMBER, "steps of training", int),
        Column("eval_steps", ColumnKind.NUMBER, "steps of evaluation", int),
        Column("seconds", ColumnKind.NUMBER, "how long it took", float, show=duration),
        *(
            Column(
                metric.name,
                ColumnKind.NUMBER,
                f"{metric.heading} of the last evaluation"
                + ("; of a loop without one of its last 100 training episodes" if metric.per_agent else ""),
                float,
                heading=_METRIC_HEADINGS.get(metric.name, ""),
                show=number,
            )
            for metric in METRICS
        ),
        Column(
            "logged",
            ColumnKind.PROSE,
            "the last values that a loop logged, by name",
            read=lambda row: json.loads(row["logged"]),
            show=_logged_text,
            if_empty="",
        ),
        Column(
            "bytes",
            ColumnKind.SIZE,
            "the size of its recording",
            int,
            heading="size",
            aliases=("size",),
            show=size,
        ),
        Column(
            "digest",
            ColumnKind.START,
            "its content digest: equal content, equal digest",
            key="content_digest",
        ),
        Column(
            "same_as",
            None,
            "the run that recorded the same content first",
            None,
            heading="same as",
            needs=("digest",),
            read=lambda row: row["same_as"],
            if_empty="",
        ),
        Column(
            "parent", ColumnKind.START, "the run that it is a branch of", heading="branch of", if_empty=""
        ),
        Column(
            "change",
            None,
            "what was changed, of a branch",
            None,
            needs=("origin",),
            in_json=False,
            read=lambda row: _change(row["origin"]),
            if_empty="",
        ),
        Column("mode", ColumnKind.TEXT, "cooperative or competitive"),
        Column("environment", ColumnKind.TEXT, "the environment's id", aliases=("env",)),
        Column("host", ColumnKind.TEXT, "the machine it ran on"),
        Column("git", ColumnKind.START, "the commit of the code it ran with"),
        Column("archive", ColumnKind.TEXT, "where its recording is archived", if_empty=""),
        Column("folder", ColumnKind.TEXT, "its recordings folder", None, needs=("root",), in_json=False),
        Column(
            "path",
            None,
            "the path of its recording",
            None,
            needs=("root", "entry"),
            read=lambda row: str(Path(row["root"], row["entry"], RECORDING_FILE)),
        ),
    )
}
FIELDS: Final = {name: column for name, column in COLUMNS.items() if column.kind}
"""The columns that filters and sorting know."""
DEFAULT_JSON: Final = tuple(column.key or name for name, column in COLUMNS.items() if column.in_json)
"""The columns of a run in JSON, unless others are chosen."""
HEADINGS: Final = {name: column.heading for name, column in COLUMNS.items() if column.heading}
_ALIASES: Final = {
    alias: name for name, column in COLUMNS.items() for alias in (column.key, *column.aliases) if alias
}


def field_of(name: str) -> Column:
    """Return the column of a name that a filter can use.

    Raises:
        RunnerError: there is none.
    """
    column = FIELDS.get(_ALIASES.get(name, name))
    if column is None:
        hint = nearest(name, [*FIELDS, *_ALIASES])
        raise RunnerError(
            f"there is no field {name!r}.{hint} There are {', '.join(FIELDS)}, "
            f"and {SETTING}PATH for a value of the configuration such as {SETTING}discount."
        )
    return column


def columns_of(text: str) -> list[str]:
    """Return the columns in a list of names, separated by commas.

    Raises:
        RunnerError: there is no such column.
    """
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names:
        raise RunnerError("columns: found nothing, expected names such as id,name,success_percent.")
    return [name if name in COLUMNS or name.startswith(SETTING) else field_of(name).name for name in names]


def needed_for(columns: Iterable[str]) -> list[str]:
    """Return the stored columns that `value` and `with_same_as` need for these columns."""
    needed = ["root", "entry", "id", "problem"]
    for name in columns:
        needed += ["settings"] if name.startswith(SETTING) else _column(name).stored
    if "episodes" in needed:
        needed.append("episodes_to_do")  # shown with it where some are missing
    return list(dict.fromkeys(needed))


def with_same_as(
    rows: Iterable[IndexRow], originals: Mapping[str, tuple[str, str, str]]
) -> Iterator[IndexRow]:
    """Yield rows with `same_as`: the id of another run that recorded the same content first, or None.

    Args:
        originals: as `Index.originals` returns them.
    """
    for row in rows:
        first = originals.get(row["digest"])
        row["same_as"] = first[2] if first and first[:2] != (row["root"], row["entry"]) else None
        yield row


def value(row: IndexRow, name: str) -> object:
    """Return the value of a column, as JSON has it."""
    if name.startswith(SETTING):
        return json.loads(row["settings"]).get(name.removeprefix(SETTING))
    column = _column(name)
    return column.read(row) if column.read else row[column.stored[0]]


def as_json(row: IndexRow, columns: Sequence[str] = DEFAULT_JSON) -> Json:
    """Return the values of a run by column."""
    return {name: value(row, name) for name in columns}


def as_text(row: IndexRow, name: str) -> str:
    """Return the value of a column as a table shows it."""
    content = value(row, name)
    if name == "episodes" and row["episodes_to_do"] not in (None, content):
        return f"{UNKNOWN if content is None else f'{content:,}'} of {row['episodes_to_do']:,}"
    if name.startswith(SETTING):
        return UNKNOWN if content is None else setting(content)
    column = _column(name)
    return column.if_empty if content is None or content in ([], {}) else column.show(content)


def _column(name: str) -> Column:
    return COLUMNS[_ALIASES.get(name, name)]
