"""How results look: JSON, tables, sizes and times in words."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

import click

if TYPE_CHECKING:  # imported when something is drawn
    from rich.console import Console, RenderableType
    from rich.table import Table
    from rich.text import Text

UNKNOWN: Final = "–"
UNBOUNDED: Final = 1000
"""The width where there is no terminal to fit."""


def print_json(value: Any, indent: int | None = 1) -> None:
    """Print a value as JSON on stdout; None for `indent` makes it one line. NaN becomes null."""
    click.echo(json.dumps(_finite(value), indent=indent, allow_nan=False))


def say(text: str) -> None:
    """Tell the user something beside the result, on stderr."""
    click.echo(text, err=True)


def console() -> Console:
    """Return the console of stdout: colours on a terminal only, and lines as long as they come elsewhere."""
    from rich.console import Console

    drawn = Console(highlight=False, markup=False, emoji=False)
    if not drawn.is_terminal:
        drawn.width = UNBOUNDED
    return drawn


def draw(*parts: RenderableType) -> None:
    """Print tables and lines on stdout; elsewhere than on a terminal without the blanks that fill them up."""
    drawn = console()
    if drawn.is_terminal:
        for part in parts:
            drawn.print(part)
        return
    with drawn.capture() as captured:
        for part in parts:
            drawn.print(part)
    click.echo("\n".join(line.rstrip() for line in captured.get().splitlines()))


def title(text: str) -> Text:
    """Return the heading of what follows, an empty line above it."""
    from rich.text import Text

    return Text.assemble("\n", (text, "bold underline"))


def table(*headings: str, left: tuple[str, ...] = (), shrinking: tuple[str, ...] = ()) -> Table:
    """Return an empty table with these headings.

    Args:
        headings: of the columns, in order.
        left: the columns to be aligned to the left, as text is; the others to the right, as numbers are.
        shrinking: the columns that give way, with an ellipsis, where a terminal is too narrow.
    """
    from rich.table import Table

    made = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, header_style="bold")
    for heading in headings:
        made.add_column(
            heading,
            justify="left" if heading in left else "right",
            vertical="bottom",
            overflow="ellipsis",
            no_wrap=heading not in shrinking,
        )
    return made


def facts(pairs: Mapping[str, str]) -> Table:
    """Return a table of names and what they are."""
    from rich.table import Table

    made = Table.grid(padding=(0, 2, 0, 0))
    made.add_column(style="bold", no_wrap=True)
    made.add_column(overflow="fold")
    for name, text in pairs.items():
        made.add_row(name, text)
    return made


def size(count: float) -> str:
    """Return a number of bytes in words: `7.6 MB`."""
    if count < 1000:
        return f"{count:.0f} B"
    for unit in ("kB", "MB", "GB"):
        count /= 1000
        if count < 999.5:
            return f"{_two_digits(count)} {unit}"
    return f"{_two_digits(count / 1000)} TB"


def amount(count: float) -> str:
    """Return a large number in words: `9,500`, `12 thousand`, `3.4 million`."""
    for divisor, word in ((1e9, "billion"), (1e6, "million"), (1e3, "thousand")):
        if count >= max(divisor, 1e4):
            return f"{_two_digits(count / divisor)} {word}"
    return f"{count:,.0f}"


def _two_digits(number: float) -> str:
    return f"{number:.1f}" if number < 9.95 else f"{number:,.0f}"


def duration(seconds: float) -> str:
    """Return a time span in words: `0.8 s`, `2 min 5 s`, `1 h 12 min`, `3 d`."""
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
    """Return how long ago something was, in one unit: `40 s`, `5 min`, `3 h`, `12 d`."""
    whole = max(round(seconds), 0)
    for bound, divisor, unit in ((60, 1, "s"), (3600, 60, "min"), (86400, 3600, "h")):
        if whole < bound:
            return f"{whole // divisor} {unit}"
    return f"{whole // 86400} d"


def number(value: float | None, digits: int = 1) -> str:
    """Return a number with some digits after the point; what is unknown (None, NaN) as a dash."""
    return UNKNOWN if value is None or math.isnan(value) else f"{value:,.{digits}f}"


def _finite(value: Any) -> Any:
    """Return a value that JSON can hold: no NaN, no infinity, no NumPy."""
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value
