"""The table of runs: searched, sorted, its columns chosen, a page at a time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from http import HTTPStatus
from typing import TYPE_CHECKING, Annotated, Any, Final

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import RedirectResponse

from runner.errors import RunnerError
from runner.runs.catalogue.columns import FIELDS, HEADINGS, SETTING, Kind, as_text, columns_of, field_of
from runner.runs.catalogue.filters import Filter, parse
from runner.runs.catalogue.index import order_of
from runner.service.dependencies import CacheOf, CatalogueOf
from runner.service.pages.problems import message_of
from runner.service.pages.rendering import Viewer, link, render, viewer_of

if TYPE_CHECKING:
    from runner.runs.catalogue.index import Index
    from runner.service.catalogue import Catalogue

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
FOLDED: Final = ("id", "seed", "tag", "episodes")
"""Columns that a narrow screen leaves out, unless the columns were chosen."""
ROWS: Final = 50
_LEFT: Final = (Kind.START, Kind.TEXT, Kind.STATUS, Kind.PROSE, Kind.TAGS, Kind.DATE)
_FALLING: Final = (Kind.NUMBER, Kind.SIZE, Kind.DATE)
"""Of these the largest come first when a heading is clicked."""


@router.get("/")
def home() -> Response:
    """Lead to the runs."""
    return RedirectResponse("/runs", HTTPStatus.FOUND)


@router.get("/runs")
async def runs(
    request: Request,
    catalogue: CatalogueOf,
    cache: CacheOf,
    filter: Annotated[str, Query(max_length=3000)] = "",  # noqa: A002
    sort: Annotated[str, Query(max_length=1000)] = "",
    columns: Annotated[list[str] | None, Query(max_length=100)] = None,
    page: Annotated[int, Query(ge=1, lt=10**8)] = 1,
) -> Response:
    """Show the runs that fit a filter."""
    status = HTTPStatus.OK

    viewer = viewer_of(request)

    def make() -> bytes:
        return _page(catalogue, filter, sort, ",".join(columns or ()), page, viewer)

    try:
        body = await cache.get_or_make(("runs page", catalogue.state(), request.url.query, viewer), make)
    except RunnerError as error:
        status = HTTPStatus.BAD_REQUEST
        told = _frame(filter, "", USUAL) | {"problem": message_of(error, request), "rows": [], "total": None}
        body = render("/runs", "runs.html", viewer, **told)
    return Response(body, status, media_type="text/html")


def _page(catalogue: Catalogue, text: str, sort: str, columns: str, number: int, viewer: Viewer) -> bytes:
    chosen, order = parse(text), order_of(sort)
    shown = columns_of(columns) if columns.strip(", ") else list(USUAL)

    def work(index: Index) -> tuple[list[dict[str, Any]], int, int]:
        found, total = index.page(chosen, *order, limit=ROWS, offset=(number - 1) * ROWS)
        return index.with_same_as(found), total, index.count(Filter(None)) if text else total

    rows, total, everything = catalogue.read(work)
    asked = {"filter": text, "sort": sort, "columns": _asked(shown)}
    folded = FOLDED if list(shown) == list(USUAL) else ()
    if folded and any(row["mean_return"] is not None for row in rows):
        shown = [*shown[: shown.index("mean_length")], "mean_return", *shown[shown.index("mean_length") :]]
    return render(
        "/runs",
        "runs.html",
        viewer,
        **_frame(text, sort, shown) | {"asked_columns": asked["columns"]},
        problem="",
        total=total,
        everything=everything,
        heads=[_head(column, asked, column in folded) for column in shown],
        rows=[
            {"id": row["id"], "cells": [_cell(row, column, column in folded) for column in shown]}
            for row in rows
        ],
        page=number,
        pages=math.ceil(total / ROWS),
        turned=lambda to: link("/runs", asked | {"page": to if to > 1 else ""}),
    )


def _frame(text: str, sort: str, shown: Sequence[str]) -> dict[str, Any]:
    """Return what stands around the rows: the columns that are shown first, in their order."""
    known = [column for column in shown if column in FIELDS]
    return {
        "filter": text,
        "sort": sort,
        "columns": shown,
        "asked_columns": _asked(shown),
        "settings": [column for column in shown if column.startswith(SETTING)],
        "fields": [(name, FIELDS[name].meaning) for name in dict.fromkeys([*known, *FIELDS])],
        "headings": HEADINGS,
    }


def _asked(shown: Sequence[str]) -> str:
    """Return the columns as an address has them; nothing if they are the usual ones."""
    return "" if list(shown) == list(USUAL) else ",".join(shown)


def _head(column: str, asked: dict[str, Any], folded: bool) -> dict[str, Any]:
    """Return a heading: what a click on it sorts by, and whether the rows are sorted by it now."""
    setting = column.startswith(SETTING)
    known = setting or column in FIELDS
    kind = Kind.NUMBER if setting or not known else field_of(column).kind
    now = asked["sort"]
    first = f"-{column}" if kind in _FALLING and not setting else column
    other = column if first.startswith("-") else f"-{column}"
    return {
        "heading": HEADINGS.get(column, column).replace("_", " "),
        "meaning": "" if setting or not known else field_of(column).meaning,
        "kind": _classes(not setting and kind in _LEFT, folded),
        "sorted": {column: "ascending", f"-{column}": "descending"}.get(now),
        "href": link("/runs", asked | {"sort": other if now == first else first}) if known else "",
    }


def _classes(left: bool, folded: bool) -> str:
    return " ".join(name for name, holds in (("text", left), ("fold", folded)) if holds)


def _cell(row: dict[str, Any], column: str, folded: bool) -> dict[str, Any]:
    kind = _classes(column in FIELDS and field_of(column).kind in _LEFT, folded)
    href = f"/runs/{row['id']}" if column in ("id", "name") else ""
    if column == "same_as" and row["same_as"]:
        href = f"/runs/{row['same_as']}"
    text = as_text(row, column)
    if column == "digest":
        text = text[:16]
    return {"text": text, "kind": kind, "href": href, "status": column == "status"}
