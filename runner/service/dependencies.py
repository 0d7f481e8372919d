"""What routes ask for: settings, the catalogue, kept answers, the run that is meant."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, Path, Request

from runner.runs import Run
from runner.service.catalogue import Catalogue
from runner.service.kept import Kept
from runner.service.settings import Settings
from runner.service.work import Jobs


def settings_of(request: Request) -> Settings:
    """Return the settings of the service."""
    found: Settings = request.app.state.settings
    return found


def catalogue_of(request: Request) -> Catalogue:
    """Return the catalogue."""
    found: Catalogue = request.app.state.catalogue
    return found


def kept_of(request: Request) -> Kept:
    """Return the answers that are kept."""
    found: Kept = request.app.state.kept
    return found


def jobs_of(request: Request) -> Jobs:
    """Return the jobs, done beside the service."""
    found: Jobs = request.app.state.jobs
    return found


SettingsOf = Annotated[Settings, Depends(settings_of)]
CatalogueOf = Annotated[Catalogue, Depends(catalogue_of)]
KeptOf = Annotated[Kept, Depends(kept_of)]
JobsOf = Annotated[Jobs, Depends(jobs_of)]
RunName = Annotated[
    str,
    Path(
        max_length=200,
        description="A run: its id, the beginning of it, its name, `@latest` or `NAME@latest`.",
        examples=["@latest"],
    ),
]


def found_run(run: RunName, catalogue: CatalogueOf) -> Run:
    """Return the run that the path names.

    Raises:
        RunNotFound: no run answers to the name, or several do.
    """
    return catalogue.find(run)


FoundRun = Annotated[Run, Depends(found_run)]
