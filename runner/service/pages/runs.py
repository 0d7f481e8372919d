"""The table of runs, searched, sorted and with chosen columns, a page at a time; their use of the disk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from http import HTTPStatus
from typing import Annotated, Final, Literal, NamedTuple

from fastapi import APIRouter, Query, Response
from fastapi.responses import RedirectResponse

from runner.analysis.sections import Paging
from runner.analysis.summary import usage_sections
from runner.errors import RunnerError
from runner.runs.catalogue.columns import (
    FIELDS,
    HEADINGS,
    LEFT_KINDS,
    SETTING,
    ColumnKind,
    IndexRow,
    as_text,
    columns_of,
    field_of,
)
from runner.runs.catalogue.filters import Filter, parse
from runner.runs.catalogue.index import CatalogueIndex, order_of
from runner.runs.catalogue.usage import usage_of
from runner.service.catalogue import Catalogue
from runner.service.computed import link
from runner.service.dependencies import CatalogueOf, JobsOf, SettingsOf
from runner.service.pages.rendering import Page
from runner.views.runs import LS

router = APIRouter(include_in_schema=False)

USUAL: Final = (
    "id",
    "name",
    "seed",
    "status",
    "tag",
    "episodes",
    "success_percent",
    "mean_length",
    "bytes",
    "age",
)
FOLDED: Final = ("id", "seed", "tag", "episodes", "mean_length", "bytes", "age")
"""Columns that a narrow screen leaves out, unless the columns were chosen."""
ROWS: Final = 50
_FALLING: Final = (ColumnKind.NUMBER, ColumnKind.SIZE, ColumnKind.DATE)
"""Kinds whose largest values come first after a click on the heading."""


class Heading(NamedTuple):
    """The heading of a column."""

    text: str
    meaning: str
    kind: str
    """CSS classes."""
    sorted: str | None
    """`ascending` or `descending` if the rows are sorted by it."""
    address: str
    """The address of the table sorted by it; empty if it cannot be."""


RunCell = tuple[str, str, str]
"""Text and address of a cell, and what a branch changed, shown after its name."""


@dataclass(frozen=True)
class RunsTable:
    """The rows of a page."""

    headings: list[Heading]
    rows: list[tuple[IndexRow, int, list[RunCell]]]
    """A run, or the first one of all runs of a name; the number of runs that it stands for; its cells."""
    total: int
    """Runs that match the filter."""
    all_runs: int
    paging: Paging
    other_grouping: str
    """The address of the same runs, grouped by name if they are not, else one a row; empty with a filter."""


@router.get("/")
def home() -> Response:
    """Redirect to the runs."""
    return RedirectResponse("/runs", HTTPStatus.FOUND)


@router.get("/runs")
def runs(
    catalogue: CatalogueOf,
    filter: Annotated[str, Query(max_length=3000)] = "",  # noqa: A002
    sort: Annotated[str, Query(max_length=1000)] = "",
    columns: Annotated[list[str] | None, Query(max_length=100)] = None,
    group: Literal["name", "none"] = "name",
    page: Annotated[int, Query(ge=1, lt=10**8)] = 1,
) -> Response:
    """Show the runs that match a filter; without one, those of a name in a row."""
    by_name = group == "name" and not filter
    try:
        values = _values(catalogue, filter, sort, ",".join(columns or ()), by_name, page)
    except RunnerError as error:
        values = _search(filter, "", USUAL, "", None, error)
    return Page("runs.html", values)


@router.get("/disk")
def disk(catalogue: CatalogueOf, settings: SettingsOf, jobs: JobsOf) -> Response:
    """Show the use of the disk, and what could be freed."""
    largest, sums = usage_of(catalogue.read, Filter(None), ROWS)
    usage = list(usage_sections(largest, sums, sums.freeable(settings.recordings))) if largest else []
    return Page("disk.html", {"total": sums.bytes, "free": jobs.status().free_bytes, "usage": usage})


def _values(
    catalogue: Catalogue, text: str, sort: str, columns: str, by_name: bool, number: int
) -> dict[str, object]:
    condition, order = parse(text), order_of(sort)
    names_shown = columns_of(columns) if columns.strip(", ") else list(USUAL)
    is_usual = list(names_shown) == list(USUAL)

    def work(index: CatalogueIndex) -> tuple[list[tuple[IndexRow, int]], int, int, int]:
        offset, all_runs = (number - 1) * ROWS, index.count()
        if by_name:
            named, names = index.page_by_name(sort, limit=ROWS, offset=offset)
            return named, names, all_runs, all_runs
        shown_rows, total = index.page(condition, *order, limit=ROWS, offset=offset)
        return [(row, 1) for row in index.with_same_as(shown_rows)], total, total, all_runs

    counted, pages_of, total, all_runs = catalogue.read(work)
    rows = [row for row, _ in counted]
    grouping = "" if by_name or text else "none"
    query = {
        "filter": text,
        "sort": sort,
        "columns": "" if is_usual else ",".join(names_shown),
        "group": grouping,
    }
    if is_usual and any(row["mean_return"] is not None for row in rows):
        names_shown = [
            *names_shown[: names_shown.index("mean_length")],
            "mean_return",
            *names_shown[names_shown.index("mean_length") :],
        ]
    folded = FOLDED if is_usual else ()
    table = RunsTable(
        headings=[_heading(column, query, column in folded) for column in names_shown],
        rows=[(row, runs, [_cell(row, column, runs) for column in names_shown]) for row, runs in counted],
        total=total,
        all_runs=all_runs,
        paging=Paging(number, pages_of, ROWS, link("/runs", query)),
        other_grouping="" if text else link("/runs", {**query, "group": "none" if by_name else "name"}),
    )
    return _search(text, sort, names_shown, query["columns"], table)


def _search(
    text: str, sort: str, shown: Sequence[str], query: str, table: RunsTable | None, problem: object = ""
) -> dict[str, object]:
    """Return the values of the page; `query` has the columns as the address contains them."""
    names = dict.fromkeys([*(column for column in shown if column in FIELDS), *FIELDS])
    fields = [(name, HEADINGS.get(name, name).replace("_", " "), FIELDS[name].meaning) for name in names]
    settings = [column for column in shown if column.startswith(SETTING)]
    return {
        "filter": text,
        "sort": sort,
        "columns": shown,
        "columns_query": query,
        "table": table,
        "problem": problem,
        "fields": fields,
        "lead": LS.lead,
        "settings": settings,
    }


def _heading(column: str, query: Mapping[str, str], folded: bool) -> Heading:
    is_setting = column.startswith(SETTING)
    is_sortable = is_setting or column in FIELDS
    kind = ColumnKind.NUMBER if is_setting or not is_sortable else field_of(column).kind
    rising, falling = column, f"-{column}"
    first, second = (falling, rising) if kind in _FALLING and not is_setting else (rising, falling)
    return Heading(
        text=HEADINGS.get(column, column).replace("_", " "),
        meaning="" if is_setting or not is_sortable else field_of(column).meaning,
        kind=" ".join(["text"] * (not is_setting and kind in LEFT_KINDS) + ["fold"] * folded),
        sorted={rising: "ascending", falling: "descending"}.get(query["sort"]),
        address=link("/runs", {**query, "sort": second if query["sort"] == first else first})
        if is_sortable
        else "",
    )


def _cell(row: IndexRow, column: str, runs: int) -> RunCell:
    """Return a cell of a run; where it stands for several, their name leads to them."""
    text, address, note = as_text(row, column), "", ""
    if column == "name" and runs > 1:
        text, address = f"{text} ({runs:,} runs)", link("/runs", {"filter": f"name == {row['name']!r}"})
    elif column in ("id", "name"):
        address = f"/runs/{row['id']}"
        note = as_text(row, "change") if column == "name" else ""
    elif column == "same_as" and row["same_as"]:
        address = f"/runs/{row['same_as']}"
    return text[:16] if column == "digest" else text, address, note
