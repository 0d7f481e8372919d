"""Print replies: JSON on stdout, tables fitted to the terminal, notices on stderr.

All that commands print goes through `echo` and `console`: what is not ours, such as the name of a run, may
hold control characters of terminals, which are shown escaped.
"""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import click

from runner.analysis.sections import NOT_DRAWN, Grid, Section, markdown
from runner.errors import ExitCode
from runner.export.places import require_new
from runner.util.humanize import printable
from runner.util.values import finite

if TYPE_CHECKING:  # imported when something is drawn
    from rich.console import Console, ConsoleOptions, RenderableType
    from rich.segment import Segment
    from rich.table import Table
    from rich.text import Text

SHRUNK: Final = 10
"""Minimum characters of a shrinking column."""

UNBOUNDED: Final = 1 << 16
"""Width without a terminal: more than the longest line of a run's output."""


def echo(text: object, err: bool = False, nl: bool = True) -> None:
    """Print a text on stdout or stderr."""
    click.echo(printable(str(text)), err=err, nl=nl)


class Remark(str):
    """A part of a reply's text that goes to stderr."""

    __slots__ = ()


if TYPE_CHECKING:
    Part = str | Mapping[str, str] | Grid | Section | RenderableType
    """What a reply's text consists of: lines, names and values, tables, sections."""


@dataclass(frozen=True)
class Reply:
    """What a command replies. Only the form that is printed is iterated over."""

    data: Mapping[str, object] | Callable[[], Mapping[str, object]] | Iterable[str] = ()
    """What --json prints: an object, a function that returns one, or the parts of a text."""
    text: Iterable[Part] = ()
    csv: Iterable[str] = ()
    """Lines of CSV, which stand for the text where there is none."""
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
        if form == "json":
            data = reply.data() if callable(reply.data) else reply.data
            parts = [json.dumps(finite(data), indent=1) + "\n"] if isinstance(data, Mapping) else data
            sys.stdout.writelines(map(printable, parts))
        elif form == "markdown":
            text = [*reply.text]
            echo("\n".join(markdown([part for part in text if isinstance(part, Section)])))
            draw(*[part for part in text if isinstance(part, Remark)])
        elif form == "csv" or reply.text == ():
            sys.stdout.writelines(map(printable, reply.csv))
        elif not reply.page:
            for part in reply.text:
                draw(part)
        sys.stdout.flush()
        for note in reply.notes:
            say(note)
        code = max(code, reply.exit_code)
    return code


def json_lines(rows: Iterable[object]) -> Iterator[str]:
    """Yield values as JSON, a line each. NaN and infinity become null."""
    return (json.dumps(finite(row), allow_nan=False) + "\n" for row in rows)


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


def written(text: str, *paths: Path, **more: object) -> Reply:
    """Return what a command wrote: a text, or an object with the list `files`, of each its path and bytes.

    All files of a folder are listed; `more` are further keys of the object.
    """
    return Reply({"files": files_written(*paths)} | more, [text])


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


def draw(*parts: Part) -> None:
    """Print lines and tables on stdout, remarks on stderr."""
    for part in parts:
        if isinstance(part, Remark):
            say(part)
        elif isinstance(part, str):
            echo(part)
        elif isinstance(part, Section):
            has_facts = part.facts and not part.is_folded
            _render(facts(part.facts) if has_facts else title(part.title), *part.sentences)
            draw(*part.tables, *map(patch_text, part.diffs), *([NOT_DRAWN] if part.charts else []))
        elif isinstance(part, Mapping):
            _render(facts(part))
        elif isinstance(part, Grid):
            _render(grid_table(part))
        else:
            _render(part)


def _render(*parts: RenderableType) -> None:
    """Print on stdout what Rich draws; without trailing blanks unless stdout is a terminal."""
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
    from rich.align import Align
    from rich.table import Table

    drawn = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, header_style="bold")
    for heading in headings:
        side: Literal["left", "right"] = "left" if heading in left else "right"
        header = Align(heading, side, vertical="bottom")
        drawn.add_column(header, justify=side, overflow="ellipsis", no_wrap=heading not in shrinking)
    for row in rows:
        drawn.add_row(*row)
    return drawn


def grid_table(grid: Grid) -> Table:
    """Return a grid as a table, numbers aligned to the right; its columns shrink on a narrow terminal."""
    columns = zip(grid.headings, grid.numeric, strict=True)
    left = tuple(heading for heading, is_number in columns if not is_number)
    shrinking = grid.headings if console().is_terminal else ()
    return table(*grid.headings, rows=grid.rows, left=left, shrinking=shrinking)


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


def require_page(path: Path, force: bool) -> None:
    """Refuse a page that could not be written in the end, before anything is computed."""
    from runner.export.reports.report import require_packages

    require_packages()
    require_new(path, force)
