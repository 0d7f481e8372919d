"""The episodes of a run, a page at a time: the outcome of each, and a link to its replay."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Final, Literal

from fastapi import APIRouter, Query, Response

from runner.analysis.episodes import UNKNOWN_EVALUATION, references
from runner.analysis.frames import episode_columns
from runner.analysis.sections import Grid
from runner.environments.naming import event_in_words
from runner.service.addresses import Paging, link
from runner.service.dependencies import OpenRecording, RecordedRun
from runner.service.pages.frame import RunPage
from runner.util.humanize import number_column

router = APIRouter(prefix="/runs/{run}", include_in_schema=False)

ROWS: Final = 100
_HIDDEN: Final = ("episode", "success", "terminated", "truncated", "last_step")
"""Columns that the page does not show as they are."""


@router.get("/episodes")
def episodes(
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
    places = references(recording, phase, values["episode"])
    cells = [number_column(values[name]) for name in names]
    rows = [
        (
            str(at.episode) if at.after in (None, UNKNOWN_EVALUATION) else f"{at.after}, trial {at.episode}",
            _end(values, i),
            *(column[i] for column in cells),
        )
        for i, at in enumerate(places)
    ]
    headings = [_heading(name, len(recording.agents)) for name in names]
    headings = ["episode" if phase == "train" else "trial", "end", *headings]
    base = f"/runs/{run.run_id}/replay"
    links = ["" if at.after == UNKNOWN_EVALUATION else f"{base}/{at.episode_path}" for at in places]
    paging = Paging(number, total, ROWS, link(f"/runs/{run.run_id}/episodes", {"phase": phase}))
    grid = Grid(tuple(headings), rows)
    shown = {"phase": phase, "total": total, "paging": paging, "grid": grid, "links": links}
    return RunPage(run, "episodes", "run_episodes.html", shown)


def _heading(column: str, agents: int) -> str:
    if column.startswith("return."):
        return "return" if agents == 1 else f"return {column.removeprefix('return.').replace('_', ' ')}"
    return event_in_words(column)


def _end(values: Mapping[str, list[Any]], i: int) -> str:
    if values["success"][i] > 0:
        return "success"
    return "ended" if values["terminated"][i] else "step limit" if values["truncated"][i] else "cut off"
