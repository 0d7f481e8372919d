"""Runs: listed, searched, told all about, labelled."""

from __future__ import annotations

import json
from http import HTTPStatus
from typing import TYPE_CHECKING, Annotated, Any

from fastapi import APIRouter, Query, Request, Response
from pydantic import BaseModel

from runner.catalogue.columns import PROGRAMS, as_json, columns_of, with_originals
from runner.catalogue.filters import parse
from runner.catalogue.index import order_of
from runner.service.dependencies import CatalogueOf, KeptOf, SettingsOf
from runner.service.problems import Refused, answers

if TYPE_CHECKING:
    from runner.catalogue.index import Index

router = APIRouter(tags=["runs"])


class RunsPage(BaseModel):
    """Some of the runs that fit."""

    runs: list[dict[str, Any]]
    """Each by column, as `dualtaxi ls --json` tells of it."""
    total: int
    """How many fit."""
    offset: int
    limit: int


@router.get(
    "/runs",
    response_model=RunsPage,
    responses=answers(HTTPStatus.BAD_REQUEST),
    summary="List the runs that fit a filter, the newest first.",
)
async def list_runs(
    request: Request,
    catalogue: CatalogueOf,
    kept: KeptOf,
    settings: SettingsOf,
    filter: Annotated[str, Query(max_length=10_000, description="As `dualtaxi ls` takes it.")] = "",  # noqa: A002
    sort: Annotated[str, Query(max_length=1000, description="Fields; `-FIELD`: the largest first.")] = "",
    columns: Annotated[str, Query(max_length=4000, description="Fields to tell; else the usual ones.")] = "",
    limit: Annotated[int, Query(ge=0)] = 50,
    offset: Annotated[int, Query(ge=0, lt=2**31)] = 0,
) -> Response:
    """List runs as `dualtaxi ls` does."""
    if limit > settings.limits.page_runs:
        raise Refused(
            HTTPStatus.UNPROCESSABLE_ENTITY,
            f"query.limit: found {limit}, expected at most {settings.limits.page_runs}; use offset.",
        )

    def make() -> bytes:
        chosen, order = parse(filter), order_of(sort)
        shown = columns_of(columns) if columns else PROGRAMS

        def work(index: Index) -> dict[str, Any]:
            rows = with_originals(index.select(chosen, *order, limit=limit, offset=offset), index)
            runs = [as_json(row, shown) for row in rows]
            return {"runs": runs, "total": index.count(chosen), "offset": offset, "limit": limit}

        return json.dumps(catalogue.read(work), ensure_ascii=False).encode()

    key = ("runs", catalogue.version(), request.url.query)
    return Response(await kept.answer(key, make), media_type="application/json")
