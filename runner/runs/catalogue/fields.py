"""The fields of a run that a listing shows, sorts by and filters: their names, kinds and meanings."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Final

from runner.errors import RunnerError, nearest
from runner.recording.metrics import METRICS

SETTING: Final = "config."
"""What the path of a configuration's value begins with, as a field."""
STATUSES: Final = ("running", "finished", "interrupted", "failed", "archived", "damaged")


class Kind(enum.Enum):
    """How the values of a field are compared."""

    START = "the beginning of it"
    TEXT = "the whole of it; * and ? stand for any"
    STATUS = "one of " + ", ".join(STATUSES)
    PROSE = "a part of it"
    TAGS = "one of them"
    WHOLE = "a whole number"
    NUMBER = "a number"
    SIZE = "a number of bytes, or 10MB, 1.5GB"
    DATE = "a date such as 2026-01-31, or 2026-01-31T10:00 (UTC)"
    AGE = "a time span such as 90s, 12h, 30d or 2w, with < or >"


@dataclass(frozen=True)
class Field:
    """A field of a run."""

    name: str
    kind: Kind
    meaning: str
    column: str = ""
    """The column it is in, if that has another name."""


_ALL: Final = (
    Field("id", Kind.START, "the run's id"),
    Field("name", Kind.TEXT, "what the run is called"),
    Field("config", Kind.TEXT, "the name of its configuration"),
    Field("seed", Kind.WHOLE, "its seed"),
    Field("status", Kind.STATUS, "how it stands"),
    Field("tag", Kind.TAGS, "a tag that it was given", "tags"),
    Field("note", Kind.PROSE, "the note on it"),
    Field("created", Kind.DATE, "when it began"),
    Field("age", Kind.AGE, "how long ago that was", "created"),
    Field("episodes", Kind.NUMBER, "training episodes done"),
    Field("episodes_to_do", Kind.NUMBER, "training episodes that its configuration asks for"),
    Field("steps", Kind.NUMBER, "steps of training and evaluation"),
    Field("train_steps", Kind.NUMBER, "steps of training"),
    Field("eval_steps", Kind.NUMBER, "steps of evaluation"),
    *(
        Field(
            metric.name,
            Kind.NUMBER,
            f"{metric.heading} of the last evaluation"
            + (" of a loop; of its last 100 training episodes without one" if metric.per_agent else ""),
        )
        for metric in METRICS
    ),
    Field("logged", Kind.PROSE, "the values that a loop logged last, by name"),
    Field("seconds", Kind.NUMBER, "how long it took"),
    Field("bytes", Kind.SIZE, "the size of its recording"),
    Field("digest", Kind.START, "the content digest: equal content, equal digest"),
    Field("mode", Kind.TEXT, "cooperative or competitive"),
    Field("environment", Kind.TEXT, "the environment's id"),
    Field("host", Kind.TEXT, "the machine it ran on"),
    Field("git", Kind.START, "the commit of the code it ran with"),
    Field("archive", Kind.TEXT, "where its recording is archived"),
    Field("folder", Kind.TEXT, "the recordings folder it is in", "root"),
)
FIELDS: Final = {field.name: field for field in _ALL}
_ALIASES: Final = {"run_id": "id", "tags": "tag", "size": "bytes", "env": "environment"}


def field_of(name: str) -> Field:
    """Return the field of a name.

    Raises:
        RunnerError: there is none; the nearest are told.
    """
    found = FIELDS.get(_ALIASES.get(name, name))
    if found is None:
        hint = nearest(name, [*FIELDS, *_ALIASES])
        raise RunnerError(
            f"there is no field {name!r}.{hint} There are {', '.join(FIELDS)}, "
            f"and {SETTING}PATH for a value of the configuration such as {SETTING}discount."
        )
    return found
