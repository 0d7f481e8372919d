"""The values in a filter: numbers, sizes, dates and time spans, read from text.

Each function raises `ValueError` with what it expected.
"""

from __future__ import annotations

import math
import re
from datetime import UTC, datetime, timedelta
from typing import Final, NamedTuple

from runner.runs.catalogue.fields import Kind
from runner.runs.catalogue.rows import SEEDS

_SPAN: Final = re.compile(r"(\d+(?:\.\d+)?)\s*(s|min|m|h|d|w)")
_SECONDS: Final = {"s": 1, "m": 60, "min": 60, "h": 3600, "d": 86400, "w": 7 * 86400}
_SIZE: Final = re.compile(r"(\d+(?:\.\d+)?)\s*([kMGT]?)B?", re.IGNORECASE)
_BYTES: Final = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "t": 10**12}
_INTEGERS: Final = 2**63
_DATE: Final = re.compile(r"\d{4}-\d{2}-\d{2}")


class Span(NamedTuple):
    """A span of time, in milliseconds since 1970."""

    start: int
    stop: int
    """Behind the last one."""


def number_of(text: str) -> int | float:
    """Return a finite number; a whole one exactly, if SQLite can hold it."""
    try:
        if re.fullmatch(r"[+-]?\d{1,18}", text, re.ASCII):
            return int(text)
        found = float(text)
    except ValueError:
        found = math.nan
    if not math.isfinite(found) or "_" in text:
        raise ValueError(Kind.NUMBER.value)
    return found


def whole_of(text: str) -> int:
    """Return a seed: a whole number from 0 to 2^64 - 1."""
    if not re.fullmatch(r"\d{1,20}", text, re.ASCII) or int(text) >= SEEDS:
        raise ValueError(f"{Kind.WHOLE.value} from 0 to {SEEDS - 1}")
    return int(text)


def size_of(text: str) -> float:
    """Return a number of bytes: `1500`, `10MB`, `1.5 GB`."""
    found = _SIZE.fullmatch(text)
    if found is None:
        raise ValueError(Kind.SIZE.value)
    return float(found[1]) * _BYTES[found[2].lower()]


def date_span(text: str) -> Span:
    """Return the day, the minute, the second or the millisecond that a date names, in UTC unless it says."""
    try:
        moment = datetime.fromisoformat(text)
        moment = moment.replace(tzinfo=UTC) if moment.tzinfo is None else moment.astimezone(UTC)
        start = math.floor(moment.timestamp() * 1000)
    except (ValueError, OverflowError):
        raise ValueError(Kind.DATE.value) from None
    if _DATE.fullmatch(text):
        length = timedelta(days=1)
    elif "." in text:
        length = timedelta(milliseconds=1)
    else:
        length = timedelta(seconds=1) if text.count(":") > 1 else timedelta(minutes=1)
    return Span(start, start + int(length.total_seconds() * 1000))


def span_seconds(text: str) -> float:
    """Return a time span in seconds: `90s`, `12h`, `30d`, `2w`."""
    found = _SPAN.fullmatch(text)
    if found is None or len(found[1]) > 12:
        raise ValueError(Kind.AGE.value)
    return float(found[1]) * _SECONDS[found[2]]
