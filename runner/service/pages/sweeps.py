"""The sweeps, and what came of one."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from fastapi import APIRouter, Query, Request, Response
from fastapi import Path as InPath
from fastapi.responses import HTMLResponse
from starlette.concurrency import run_in_threadpool

from runner.errors import RunnerError, RunNotFound
from runner.runs.catalogue.filters import parse
from runner.service import played
from runner.service.catalogue import Catalogue
from runner.service.dependencies import CacheOf, CatalogueOf, JobsOf, SettingsOf, SweepProcesses
from runner.service.pages.jobs import shown_job
from runner.service.pages.problems import message_of
from runner.service.pages.rendering import page, picture_address, templates
from runner.service.processes import ProcessPool
from runner.service.response_cache import ALWAYS, ResponseCache
from runner.sweep import folder_of, sweeps_in, tag_of
from runner.sweep.state import read_sweep

router = APIRouter(prefix="/sweeps", include_in_schema=False)

Name = Annotated[str, InPath(max_length=100)]
Part = Literal["results", "importance", "pictures"]
"""Parts of a page in the order in which they are computed, the fastest first."""


@router.get("")
def sweeps(request: Request, settings: SettingsOf, catalogue: CatalogueOf) -> Response:
    """Show the sweeps."""
    found: list[dict[str, Any]] = []
    for folder in settings.recordings:
        for name in sweeps_in(folder):
            try:
                sweep = read_sweep(name, folder)
            except RunnerError as error:
                found.append({"name": name, "problem": message_of(error, request)})
                continue
            found.append(
                {
                    "name": name,
                    "problem": "",
                    "strategy": sweep.file.strategy,
                    "parameters": ", ".join(sweep.file.parameters),
                    "objective": sweep.objective.described,
                    "runs": _runs_tagged(catalogue, name),
                }
            )
    return page(request, "sweeps.html", sweeps=found)


@router.get("/{name}")
async def sweep(
    request: Request,
    name: Name,
    settings: SettingsOf,
    catalogue: CatalogueOf,
    cache: CacheOf,
    processes: SweepProcesses,
    jobs: JobsOf,
    whole: Annotated[bool, Query(description="Wait for results and pictures.")] = False,
) -> Response:
    """Show what came of a sweep: at once, with what is not ready yet announced in its place."""
    seen = await run_in_threadpool(_look, name, settings.recordings, catalogue)
    parts: dict[str, str | None] = {}
    for part, render in _RENDERERS.items():
        body = await _made(seen, part, cache, processes) if whole else cache.get((f"sweep {part}", seen))
        parts[part] = await run_in_threadpool(render, body) if body else None

    def shown() -> Response:
        made_by = [job for job in jobs.store.jobs() if job.kind == "sweep" and job.name == name]
        return page(
            request,
            "sweep.html",
            name=name,
            tag=tag_of(name),
            runs=seen.runs,
            parameters=list(read_sweep(name, seen.folder).file.parameters),
            job=shown_job(made_by[-1], jobs) if made_by else None,
            parts=parts,
        )

    return await run_in_threadpool(shown)


@router.get("/{name}/{part}")
async def sweep_part(
    name: Name,
    part: Part,
    settings: SettingsOf,
    catalogue: CatalogueOf,
    cache: CacheOf,
    processes: SweepProcesses,
) -> Response:
    """Return a part of a sweep's page: the ranking, what mattered, or the pictures."""
    seen = await run_in_threadpool(_look, name, settings.recordings, catalogue)
    body = await _made(seen, part, cache, processes)
    return HTMLResponse(await run_in_threadpool(_RENDERERS[part], body))


# --- inside -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Seen:
    """A sweep as it was found: what is made of it is the same as long as this is."""

    name: str
    folder: Path
    """The recordings folder."""
    runs: int
    digest: str
    """Of the catalogue's rows of its runs, and of the files of the sweep itself."""


def _look(name: str, folders: tuple[Path, ...], catalogue: Catalogue) -> _Seen:
    """Return a sweep as it is now.

    Raises:
        RunNotFound: there is none of this name.
    """
    folder = _folder_of(name, folders)
    chosen = parse(f'tag:"{tag_of(name)}"')
    rows = catalogue.read(lambda index: index.select(chosen))
    files = sorted(
        (entry.name, facts.st_size, facts.st_mtime_ns)
        for entry in os.scandir(folder_of(name, folder))
        if (facts := entry.stat())
    )
    digest = hashlib.sha256(json.dumps([files, rows], default=str, sort_keys=True).encode()).hexdigest()
    return _Seen(name, folder, len(rows), digest)


async def _made(seen: _Seen, part: str, cache: ResponseCache, processes: ProcessPool) -> bytes:
    """Return a part of a sweep's page as data, made by a child process unless it is kept."""
    make = _MAKERS[part]
    return await cache.get_or_await(
        (f"sweep {part}", seen), lambda: processes(make, seen.name, seen.folder, seen.digest), ALWAYS
    )


def _results_html(body: bytes) -> str:
    return templates().get_template("sweep_results.html").render(told=json.loads(body))


def _importance_html(body: bytes) -> str:
    return templates().get_template("sweep_importance.html").render(told=json.loads(body))


def _pictures_html(body: bytes) -> str:
    told = json.loads(body)
    for panel in told["learning"]["panels"]:
        panel["address"] = picture_address(panel["svg"])
    pictures = [picture_address(picture) for picture in told["pictures"]]
    return templates().get_template("sweep_pictures.html").render(told=told, pictures=pictures)


_MAKERS: Final = {
    "results": played.sweep_results,
    "importance": played.sweep_importance,
    "pictures": played.sweep_pictures,
}
_RENDERERS: Final = {"results": _results_html, "importance": _importance_html, "pictures": _pictures_html}


def _runs_tagged(catalogue: Catalogue, name: str) -> int:
    chosen = parse(f'tag:"{tag_of(name)}"')
    return catalogue.read(lambda index: index.count(chosen))


def _folder_of(name: str, folders: tuple[Path, ...]) -> Path:
    for folder in folders:
        if name in sweeps_in(folder):
            return folder
    raise RunNotFound(f"no sweep {name!r}: the page of sweeps lists those there are.")
