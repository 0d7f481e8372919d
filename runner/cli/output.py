"""Print results: JSON on stdout, tables fitted to the terminal, notices on stderr.

All that commands print goes through `echo` and `console`: what is not ours, such as the name of a run, may
hold control characters of terminals, which are shown escaped.
"""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import click

from runner.analysis.sections import markdown
from runner.export.places import require_new
from runner.util.humanize import printable
from runner.util.values import finite

if TYPE_CHECKING:  # imported when something is drawn
    from rich.console import Console, ConsoleOptions, RenderableType
    from rich.segment import Segment
    from rich.table import Table
    from rich.text import Text

    from runner.analysis.sections import Grid, Section

SHRUNK: Final = 10
"""Minimum characters of a shrinking column."""

UNBOUNDED: Final = 1000
"""Width without a terminal."""


def echo(text: object, err: bool = False, nl: bool = True) -> None:
    """Print a text on stdout or stderr."""
    click.echo(printable(str(text)), err=err, nl=nl)


def echo_csv(columns: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
    """Print a table of any length as CSV."""
    sys.stdout.writelines(map(printable, csv_lines(columns, rows)))


def print_json(value: object, indent: int | None = 1) -> None:
    """Print a value as JSON on stdout; None for `indent` makes it one line. NaN and infinity become null."""
    echo(json.dumps(finite(value), indent=indent, allow_nan=False))


def print_result(as_json: bool, value: object, *parts: RenderableType) -> None:
    """Print a result as JSON, or as lines and tables."""
    if as_json:
        print_json(value)
    else:
        draw(*parts)


def json_list(name: str, rows: Iterable[Mapping[str, object]]) -> Iterator[str]:
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


class _Passed:
    """A file for `csv.writer` whose `write` returns the line."""

    @staticmethod
    def write(line: str) -> str:
        return line


def csv_lines(columns: Iterable[str], rows: Iterable[Iterable[object]]) -> Iterator[str]:
    """Yield the lines of a table as CSV, the headings first."""
    write = csv.writer(_Passed(), lineterminator="\n").writerow
    yield write(columns)
    yield from map(write, rows)


def print_written(text: str, as_json: bool, *paths: Path, **more: object) -> None:
    """Print what a command wrote: a text, or an object with the list `files`, of each its path and bytes.

    All files of a folder are listed; `more` are further keys of the object.
    """
    if as_json:
        print_json({"files": files_written(*paths)} | more)
    else:
        echo(text)


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


def draw(*parts: RenderableType) -> None:
    """Print tables and lines on stdout; without trailing blanks unless stdout is a terminal."""
    drawn = console()
    if drawn.is_terminal:
        for part in parts:
            # The terminal wraps lines that are too long: no number is truncated.
            drawn.print(part, width=max(drawn.width, _least_width(part)), crop=False)
        return
    with drawn.capture() as captured:
        for part in parts:
            drawn.print(part)
    echo("\n".join(line.rstrip() for line in captured.get().splitlines()))


def _least_width(part: RenderableType) -> int:
    """Return the width at which only the shrinking columns of a table are truncated."""
    from rich.cells import cell_len
    from rich.table import Table

    if not isinstance(part, Table) or not part.columns or part.show_header is False:
        return 0
    widths = [
        max(cell_len(line) for cell in (heading, *column.cells) for line in printable(str(cell)).split("\n"))
        for column in part.columns
        for heading in [getattr(column.header, "renderable", column.header)]
    ]
    shown = [
        width if column.no_wrap else min(width, SHRUNK)
        for width, column in zip(widths, part.columns, strict=True)
    ]
    return sum(shown) + 2 * len(shown)


def title(text: str) -> Text:
    """Return a heading with an empty line above it."""
    from rich.text import Text

    return Text.assemble("\n", (text, "bold underline"))


def table(
    *headings: str,
    rows: Iterable[Iterable[str]] = (),
    left: tuple[str, ...] = (),
    shrinking: tuple[str, ...] = (),
) -> Table:
    """Return a table of rows; cells of a row and headings of several lines are aligned.

    Columns whose headings are in `left` are aligned to the left, as text is, others to the right; those in
    `shrinking` are truncated where a terminal is too narrow.
    """
    return _table([(heading, heading in left, heading in shrinking) for heading in headings], rows)


def grid_table(grid: Grid, shrinking: bool = False) -> Table:
    """Return a grid as a table, numbers aligned to the right; its columns may shrink on a narrow terminal."""
    columns = zip(grid.headings, grid.numeric, strict=True)
    return _table([(heading, not is_number, shrinking) for heading, is_number in columns], grid.rows)


def _table(columns: Sequence[tuple[str, bool, bool]], rows: Iterable[Iterable[str]]) -> Table:
    """Return a table of columns: heading, whether it is aligned to the left, whether it may shrink."""
    from rich.align import Align
    from rich.table import Table

    drawn = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, header_style="bold")
    for heading, is_left, shrinks in columns:
        side: Literal["left", "right"] = "left" if is_left else "right"
        header = Align(heading, side, vertical="bottom")
        drawn.add_column(header, justify=side, overflow="ellipsis", no_wrap=not shrinks)
    for row in rows:
        drawn.add_row(*row)
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


def aligned(lines: Sequence[Sequence[str]], left: Sequence[bool]) -> list[str]:
    """Return lines of cells aligned in columns; far quicker than a table where there are many."""
    lines = [[on_one_line(cell) for cell in line] for line in lines]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    columns = list(zip(widths, left, strict=True))
    return [
        "  ".join(
            cell.ljust(width) if is_left else cell.rjust(width)
            for cell, (width, is_left) in zip(line, columns, strict=True)
        ).rstrip()
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


# --- sections of comparisons ------------------------------------------------------------------------------


def print_sections(sections: Sequence[Section], as_markdown: bool) -> None:
    """Print sections as tables, or as Markdown."""
    if as_markdown:
        echo("\n".join(markdown(sections)))
        return
    for section in sections:
        draw(facts(section.facts) if section.facts else title(section.title), *section.sentences)
        for part in section.grids:
            draw(grid_table(part, shrinking=console().is_terminal))
        for lines in section.diffs:
            draw(patch_text(lines))


def require_page(path: Path, force: bool) -> None:
    """Refuse a page that could not be written in the end, before anything is computed."""
    from runner.export.reports.report import require_packages

    require_packages()
    require_new(path, force)
