"""The pages: rendered on the server, over the same functions as the API and the commands."""

from __future__ import annotations

from fastapi import APIRouter

from runner.service.pages import (
    branch,
    compare,
    debugging,
    environments,
    explanations,
    jobs,
    learned,
    replay,
    rerun,
    run,
    runs,
    setup,
    static,
    submit,
    sweeps,
)

router = APIRouter(include_in_schema=False)
for _module in (
    runs,
    rerun,
    run,
    setup,
    learned,
    replay,
    debugging,
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
