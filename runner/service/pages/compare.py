"""Runs against each other: what differs, where they diverge, both replays in step, their Q-tables."""

from __future__ import annotations

import json
from typing import Annotated, Any, Final

from fastapi import APIRouter, Query, Request, Response
from starlette.concurrency import run_in_threadpool

from runner.analysis.groups import flat_config
from runner.analysis.step_reference import episode_reference, parse_step_reference, step_reference
from runner.errors import RunnerError
from runner.recording.metrics import METRICS
from runner.runs.run import Run
from runner.service import played
from runner.service.api.comparing import found_runs
from runner.service.api.replay import LONG
from runner.service.dependencies import CacheOf, CatalogueOf, ProcessesOf, timed_recording_state
from runner.service.pages.frame import head_of, is_loop, last_evaluation
from runner.service.pages.rendering import link, page, picture_address
from runner.service.pages.step_address import (
    after_step,
    episode_in_words,
    episode_place,
)
from runner.util import humanize

router = APIRouter(prefix="/compare", include_in_schema=False)

TABS: Final = (
    ("", "Overview"),
    ("/divergence", "Where they part"),
    ("/replay", "Replays in step"),
    ("/tables", "Q-tables"),
)
MOST: Final = 12
"""Runs that a page compares."""
Names = Annotated[list[str] | None, Query(max_length=100)]


@router.get("")
async def overview(request: Request, catalogue: CatalogueOf, run: Names = None) -> Response:
    """Show what differs between runs, and their curves over each other."""
    return await run_in_threadpool(_overview, request, await _chosen(catalogue, run))


def _overview(request: Request, found: list[Run]) -> Response:
    settings = [{**({"seed": str(each.seed)} if each.has_seed else {}), **_flat(each)} for each in found]
    keys = list(dict.fromkeys(key for each in settings for key in each))
    told = [(key, [each.get(key, humanize.UNKNOWN) for each in settings]) for key in keys]
    return page(
        request,
        "compare_overview.html",
        **_head(found, ""),
        differing=[(key, values) for key, values in told if len(set(values)) > 1],
        results=_results(found),
        same=_same_content(found),
    )


@router.get("/divergence")
async def divergence(
    request: Request, catalogue: CatalogueOf, cache: CacheOf, processes: ProcessesOf, run: Names = None
) -> Response:
    """Show the first step at which two runs differ, and why."""
    found = _two(await _chosen(catalogue, run))
    told = await _difference(found, cache, processes)
    return await run_in_threadpool(
        page,
        request,
        "compare_divergence.html",
        **_head(found, "/divergence"),
        told=told,
        spot=step_reference,
        after=after_step,
    )


@router.get("/tables")
async def tables(
    request: Request, catalogue: CatalogueOf, cache: CacheOf, processes: ProcessesOf, run: Names = None
) -> Response:
    """Show how far the Q-tables of two runs are apart."""
    found = _two(await _chosen(catalogue, run))
    told = (await _difference(found, cache, processes))["tables"]
    for figure in told["figures"]:
        if "high" not in figure:  # Matplotlib writes styles into its elements, which the policy forbids here
            figure["address"] = picture_address(figure["svg"])
    return await run_in_threadpool(page, request, "compare_tables.html", **_head(found, "/tables"), told=told)


@router.get("/replay")
async def replay(
    request: Request,
    catalogue: CatalogueOf,
    cache: CacheOf,
    processes: ProcessesOf,
    run: Names = None,
    at: Annotated[str, Query(max_length=60)] = "",
) -> Response:
    """Show an episode of two runs, in step; the one in which they diverge unless another is asked for."""
    found = _two(await _chosen(catalogue, run))
    spot = parse_step_reference(at) if at else ()
    if not spot:
        divergences = (await _difference(found, cache, processes))["divergences"]
        spot = after_step(divergences[0]["at"]) if divergences else (0, 0)
    return await run_in_threadpool(_replays, request, found, spot)


def _replays(request: Request, found: list[Run], spot: tuple[int, ...]) -> Response:
    """Return the page of both replays; their recordings are read for the pictures."""
    around = [_replay_link(found, spot, by) for by in (-1, 1)]
    return page(
        request,
        "compare_replay.html",
        **_head(found, "/replay"),
        sources=[f"/api/v1/runs/{each.run_id}/replay/{episode_place(spot)}" for each in found],
        episode=episode_in_words(spot),
        spot=spot,
        before=around[0],
        after=around[1],
        scenes=[_still(each) for each in found],
        base=link("/compare/replay", {"run": [each.run_id for each in found]}),
        prefix=episode_reference(spot),
    )


# --- inside -------------------------------------------------------------------------------------------


async def _chosen(catalogue: CatalogueOf, names: list[str] | None) -> list[Run]:
    """Return the runs that are compared.

    Raises:
        RunnerError: there are fewer than two of them, or too many.
    """
    names = list(dict.fromkeys(names or []))
    if not 2 <= len(names) <= MOST:
        raise RunnerError(f"found {len(names)} runs, expected 2 to {MOST}: select them in the table of runs.")
    return await found_runs(catalogue, names)


def _two(found: list[Run]) -> list[Run]:
    if len(found) != 2:
        raise RunnerError(f"found {len(found)} runs, expected two: only two are compared step by step.")
    return found


async def _difference(found: list[Run], cache: CacheOf, processes: ProcessesOf) -> dict[str, Any]:
    """Return in what two runs differ, as `played.difference` has it."""
    key = ("difference", *map(timed_recording_state, found))
    body = await cache.get_or_await(key, lambda: processes(played.difference, *found), LONG)
    told: dict[str, Any] = await run_in_threadpool(json.loads, body)
    return told


def _head(found: list[Run], here: str) -> dict[str, Any]:
    names = [each.run_id for each in found]
    return {
        "runs": [
            {**head_of(each), "letter": _letter(i), "number": i % 7, "label": f"{_letter(i)}: {each.name}"}
            for i, each in enumerate(found)
        ],
        "tabs": [(tab, name, link(f"/compare{tab}", {"run": names})) for tab, name in TABS]
        if len(found) == 2
        else [],
        "here": here,
    }


def _letter(number: int) -> str:
    return chr(ord("A") + number)


def _flat(run: Run) -> dict[str, str]:
    return {key: str(value) for key, value in flat_config(run.file.config).items()}


def _results(found: list[Run]) -> list[tuple[str, list[str]]]:
    """Return what came of runs, a row a measure."""
    last = [last_evaluation(each) for each in found]
    measures = {
        metric.heading: [each.values.get(metric.name) for each in last]
        for metric in METRICS
        if not metric.per_agent or any(map(is_loop, found))
    }
    return [
        ("Status", [each.status for each in found]),
        *(
            (f"{heading.capitalize()} in the last evaluation", [humanize.number(value) for value in values])
            for heading, values in measures.items()
        ),
        ("Training episodes", [humanize.number(each.summary.episodes, 0) for each in found]),
        ("Steps of training", [humanize.number(each.summary.train_steps, 0) for each in found]),
        (
            "Content digest",
            [str(each.summary.content_digest or humanize.UNKNOWN)[:16] for each in found],
        ),
    ]


def _same_content(found: list[Run]) -> bool:
    digests = {each.summary.content_digest for each in found}
    return len(digests) == 1 and None not in digests


def _replay_link(found: list[Run], spot: tuple[int, ...], by: int) -> str:
    """Return the address of the episode before or after one; nothing before the first."""
    if spot[-2] + by < 0:
        return ""
    other = [*spot[:-2], spot[-2] + by, 0]
    return link("/compare/replay", {"run": [each.run_id for each in found], "at": step_reference(other)})


def _still(run: Run) -> str:
    """Return the picture of a run's grid with everything at its first cell; the script moves it."""
    from runner.drawing import svg
    from runner.recording.reader import open_recording

    with open_recording(run.recording) as recording:
        scene = recording.environment.get("scene")
    if scene is None:
        return ""
    return svg.Drawing(scene).frame(None, f"The grid of {run.name}", style="")
