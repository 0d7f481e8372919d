"""The episodes of a run, a page at a time: how each went, and a link to its replay if it has one."""

from __future__ import annotations

import math
from typing import Annotated, Any, Final, Literal

from fastapi import APIRouter, Query, Request, Response

from runner.analysis.frames import episode_columns
from runner.environments.naming import event_in_words
from runner.recording.reader import Recording
from runner.runs.run import Run
from runner.service.dependencies import OpenRecording, RecordedRun
from runner.service.pages.frame import framed
from runner.service.pages.rendering import link, page

router = APIRouter(prefix="/runs/{run}", include_in_schema=False)

ROWS: Final = 100


@router.get("/episodes")
def episodes(
    request: Request,
    run: RecordedRun,
    recording: OpenRecording,
    phase: Literal["train", "eval"] = "train",
    number: Annotated[int, Query(alias="page", ge=1, lt=10**9)] = 1,
) -> Response:
    """Show the episodes of a phase; those of a job link to their replay."""
    total = recording.count(recording.topic(f"/{phase}/episode"))
    first = (number - 1) * ROWS
    columns = episode_columns(recording, phase, min(first, total), min(first + ROWS, total))
    if recording.environment["penalty_below"] is None:
        columns.pop("penalties")
    titles = [_title(name) for name in columns if name not in _NO_COLUMNS]
    return page(
        request,
        "run_episodes.html",
        **framed(run, "episodes"),
        phase=phase,
        total=total,
        page=number,
        pages=max(1, math.ceil(total / ROWS)),
        turned=lambda to: link(f"/runs/{run.run_id}/episodes", {"phase": phase, "page": to}),
        headings=["episode" if phase == "train" else "trial", "end", *titles],
        rows=_episode_rows(run, recording, phase, columns),
    )


# --- inside ------------------------------------------------------------------------------------------


_NO_COLUMNS: Final = ("episode", "success", "terminated", "truncated", "last_step")


def _title(column: str) -> str:
    if column.startswith("return."):
        return f"return {column.removeprefix('return.').replace('_', ' ')}"
    return event_in_words(column)


def _episode_rows(
    run: Run, recording: Recording, phase: str, columns: dict[str, Any]
) -> list[dict[str, Any]]:
    """Return what is shown of some episodes."""
    names = [name for name in columns if name not in _NO_COLUMNS]
    lists = {name: values.tolist() for name, values in columns.items()}
    addresses = _addresses(recording, phase, lists["episode"])
    return [
        {
            "name": addresses[i].replace("eval/", "").replace("train/", "").replace("/", ", trial "),
            "href": f"/runs/{run.run_id}/replay/{addresses[i]}" if recording.is_job else "",
            "cells": [_end(lists, i), *(f"{lists[name][i]:,g}" for name in names)],
        }
        for i in range(len(addresses))
    ]


def _addresses(recording: Recording, phase: str, numbers: list[int]) -> list[str]:
    """Return where the replay of each episode is: trials are counted within their evaluation."""
    if phase == "train" or not recording.is_job:
        return [f"{phase}/{number}" for number in numbers]
    ends: list[tuple[int, int, int]] = []
    before = 0
    for metrics in recording.iter_metrics("eval"):
        ends.append((before + int(metrics["trials"]), before, int(metrics["episode"])))
        before += int(metrics["trials"])
    found, at = [], 0
    for number in numbers:
        while at < len(ends) - 1 and number >= ends[at][0]:
            at += 1
        found.append(f"eval/{ends[at][2]}/{number - ends[at][1]}" if ends else f"eval/{number}/0")
    return found


def _end(lists: dict[str, list[Any]], i: int) -> str:
    if lists["success"][i] > 0:
        return "success"
    return "ended" if lists["terminated"][i] else "step limit" if lists["truncated"][i] else "cut off"
