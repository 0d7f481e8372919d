"""The sweeps, and what came of one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Final

from fastapi import APIRouter, Request, Response
from fastapi import Path as InPath

from runner.catalogue.filters import parse
from runner.errors import RunnerError, RunNotFound
from runner.service import played
from runner.service.dependencies import ApartOf, CatalogueOf, JobsOf, KeptOf, SettingsOf
from runner.service.pages.problems import message_of
from runner.service.pages.rendering import page, picture_address
from runner.sweep.state import read_sweep, sweeps_in, tag_of

router = APIRouter(prefix="/sweeps", include_in_schema=False)

SWEEP_SECONDS: Final = 20.0
"""So old may what is told of a sweep be."""
Name = Annotated[str, InPath(max_length=100)]


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
    request: Request, name: Name, settings: SettingsOf, kept: KeptOf, apart: ApartOf, jobs: JobsOf
) -> Response:
    """Show what came of a sweep."""
    folder = _folder_of(name, settings.recordings)
    key = ("sweep", name, folder)
    body = await kept.awaited(key, lambda: apart(played.sweep, name, folder), SWEEP_SECONDS)
    made_by = [job.number for job in jobs.queue.jobs() if job.kind == "sweep" and job.name == name]
    found = json.loads(body)
    pictures = [picture_address(picture) for picture in found["pictures"]]
    for panel in found["learning"]["panels"]:
        panel["address"] = picture_address(panel["svg"])
    shown = {"told": found, "pictures": pictures, "jobs": made_by[-1:], "tag": tag_of(name)}
    return page(request, "sweep.html", name=name, **shown)


# --- inside -------------------------------------------------------------------------------------------


def _runs_tagged(catalogue: CatalogueOf, name: str) -> int:
    chosen = parse(f'tag:"{tag_of(name)}"')
    return catalogue.read(lambda index: index.count(chosen))


def _folder_of(name: str, folders: tuple[Path, ...]) -> Path:
    for folder in folders:
        if name in sweeps_in(folder):
            return folder
    raise RunNotFound(f"no sweep {name!r}: the page of sweeps lists those there are.")
