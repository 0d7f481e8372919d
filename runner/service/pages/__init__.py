"""The pages: rendered on the server, over the same functions as the API and the commands."""

from __future__ import annotations

from fastapi import APIRouter

from runner.service.pages import (
    branch,
    compare,
    environments,
    explanations,
    jobs,
    replay,
    rerun,
    run,
    runs,
    static,
    submit,
    sweeps,
)

router = APIRouter(include_in_schema=False)
for _module in (
    runs,
    rerun,
    run,
    replay,
    branch,
    environments,
    compare,
    submit,
    jobs,
    sweeps,
    explanations,
    static,
):
    router.include_router(_module.router)
router.include_router(run.acts)
