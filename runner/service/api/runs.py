"""Runs: listed, searched, told all about, labelled."""

from __future__ import annotations

import json
from http import HTTPStatus
from typing import TYPE_CHECKING, Annotated, Any

from fastapi import APIRouter, Query, Request, Response
from pydantic import BaseModel, Field

from runner.analysis.summary import describe_run
from runner.recording.labels import MAX_NOTE, MAX_TAGS
from runner.runs.catalogue.columns import DEFAULT_JSON, columns_of
from runner.runs.catalogue.columns import as_json as row_as_json
from runner.runs.catalogue.filters import parse
from runner.runs.catalogue.index import order_of
from runner.runs.run import Run, label
from runner.service.catalogue import Catalogue
from runner.service.computed import as_json
from runner.service.dependencies import CacheOf, CatalogueOf, FoundRun, SettingsOf
from runner.service.errors import Refused
from runner.service.problems import error_docs

if TYPE_CHECKING:
    from runner.runs.catalogue.index import Index
    from runner.service.settings import Settings

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
    responses=error_docs(HTTPStatus.BAD_REQUEST),
    summary="List the runs that fit a filter, the newest first.",
)
async def list_runs(
    request: Request,
    catalogue: CatalogueOf,
    cache: CacheOf,
    settings: SettingsOf,
    filter: Annotated[str, Query(max_length=3000, description="As `dualtaxi ls` takes it.")] = "",  # noqa: A002
    sort: Annotated[str, Query(max_length=500, description="Fields; `-FIELD`: the largest first.")] = "",
    columns: Annotated[str, Query(max_length=1500, description="Fields to tell; else the usual ones.")] = "",
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
        shown = columns_of(columns) if columns else DEFAULT_JSON

        def work(index: Index) -> dict[str, Any]:
            rows, total = index.page(chosen, *order, limit=limit, offset=offset)
            runs = [row_as_json(row, shown) for row in index.with_same_as(rows)]
            return {"runs": runs, "total": total, "offset": offset, "limit": limit}

        return json.dumps(catalogue.read(work), ensure_ascii=False).encode()

    key = ("runs", catalogue.state(), request.url.query)
    return Response(await cache.get_or_make(key, make), media_type="application/json")


class Labels(BaseModel):
    """What is to be changed in what people say of a run; what is left out stays."""

    name: Annotated[
        str | None, Field(max_length=100, description="What it is called; empty: as at first.")
    ] = None
    tag: Annotated[list[str], Field(max_length=MAX_TAGS, description="Tags to add.")] = []
    untag: Annotated[list[str], Field(max_length=MAX_TAGS, description="Tags to remove.")] = []
    note: Annotated[str | None, Field(max_length=MAX_NOTE, description="Empty: none.")] = None


class Labelled(BaseModel):
    """What people say of a run."""

    run_id: str
    name: str
    tags: list[str]
    note: str


class Described(BaseModel, extra="allow"):
    """All about a run but its series, which have addresses of their own."""

    run_id: str
    name: str
    seed: int
    status: str
    created: str
    tags: list[str]
    note: str
    config: dict[str, Any]
    provenance: dict[str, Any]
    last_evaluation: dict[str, Any] | None


@router.get(
    "/runs/{run}",
    response_model=Described,
    responses=error_docs(HTTPStatus.NOT_FOUND),
    summary="All about a run.",
)
def one_run(run: FoundRun, settings: SettingsOf) -> Response:
    """Return what `dualtaxi show --json` tells, with the last evaluation instead of all series."""
    return Response(as_json(summary_of(run, settings)), media_type="application/json")


def summary_of(run: Run, settings: Settings) -> dict[str, Any]:
    """Return all about a run but its series; what `run.json` says if its recording cannot be read."""
    problems: list[str] = []
    error = run.summary.error
    told = describe_run(run, problems.append)
    series = {name: told.pop(name) for name in ("eval", "train", "optimality")}
    del told["path"]
    return told | {
        "tags": list(run.tags),
        "note": run.note,
        "last_evaluation": (series["eval"] or [None])[-1],
        "last_optimality": (series["optimality"] or [None])[-1],
        "error": settings.without_folders(str(error)) if error else None,
        "problems": [settings.without_folders(problem) for problem in problems],
    }


@router.patch(
    "/runs/{run}",
    response_model=Labelled,
    responses=error_docs(HTTPStatus.BAD_REQUEST, HTTPStatus.NOT_FOUND),
    summary="Rename, tag, and note.",
)
def label_run(run: FoundRun, labels: Labels, catalogue: CatalogueOf) -> dict[str, Any]:
    """Change the labels of a run as `dualtaxi label` does, and return them."""
    return relabelled(run, labels, catalogue)


def relabelled(run: Run, labels: Labels, catalogue: Catalogue) -> dict[str, Any]:
    """Change the labels of a run, and return them; errors as of `label`."""
    now = label(run, labels.name, labels.note, labels.tag, labels.untag)
    catalogue.changed()
    return {"run_id": run.run_id, "name": now.name or run.file.name, "tags": list(now.tags), "note": now.note}
