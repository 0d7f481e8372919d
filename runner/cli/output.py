"""Print replies: JSON on stdout, tables fitted to the terminal, notices on stderr.

All that commands print goes through `echo` and `console`: what is not ours, such as the name of a run, may
hold control characters of terminals, which are shown escaped.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import click

from runner.analysis.sections import Grid, Section, markdown
from runner.errors import ExitCode
from runner.util.files import require_new
from runner.util.humanize import printable, size
from runner.util.values import finite

if TYPE_CHECKING:  # imported when something is drawn
    from rich.console import Console, ConsoleOptions, RenderableType
    from rich.segment import Segment
    from rich.table import Table
    from rich.text import Text

_LEAST: Final = {"cut": 14, "wrapped": 10}
"""Characters that a column keeps where it does not fit a terminal."""

_FORCING: Final = frozenset({"FORCE_COLOR", "TTY_COMPATIBLE"})

MAX_DRAWN: Final = 1000
"""Rows drawn in the style of a terminal, which takes a second for every few thousand."""

UNBOUNDED: Final = 1 << 16
"""Width without a terminal: more than the longest line of a run's output."""


def echo(text: object, err: bool = False, nl: bool = True) -> None:
    """Print a text on stdout or stderr."""
    click.echo(printable(str(text)), err=err, nl=nl)


class Remark(str):
    """A part of a reply's text that goes to stderr."""

    __slots__ = ()


Part = str | Mapping[str, str] | Grid | Section
"""What a reply's text consists of: lines, names and values, tables, sections."""


@dataclass(frozen=True)
class Reply:
    """What a command replies. Only the form that is printed is iterated over."""

    data: Mapping[str, object] | Callable[[], Mapping[str, object]] | None = None
    """What --json prints: an object, or a function that returns one; None for nothing."""
    text: Iterable[Part] = ()
    lines: Mapping[str, Iterable[str]] = field(default_factory=dict)
    """Lines of forms, `text` among them, that are printed as they are; for what is too long to be held."""
    page: str = ""
    """A line about a page that was written: it stands for the text, and goes to stderr in other forms."""
    notes: Iterable[str] = ()
    """Notices on stderr, after the reply in any form."""
    exit_code: int = ExitCode.OK


def print_replies(replies: Reply | Iterable[Reply], form: str = "text") -> int:
    """Print the replies of a command in a form, each as soon as it is there; return the exit code."""
    code = 0
    for reply in [replies] if isinstance(replies, Reply) else replies:
        if reply.page:
            echo(reply.page, err=form != "text")
        if form in reply.lines:
            sys.stdout.writelines(map(printable, reply.lines[form]))
        elif form == "json":
            if reply.data is not None:
                data = reply.data() if callable(reply.data) else reply.data
                echo(json.dumps(finite(data), indent=1))
        elif form == "markdown":
            for part in reply.text:
                if isinstance(part, Remark):
                    say(part)
                elif part:
                    echo("\n".join(markdown([_as_section(part)])))
        elif not reply.page:
            for number, part in enumerate(reply.text):
                draw(part, is_first=not number)
        sys.stdout.flush()
        for note in reply.notes:
            say(note)
        code = max(code, reply.exit_code)
    return code


def written(text: str, *paths: Path, **more: object) -> Reply:
    """Return what a command wrote: a text, or an object with the list `files`, of each its path and bytes.

    All files of a folder are listed; `more` are further keys of the object.
    """
    return Reply({"files": files_written(*paths)} | more, [text])


def path_and_size(path: Path) -> str:
    """Return the path of a file and its size as a text."""
    return f"{path}  {size(path.stat().st_size)}"


def files_written(*paths: Path) -> list[dict[str, object]]:
    """Return path and bytes of each file; of a folder those of all its files."""
    files = [file for path in paths for file in (sorted(path.rglob("*")) if path.is_dir() else [path])]
    return [{"path": str(file.absolute()), "bytes": file.stat().st_size} for file in files if file.is_file()]


def say(text: str) -> None:
    """Print a notice on stderr."""
    echo(text, err=True)


@cache
def _console_type() -> type[Console]:
    from rich.console import Console

    class SafeConsole(Console):
        """A console that shows the control characters in a text."""

        def render_str(self, text: str, **options: Any) -> Text:
            """Render a text; here, so that a column is wide enough."""
            return super().render_str(printable(text), **options)

        def render(
            self, renderable: RenderableType, options: ConsoleOptions | None = None
        ) -> Iterator[Segment]:
            """Yield the segments of anything; those of control codes are the library's own."""
            for segment in super().render(renderable, options):
                yield segment if segment.control else segment._replace(text=printable(segment.text))

    return SafeConsole


def console(stderr: bool = False) -> Console:
    """Return the console of a stream: colours on a terminal only, and lines of any length elsewhere."""
    drawn = _console_type()(stderr=stderr, highlight=False, markup=False, emoji=False)
    if not drawn.is_terminal:
        drawn.width = UNBOUNDED
    return drawn


def draw(part: Part, is_first: bool = False) -> None:
    """Print a part of a text on stdout, a remark on stderr; facts that come first need no title."""
    if isinstance(part, Remark):
        say(part)
        return
    if isinstance(part, str):
        echo(part)
        return
    section = _as_section(part)
    pairs = section.shown_facts
    heading = [title(section.title)] if section.title and not (pairs and is_first) else []
    _render(*heading, *([facts(pairs)] if pairs else []))
    for sentence in section.said:
        if "\n" in sentence:
            echo(sentence)
        else:
            _render(sentence)
    # Without a terminal, and a variable that makes Rich take stdout for one, Rich is not loaded.
    may_be_terminal = sys.stdout.isatty() or not _FORCING.isdisjoint(os.environ)
    for grid in section.tables:
        if may_be_terminal and len(grid.rows) <= MAX_DRAWN and (terminal := console()).is_terminal:
            _render(grid_table(grid, terminal.width))
        else:
            echo("\n".join(aligned(grid)))
    _render(*map(patch_text, section.diffs))


def _as_section(part: str | Mapping[str, str] | Grid | Section) -> Section:
    if isinstance(part, Section):
        return part
    if isinstance(part, Grid):
        return Section("", grids=[part])
    return Section("", [part]) if isinstance(part, str) else Section("", facts=part)


def _render(*parts: RenderableType) -> None:
    """Print on stdout what Rich draws; without trailing blanks unless stdout is a terminal."""
    if not parts:
        return
    drawn = console()
    if drawn.is_terminal:
        width = drawn.width
        for part in parts:
            # The terminal wraps lines that are too long: no number is truncated.
            drawn.width = max(width, getattr(part, "min_width", None) or 0)
            drawn.print(part, crop=False)
        return
    with drawn.capture() as captured:
        for part in parts:
            drawn.print(part)
    echo("\n".join(line.rstrip() for line in captured.get().splitlines()))


def title(text: str) -> Text:
    """Return a heading with an empty line above it."""
    from rich.text import Text

    return Text.assemble("\n", (text, "bold underline"))


def grid_table(grid: Grid, width: int) -> Table:
    """Return a grid as a table for a terminal of a width, without the spare columns for which it has no room.

    Cells of a row and headings of several lines are aligned. Where a cell is not whole, the width of the
    terminal is taken from the columns that may be cut or wrapped, but the table is at least `min_width` wide.
    """
    from rich.align import Align
    from rich.cells import cell_len
    from rich.table import Table
    from rich.text import Text

    cut = grid.headings if grid.cut is None else grid.cut
    least: list[int] = []
    left_out: list[str] = []
    for heading, *cells in zip(grid.headings, *grid.rows, strict=True):
        longest = max(cell_len(line) for cell in (heading, *cells) for line in printable(cell).split("\n"))
        least.append(
            min(longest, _LEAST["wrapped" if grid.cut is None else "cut"]) if heading in cut else longest
        )
    columns_kept = [*range(len(least))]
    needed = sum(least) + grid.gap * (len(least) - 1)
    for heading in filter(grid.headings.__contains__, grid.spare):
        if needed > width:
            number = grid.headings.index(heading)
            needed -= least[number] + grid.gap
            columns_kept.remove(number)
            left_out.append(heading)
    drawn = Table(
        box=None,
        padding=(0, grid.gap, 0, 0),
        pad_edge=False,
        header_style="bold",
        caption=f"No room for: {', '.join(left_out)}.".replace("\n", " ") if left_out else None,
        caption_justify="left",
        min_width=needed,
    )
    numeric = grid.numeric
    for number in columns_kept:
        heading = grid.headings[number]
        side: Literal["left", "right"] = "right" if numeric[number] else "left"
        header = Align(heading, side, vertical="bottom")
        drawn.add_column(header, justify=side, overflow="ellipsis", no_wrap=heading not in cut)
    for row in grid.rows:
        drawn.add_row(
            *(
                Text(on_one_line(row[number]), no_wrap=True)
                if grid.cut and grid.headings[number] in cut
                else printable(row[number])
                for number in columns_kept
            )
        )
    return drawn


def facts(pairs: Mapping[str, str]) -> Table:
    """Return a table of names and values, without those that are empty."""
    from rich.table import Table

    grid = Table.grid(padding=(0, 2, 0, 0))
    grid.add_column(style="bold", no_wrap=True)
    grid.add_column(overflow="fold")
    for name, text in pairs.items():
        if text:
            grid.add_row(name, text)
    return grid


def aligned(grid: Grid) -> list[str]:
    """Return the lines of a grid, a line for each row; far quicker than a table where there are many."""
    headings = [heading.split("\n") for heading in grid.headings]
    height = max(map(len, headings), default=0)
    columns = [[*[""] * (height - len(lines)), *lines] for lines in headings]
    lines = [[on_one_line(cell) for cell in line] for line in (*zip(*columns, strict=True), *grid.rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    sides = list(zip(widths, grid.numeric, strict=True))
    return [
        (" " * grid.gap)
        .join(
            cell.rjust(width) if is_number else cell.ljust(width)
            for cell, (width, is_number) in zip(line, sides, strict=True)
        )
        .rstrip()
        for line in lines
    ]


def patch_text(lines: Iterable[str]) -> Text:
    """Return the lines of a patch, coloured."""
    from rich.text import Text

    text = Text()
    for line in lines:
        is_head = line.startswith(("diff ", "--- ", "+++ ", "@@"))
        style = "bold" if is_head else {"+": "green", "-": "red"}.get(line[:1], "")
        text.append(printable(line) + "\n", style)
    return text


def on_one_line(text: str) -> str:
    """Return a text as a cell of a table that has a line for each row."""
    return printable(text.replace("\n", " ").replace("\t", " "))


def require_page(path: Path, force: bool) -> None:
    """Refuse a page that could not be written in the end, before anything is computed."""
    from runner.export.reports.report import require_packages

    require_packages()
    require_new(path, force)
