"""Answers, and the sections of sentences and tables from which their text and pages are rendered."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from types import MappingProxyType
from typing import TYPE_CHECKING, BinaryIO, Final, NamedTuple

from runner.errors import ExitCode

if TYPE_CHECKING:
    from runner.util.values import Json

_NUMBERS: Final = re.compile(
    r"(?<![\w.])[-+]?[\d,]*\.?\d+(e[-+]?\d+)?(?![\w.])|\b(to|never|inf|nan)\b|[][() %,/:;–]"
)
"""What cells of numbers consist of, such as `1,500`, `12 %`, `[0.5, 1]` and `2 to 3`."""

NOT_DRAWN: Final = "`dualtaxi serve` draws the charts."


class Figure(NamedTuple):
    """A picture in a page."""

    picture: str
    """SVG, or an element `img`."""
    caption: str = ""
    """A text below it."""
    title: str = ""
    """A text above it."""
    is_wide: bool = False
    """Whether it takes a whole row."""
    ramp: tuple[float, float] | None = None
    """The values of its darkest and its lightest colour."""


class LegendEntry(NamedTuple):
    """A line of a legend, whose position stands for a colour."""

    letter: str
    """What stands for it in text and figures; may be empty."""
    text: str


class Link(NamedTuple):
    """A link of a page."""

    text: str
    address: str
    """Absolute (`/...`), within the page (`#...`), or relative to a page of the run: others leave it out."""


class Player(NamedTuple):
    """Episodes that a page replays."""

    titles: list[str]
    picture: str
    """The grid at the first frame, as SVG; empty without a scene."""
    key: str
    data: str
    """JSON for `replay.js`."""
    has_frames: bool
    """Whether it has pictures of the environment."""
    is_broad: bool
    """Whether the grid takes a whole row."""


@dataclass(frozen=True)
class Paging:
    """The links below a long table."""

    page: int
    """From 1."""
    rows: int
    """Rows of the whole table."""
    rows_per_page: int
    address: str
    """Address of the first page."""

    @property
    def pages(self) -> int:
        """Number of pages."""
        return max(1, math.ceil(self.rows / self.rows_per_page))

    @property
    def previous(self) -> str:
        """Address of the page before; empty on the first one."""
        return self._address(self.page - 1) if self.page > 1 else ""

    @property
    def next(self) -> str:
        """Address of the next page; empty on the last one."""
        return self._address(self.page + 1) if self.page < self.pages else ""

    @property
    def last(self) -> str:
        """Address of the last page; empty on it."""
        return self._address(self.pages) if self.page < self.pages else ""

    def _address(self, page: int) -> str:
        if page == 1:
            return self.address
        return f"{self.address}{'&' if '?' in self.address else '?'}page={page}"


class SourceFile(NamedTuple):
    """A file of source code."""

    path: str
    state: str
    """How it relates to the commit; empty if the commit has it."""
    text: str


@dataclass(frozen=True)
class Grid:
    """A small table of text."""

    headings: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    title: str = ""
    """Its title in a page, if that is not the section's."""
    links: Sequence[str] = ()
    """The address that each row leads to, as in a `Link`."""
    streams: Sequence[str] = ()
    """The stream of each row, if the rows are lines of output: `stdout`, `stderr` or `note`."""
    paging: Paging | None = None
    """The links to other rows, if the table is a part of a longer one."""
    left: tuple[str, ...] | None = None
    """Headings of the columns that are aligned to the left; None for those with other text than numbers."""
    cut: tuple[str, ...] | None = None
    """Headings of the columns whose cells a narrow terminal cuts, to keep a line a row; None wraps all."""
    spare: tuple[str, ...] = ()
    """Headings of the columns that a narrow terminal leaves out, in this order."""
    gap: int = 2
    """Blanks between columns of text."""
    status: str = ""
    """Heading of the column of statuses, which a page marks."""
    runs: str = ""
    """Heading of the column of run ids, which link to the pages of the runs."""

    @property
    def numeric(self) -> tuple[bool, ...]:
        """Whether each column is aligned to the right, as numbers are."""
        if self.left is not None:
            return tuple(heading not in self.left for heading in self.headings)
        columns: list[list[str]] = [[str(cell) for cell in column] for column in zip(*self.rows, strict=True)]
        return tuple(
            any(column) and not any(_NUMBERS.sub("", cell) for cell in column)
            for column in columns or [[] for _ in self.headings]
        )


@dataclass(frozen=True)
class Section:
    """A title with sentences and tables."""

    title: str
    sentences: list[str] = field(default_factory=list)
    """Paragraphs; a text of several lines is shown as it is."""
    grids: list[Grid] = field(default_factory=list)
    diffs: list[list[str]] = field(default_factory=list)
    """Unified diffs, each as its lines."""
    facts: Mapping[str, str] = field(default_factory=dict)
    """Names and values, alone in their section."""
    figures: Iterable[Figure] = ()
    """Pictures, which are drawn on a page; `NOT_DRAWN` stands for charts in text."""
    layout: str = ""
    """How a page arranges figures, or parts: the class of their element; charts in columns without one."""
    ramp: tuple[float, float] | None = None
    """The values of the darkest and the lightest colour of all figures."""
    legend: Sequence[LegendEntry] = ()
    """The colours of the figures."""
    links: Sequence[Link] = ()
    """Links below the sentences."""
    player: Player | None = None
    parts: Sequence[Section] = ()
    """Sections within it, in a page."""
    is_article: bool = False
    """Whether it stands by itself, such as one of several runs."""
    sources: Sequence[SourceFile] = ()
    """Files, which a page shows whole, and text by their names."""
    is_folded: bool = False
    """Whether a page folds the facts; text leaves them out."""

    @property
    def shown_facts(self) -> dict[str, str]:
        """The facts in text, without empty ones."""
        return {} if self.is_folded else {name: text for name, text in self.facts.items() if text}

    @property
    def tables(self) -> list[Grid]:
        """The tables of the section in text."""
        rows = [(file.path, file.state, f"{file.text.count(chr(10)):,}") for file in self.sources]
        return [*self.grids, *([Grid(("file", "state", "lines"), rows)] if rows else [])]

    @property
    def anchor(self) -> str:
        """The id of the section in a page: its title up to a colon, without blanks."""
        return re.sub(r"\W+", "-", self.title.partition(":")[0].lower()).strip("-")

    @property
    def said(self) -> list[str]:
        """The sentences of the text form."""
        return [*self.sentences, *([NOT_DRAWN] if self.figures and not self.layout else [])]


class Answer:
    """The answer to a question about recorded runs, with everything that a view shows of it."""

    exit_code: int = ExitCode.OK
    limits: Sequence[str] = ()
    """Limits of the answer, a sentence each, printed where a page replaces the text."""
    contents: str = ""
    """What the file holds, in a few words; for a page, and where a file replaces the text."""
    lines: Mapping[str, Iterable[str]] = MappingProxyType({})
    """Forms of the command, such as `csv`, whose lines are printed one by one: there may be very many."""
    remarks: Iterable[str] = ()
    """Sentences that a command prints after the answer in any form."""

    @property
    def hints(self) -> Iterable[str]:
        """Sentences that a command prints below the text, unless it writes the file."""
        return ()

    @property
    def step_to_look_at(self) -> object:
        """The reference of the step to look at next; None if there is none."""
        return None

    def as_json(self) -> Json:
        """Return the answer as JSON can hold it."""
        raise NotImplementedError

    def sections(self) -> Iterable[Section]:
        """Return what people see of the answer."""
        raise NotImplementedError

    def write(self, stream: BinaryIO) -> None:
        """Write the answer as the file that its view offers."""
        raise NotImplementedError

    def _repr_html_(self) -> str:
        return html([*self.sections()])


def markdown(sections: Sequence[Section]) -> Iterator[str]:
    """Yield the lines of sections in Markdown."""
    for section in sections:
        if section.title:
            yield from (f"## {section.title}", "")
        for name, text in section.shown_facts.items():
            yield f"- {name}: {text}".replace("\n", "\\\n  ")
        if section.shown_facts:
            yield ""
        for sentence in section.said:
            yield from _fenced(sentence.splitlines()) if "\n" in sentence else (sentence, "")
        for grid in section.tables:
            yield _row(grid.headings)
            yield _row(tuple("---:" if is_number else "---" for is_number in grid.numeric))
            yield from (_row(row) for row in grid.rows)
            yield ""
        for lines in section.diffs:
            yield from _fenced(lines, "diff")


def _fenced(lines: Sequence[str], language: str = "") -> tuple[str, ...]:
    """Return lines as a block of code."""
    fence = "`" * max([3, *(len(run) + 1 for line in lines for run in re.findall("`{3,}", line))])
    return f"{fence}{language}", *lines, fence, ""


def html(sections: Sequence[Section]) -> str:
    """Return sections as HTML that depends on no style sheet, as notebooks display it."""
    parts = []
    for section in sections:
        parts += [f"<h3>{escape(section.title)}</h3>"] if section.title else []
        if section.shown_facts:
            pairs = "".join(
                f'<tr><th scope="row" style="text-align:left">{escape(name)}</th>'
                f'<td style="text-align:left;white-space:pre-wrap">{escape(text)}</td></tr>'
                for name, text in section.shown_facts.items()
            )
            parts.append(f"<table><tbody>{pairs}</tbody></table>")
        for sentence in section.sentences:
            tag = "pre" if "\n" in sentence else "p"
            parts.append(f"<{tag}>{escape(sentence)}</{tag}>")
        for grid in section.tables:
            sides = [f' style="text-align:{"right" if is_number else "left"}"' for is_number in grid.numeric]
            head = "".join(
                f'<th scope="col"{side}>{escape(heading)}</th>'
                for heading, side in zip(grid.headings, sides, strict=True)
            )
            rows = [
                "".join(f"<td{side}>{escape(cell)}</td>" for cell, side in zip(row, sides, strict=True))
                for row in grid.rows
            ]
            body = "".join(f"<tr>{row}</tr>" for row in rows)
            parts.append(f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>")
        parts += [f"<pre>{escape(chr(10).join(lines))}</pre>" for lines in section.diffs]
        is_row = "split" in section.layout
        figures = [
            f'<figure style="flex: 1; max-width: {22 if is_row and not figure.is_wide else 46}em">'
            f"{figure.picture}</figure>"
            for figure in section.figures
        ]
        if figures:
            parts.append(f'<div style="display: {"flex" if is_row else "block"}">{"".join(figures)}</div>')
    return "\n".join(parts)


def _row(cells: tuple[str, ...]) -> str:
    return "| " + " | ".join(re.sub(r"([\\|*<])", r"\\\1", cell).replace("\n", " ") for cell in cells) + " |"
