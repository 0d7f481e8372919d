"""The episodes of a run, a page at a time: the outcome of each, and a link to its replay."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping
from typing import Annotated, Any, Final, Literal

from fastapi import APIRouter, Query, Request, Response

from runner.analysis.evaluations import evaluations_of
from runner.analysis.frames import episode_columns
from runner.analysis.sections import Grid
from runner.environments.naming import event_in_words
from runner.recording.reader import Recording
from runner.service.addresses import Paging, link
from runner.service.dependencies import OpenRecording, RecordedRun
from runner.service.pages.frame import run_page
from runner.util.humanize import number_column

router = APIRouter(prefix="/runs/{run}", include_in_schema=False)

ROWS: Final = 100
_HIDDEN: Final = ("episode", "success", "terminated", "truncated", "last_step")
"""Columns that the page does not show as they are."""


@router.get("/episodes")
def episodes(
    request: Request,
    run: RecordedRun,
    recording: OpenRecording,
    phase: Literal["train", "eval"] = "train",
    number: Annotated[int, Query(alias="page", ge=1, lt=10**9)] = 1,
) -> Response:
    """Show the episodes of a phase; each links to its replay."""
    total = recording.phase(phase).episodes.count()
    first = (number - 1) * ROWS
    columns = episode_columns(recording, phase, min(first, total), min(first + ROWS, total))
    if recording.environment["penalty_below"] is None:
        columns.pop("penalties")
    names = [name for name in columns if name not in _HIDDEN]
    values: Mapping[str, list[Any]] = {name: column.tolist() for name, column in columns.items()}
    paths = _paths(recording, phase, values["episode"])
    cells = [number_column(values[name]) for name in names]
    rows = [
        (path.partition("/")[2].replace("/", ", trial "), _end(values, i), *(column[i] for column in cells))
        for i, path in enumerate(paths)
    ]
    headings = [_heading(name, len(recording.agents)) for name in names]
    headings = ["episode" if phase == "train" else "trial", "end", *headings]
    links = [f"/runs/{run.run_id}/replay/{path}" for path in paths]
    paging = Paging(number, total, ROWS, link(f"/runs/{run.run_id}/episodes", {"phase": phase}))
    grid = Grid(tuple(headings), rows)
    shown = {"phase": phase, "total": total, "paging": paging, "grid": grid, "links": links}
    return run_page(request, run, "episodes", "run_episodes.html", shown)


def _heading(column: str, agents: int) -> str:
    if column.startswith("return."):
        return "return" if agents == 1 else f"return {column.removeprefix('return.').replace('_', ' ')}"
    return event_in_words(column)


def _paths(recording: Recording, phase: str, numbers: list[int]) -> list[str]:
    """Return the path of the replay of each episode; trials are counted within their evaluation."""
    if phase == "train":
        return [f"train/{number}" for number in numbers]
    evaluations = evaluations_of(recording)
    stops = [one.stop for one in evaluations]
    paths = []
    for number in numbers:
        at = bisect_right(stops, number)
        if at == len(stops):  # its evaluation was cut off
            paths.append(f"eval/{number}/0")
        else:
            paths.append(f"eval/{evaluations[at].after}/{number - evaluations[at].start}")
    return paths


def _end(values: Mapping[str, list[Any]], i: int) -> str:
    if values["success"][i] > 0:
        return "success"
    return "ended" if values["terminated"][i] else "step limit" if values["truncated"][i] else "cut off"
