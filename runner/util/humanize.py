"""Sizes, times, numbers and long lists formatted for people, as in tables and pages.

A minus is a hyphen everywhere, in text, tables and pictures, so that numbers can be copied and searched.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Final

UNKNOWN: Final = "–"
_MAX_LISTED: Final = 6
_MAX_REMARKS: Final = 5
_CONTROLS: Final = re.compile("[\0-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
"""C0 without tab and newline, DEL, C1, overrides of the writing direction, and lone surrogates."""


def printable(text: str) -> str:
    """Return a text whose control characters are visible, as JSON escapes them.

    A name, note or file that somebody else wrote cannot move the cursor, set the title or answer questions of
    a terminal. Tabs and newlines stay; JSON stays the same value.
    """
    return _CONTROLS.sub(lambda control: f"\\u{ord(control[0]):04x}", text)


def size(count: float) -> str:
    """Return a number of bytes as text: `7.6 MB`."""
    if count < 1000:
        return f"{count:.0f} B"
    for unit in ("kB", "MB", "GB"):
        count /= 1000
        if count < 999.5:
            return f"{_two_digits(count)} {unit}"
    return f"{_two_digits(count / 1000)} TB"


def capitalised(text: str) -> str:
    """Return a text with a capital at its start."""
    return text[:1].upper() + text[1:]


def sentence(text: str) -> str:
    """Return a text with a capital at its start, unless that is a name, and a full stop at its end."""
    start = capitalised(text) if text.partition(" ")[0].isalpha() else text
    return f"{start}{'' if text[-1:] in '.:?' else '.'}"


def counted(count: int, noun: str) -> str:
    """Return a number of things as text: `1 episode`, `2,000 episodes`."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def amount(count: float) -> str:
    """Return a large number as text: `9,500`, `12 thousand`, `3.4 million`."""
    for divisor, word in ((1e9, "billion"), (1e6, "million"), (1e3, "thousand")):
        if count >= max(divisor, 1e4):
            return f"{_two_digits(count / divisor)} {word}"
    return f"{count:,.0f}"


def _two_digits(number: float) -> str:
    return f"{number:.1f}" if number < 9.95 else f"{number:,.0f}"


def duration(seconds: float) -> str:
    """Return a time span as text: `0.8 s`, `2 min 5 s`, `1 h 12 min`, `3 d`."""
    if seconds < 10:
        return f"{max(seconds, 0):.1f} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    if whole < 86400:
        return f"{whole // 3600} h {whole % 3600 // 60} min"
    return f"{whole // 86400} d"


def age(seconds: float) -> str:
    """Return a time span in one unit: `40 s`, `5 min`, `3 h`, `12 d`."""
    whole = max(round(seconds), 0)
    for bound, divisor, unit in ((60, 1, "s"), (3600, 60, "min"), (86400, 3600, "h")):
        if whole < bound:
            return f"{whole // divisor} {unit}"
    return f"{whole // 86400} d"


def ago(moment: datetime) -> str:
    """Return the time since a moment in one unit, as `age` does."""
    return age((datetime.now(UTC) - moment).total_seconds())


def number(value: float | None, digits: int = 1) -> str:
    """Return a number with `digits` decimals; an unknown one (None, NaN) as a dash."""
    return UNKNOWN if value is None or math.isnan(value) else f"{value:,.{digits}f}"


def measure(value: float | None) -> str:
    """Return a logged value with four significant digits, large ones whole: `0.000202`, `19,950`."""
    if value is None or not math.isfinite(value):
        return "not finite"
    return f"{value:,.0f}" if 1e4 <= abs(value) < 1e15 else f"{value:,.4g}"


def setting(value: object) -> str:
    """Return a value of a configuration as text, exact: `true`, `0.25`, `linear 1 to 0.1 over 5,000`."""
    if isinstance(value, Mapping) and value.get("schedule") == "linear":
        return f"linear {setting(value['start'])} to {setting(value['end'])} over {value['over']:,}"
    if value is None:
        return "not set"
    if isinstance(value, float):
        return f"{value:g}" if float(f"{value:g}") == value else repr(value)
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False, default=str)


def number_column(values: Sequence[float]) -> list[str]:
    """Return numbers with the same decimals: none if all are whole, else three."""
    digits = 0 if all(float(value).is_integer() for value in values) else 3
    return [number(value, digits) for value in values]


def listed(names: Sequence[str], limit: int = _MAX_LISTED) -> str:
    """Return names as text, shortened to the first few: `a, b, c, d, e, f and 3 more`."""
    more = len(names) - limit
    return ", ".join(names[:limit]) + (f" and {more:,} more" if more > 0 else "")


def first_remarks(remarks: Sequence[str], rest: str) -> list[str]:
    """Return the first five remarks; if there are more, also `rest`, with {} replaced by their number."""
    more = len(remarks) - _MAX_REMARKS
    return [*remarks[:_MAX_REMARKS], *([rest.format(f"{more:,}")] if more > 0 else [])]
