"""Whether the service lives, and whether it can do its work."""

from __future__ import annotations

import os
import shutil
from http import HTTPStatus
from pathlib import Path
from typing import Final

from fastapi import APIRouter, Request, Response
from fastapi.responses import JSONResponse
from pydantic import BaseModel

from runner.service.dependencies import CatalogueOf, SettingsOf

router = APIRouter(tags=["health"])
LEAST_FREE: Final = 100_000_000
"""Bytes of disk without which the service is not ready: it could not take a recording."""


class Ready(BaseModel):
    """Whether the service can do its work."""

    ready: bool
    checks: dict[str, bool]
    """Each thing that it needs, and whether that is so."""


@router.get("/healthz", summary="Whether the service answers.")
async def healthz() -> dict[str, str]:
    """Answer."""
    return {"status": "ok"}


@router.get(
    "/readyz",
    response_model=Ready,
    responses={int(HTTPStatus.SERVICE_UNAVAILABLE): {"model": Ready, "description": "It cannot."}},
    summary="Whether the service can do its work.",
)
def readyz(request: Request, settings: SettingsOf, catalogue: CatalogueOf) -> Response:
    """Tell whether runs can be read, and recordings and jobs be taken."""
    folder = settings.recordings[0]
    checks: dict[str, bool] = {
        "not_stopping": not request.app.state.stopping.is_set(),
        "recordings_can_be_written": _can_be_written(folder),
        "disk_has_room": _has_room(folder),
        "runs_can_be_listed": catalogue.can_list(),
        "jobs_can_be_started": request.app.state.jobs.is_working,
    }
    ready = all(checks.values())
    status = HTTPStatus.OK if ready else HTTPStatus.SERVICE_UNAVAILABLE
    return JSONResponse({"ready": ready, "checks": checks}, status)


def _can_be_written(folder: Path) -> bool:
    return os.access(folder, os.R_OK | os.W_OK | os.X_OK)


def _has_room(folder: Path) -> bool:
    try:
        return shutil.disk_usage(folder).free > LEAST_FREE
    except OSError:
        return False
