"""The pages: rendered on the server, over the same functions as the API and the commands."""

from __future__ import annotations

from fastapi import APIRouter

from runner.service.pages import (
    compare,
    jobs,
    rendering,
    replay,
    rerun,
    run,
    runs,
    sweeps,
)

router = APIRouter(include_in_schema=False)
for _module in (
    runs,
    rerun,
    run,
    rendering,
    replay,
    compare,
    jobs,
    sweeps,
):
    router.include_router(_module.router)
router.include_router(run.acts)
