"""Runs: list, search, describe, label."""

from __future__ import annotations

import json
from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Query, Response
from fastapi import Path as InPath
from pydantic import BaseModel, Field

from runner.analysis.episodes import mark, unmark
from runner.analysis.summary import describe_run
from runner.errors import ConfigError
from runner.recording.labels import MAX_NOTE, MAX_TAGS
from runner.recording.marks import MAX_MARK_TEXT, read_marks
from runner.runs.catalogue.columns import DEFAULT_JSON, columns_of
from runner.runs.catalogue.columns import as_json as row_as_json
from runner.runs.catalogue.filters import parse
from runner.runs.catalogue.index import CatalogueIndex, order_of
from runner.runs.run import Run, label
from runner.service import computed
from runner.service.computed import as_json
from runner.service.dependencies import (
    CatalogueOf,
    FoundRun,
    ProcessesOf,
    SettingsOf,
    WrittenRun,
    json_response,
    require_written,
)
from runner.util.values import Json

router = APIRouter(tags=["runs"])


class RunsPage(BaseModel):
    """Some of the matching runs."""

    runs: list[Json]
    """Each by column, as in `dualtaxi ls --json`."""
    total: int
    """The number of matching runs."""
    offset: int
    limit: int


@router.get(
    "/runs",
    response_model=RunsPage,
    summary="List the runs that match a filter, the newest first.",
)
def list_runs(
    catalogue: CatalogueOf,
    settings: SettingsOf,
    filter: Annotated[str, Query(max_length=3000, description="As for `dualtaxi ls`.")] = "",  # noqa: A002
    sort: Annotated[str, Query(max_length=500, description="Fields; `-FIELD` for descending order.")] = "",
    columns: Annotated[str, Query(max_length=1500, description="Fields; default: the usual ones.")] = "",
    limit: Annotated[int, Query(ge=0)] = 50,
    offset: Annotated[int, Query(ge=0, lt=2**31)] = 0,
) -> Response:
    """List runs as `dualtaxi ls` does."""
    if limit > settings.limits.page_runs:
        raise ConfigError(
            f"query.limit: found {limit}, expected at most {settings.limits.page_runs}; use offset.",
        )

    condition, order = parse(filter), order_of(sort)
    names = columns_of(columns) if columns else DEFAULT_JSON

    def work(index: CatalogueIndex) -> Json:
        rows, total = index.page(condition, *order, limit=limit, offset=offset)
        runs = [row_as_json(row, names) for row in index.with_same_as(rows)]
        return {"runs": runs, "total": total, "offset": offset, "limit": limit}

    return json_response(json.dumps(catalogue.read(work), ensure_ascii=False).encode())


class LabelChanges(BaseModel, extra="forbid"):
    """Changes to the labels of a run; what is omitted stays."""

    name: Annotated[
        str | None, Field(max_length=100, description="The new name; empty for the original one.")
    ] = None
    tag: Annotated[list[str], Field(max_length=MAX_TAGS, description="Tags to add.")] = []
    untag: Annotated[list[str], Field(max_length=MAX_TAGS, description="Tags to remove.")] = []
    note: Annotated[str | None, Field(max_length=MAX_NOTE, description="Empty for none.")] = None


class LabelsResponse(BaseModel):
    """The labels of a run."""

    run_id: str
    name: str
    tags: list[str]
    note: str


class RunResponse(BaseModel, extra="allow"):
    """Everything about a run except its series, which have routes of their own."""

    run_id: str
    name: str
    seed: int
    status: str
    created: str
    tags: list[str]
    note: str
    config: Json
    provenance: dict[str, object]
    last_evaluation: Json | None


@router.get(
    "/runs/{run}",
    response_model=RunResponse,
    summary="Everything about a run.",
)
def one_run(run: FoundRun, settings: SettingsOf) -> Response:
    """Return what `dualtaxi show --json` prints, with the last evaluation instead of all series."""
    # If the recording cannot be read, the facts are those of `run.json` alone.
    problems: list[str] = []
    error = run.summary.error
    details = describe_run(run, problems.append)
    facts = details.facts()
    del facts["path"]
    facts |= {
        "tags": list(run.tags),
        "note": run.note,
        "removed_marks": [] if run.stands_alone else sorted(read_marks(run.folder).removed),
        "last_evaluation": details.evaluations[-1].as_json() if details.evaluations else None,
        "last_optimality": details.optimality[-1] if details.optimality else None,
        "error": settings.without_folders(str(error)) if error else None,
        "problems": [settings.without_folders(problem) for problem in problems],
        **({"damage": settings.without_folders(details.damage)} if details.damage else {}),
    }
    return json_response(as_json(facts))


@router.patch(
    "/runs/{run}",
    response_model=LabelsResponse,
    summary="Change name, tags and note.",
)
def label_run(run: WrittenRun, labels: LabelChanges, catalogue: CatalogueOf) -> dict[str, object]:
    """Change the labels of a run as `dualtaxi label` does, and return them."""
    changed = label(run, labels.name, labels.note, labels.tag, labels.untag)
    catalogue.changed()
    name = changed.name or run.file.name
    return {"run_id": run.run_id, "name": name, "tags": list(changed.tags), "note": changed.note}


class MarkSent(BaseModel, extra="forbid"):
    """A mark to set."""

    at: Annotated[str, Field(max_length=60, description="The step, such as `812:57`.")]
    text: Annotated[str, Field(max_length=MAX_MARK_TEXT)] = ""
    tags: Annotated[list[str], Field(max_length=MAX_TAGS)] = []


class MarksResponse(BaseModel):
    """The marks of a run."""

    run_id: str
    marks: list[Json]


@router.post(
    "/runs/{run}/marks",
    response_model=MarksResponse,
    summary="Mark a step.",
)
def mark_step(run: WrittenRun, sent: MarkSent) -> dict[str, object]:
    """Mark a step of a run as `dualtaxi mark` does, and return all marks of the run."""
    mark(run, sent.at, sent.text, tags=sent.tags)
    return marks_of(run)


@router.delete(
    "/runs/{run}/marks/{name}",
    response_model=MarksResponse,
    summary="Remove a mark.",
)
def remove_mark(run: WrittenRun, name: Annotated[str, InPath(max_length=40)]) -> dict[str, object]:
    """Remove a mark by its id, and return the others."""
    unmark(run, name)
    return marks_of(run)


def marks_of(run: Run) -> dict[str, object]:
    """Return the marks of a run."""
    return {"run_id": run.run_id, "marks": [mark.as_row() for mark in run.marks]}


class StopResponse(BaseModel):
    """A run that was requested to stop."""

    run_id: str
    stop_requested: bool


@router.post(
    "/runs/{run}/stop",
    status_code=HTTPStatus.ACCEPTED,
    response_model=StopResponse,
    summary="Request that a loop which is being recorded stops.",
)
def stop_run(run: FoundRun) -> StopResponse:
    """Make `should_stop` of the recorded environment True; the loop ends when it looks at it."""
    run.request_stop()
    return StopResponse(run_id=run.run_id, stop_requested=True)


@router.post(
    "/runs/{run}/archive",
    response_model=dict[str, object],
    summary="Archive a run.",
)
async def archive_run(
    run: FoundRun,
    catalogue: CatalogueOf,
    settings: SettingsOf,
    processes: ProcessesOf,
    remove: Annotated[bool, Query(description="Remove the recording once its archive was compared.")] = False,
) -> Response:
    """Archive a run, and return what `dualtaxi archive --json` prints, without the archive's place."""
    require_written(run, settings.recordings[0], "archive")
    result = await processes(computed.archive, run, remove)
    catalogue.changed()
    return json_response(result)
