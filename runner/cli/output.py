"""How results look: JSON, tables, sizes and times in words."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final, Literal

import click

from runner.util.humanize import UNKNOWN, age, amount, duration, number, size
from runner.util.values import finite

if TYPE_CHECKING:  # imported when something is drawn
    from rich.console import Console, RenderableType
    from rich.table import Table
    from rich.text import Text

__all__ = [
    "UNKNOWN",
    "age",
    "amount",
    "console",
    "draw",
    "duration",
    "facts",
    "json_list",
    "number",
    "print_json",
    "say",
    "size",
    "table",
    "title",
]

SHRUNK: Final = 10
"""Characters that a shrinking column of a table keeps."""

UNBOUNDED: Final = 1000
"""The width where there is no terminal to fit."""


def print_json(value: Any, indent: int | None = 1) -> None:
    """Print a value as JSON on stdout; None for `indent` makes it one line. NaN and infinity become null."""
    click.echo(json.dumps(finite(value), indent=indent, allow_nan=False))


def json_list(name: str, rows: Iterable[Mapping[str, Any]]) -> Iterator[str]:
    """Yield the text of a JSON object with one named list in parts, so that it is never in memory as a whole.

    Each value stands on a line of its own.
    """
    encode = json.JSONEncoder(allow_nan=False, separators=(",\n   ", ": ")).encode  # indent= is far slower
    yield f'{{\n "{name}": ['
    separator = ""
    for row in rows:
        yield separator + "\n  {\n   " + encode(finite(row))[1:-1] + "\n  }"
        separator = ","
    yield "\n ]\n}\n" if separator else "]\n}\n"


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
            # Lines too long for the terminal are broken by it: no figure is cut short.
            drawn.print(part, width=max(drawn.width, _least_width(part)), crop=False)
        return
    with drawn.capture() as captured:
        for part in parts:
            drawn.print(part)
    click.echo("\n".join(line.rstrip() for line in captured.get().splitlines()))


def _least_width(part: RenderableType) -> int:
    """Return the width that a table needs so that only its shrinking columns are shortened."""
    from rich.cells import cell_len
    from rich.table import Table

    if not isinstance(part, Table) or not part.columns or part.show_header is False:
        return 0
    widths = [
        max(cell_len(line) for cell in (heading, *column.cells) for line in str(cell).split("\n"))
        for column in part.columns
        for heading in [getattr(column.header, "renderable", column.header)]
    ]
    shown = [
        width if column.no_wrap else min(width, SHRUNK)
        for width, column in zip(widths, part.columns, strict=True)
    ]
    return sum(shown) + 2 * len(shown)


def title(text: str) -> Text:
    """Return the heading of what follows, an empty line above it."""
    from rich.text import Text

    return Text.assemble("\n", (text, "bold underline"))


def table(*headings: str, left: tuple[str, ...] = (), shrinking: tuple[str, ...] = ()) -> Table:
    """Return an empty table with these headings.

    Headings of several lines end on the same line; the cells of a row begin on the same line.

    Args:
        headings: of the columns, in order.
        left: the columns to be aligned to the left, as text is; the others to the right, as numbers are.
        shrinking: the columns that give way, with an ellipsis, where a terminal is too narrow.
    """
    from rich.align import Align
    from rich.table import Table

    made = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, header_style="bold")
    for heading in headings:
        side: Literal["left", "right"] = "left" if heading in left else "right"
        made.add_column(
            Align(heading, side, vertical="bottom"),
            justify=side,
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
