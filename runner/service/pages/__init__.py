"""The pages: rendered on the server, over the same functions as the API and the commands."""

from __future__ import annotations

from fastapi import APIRouter

from runner.service.pages import (
    compare,
    disk,
    episodes,
    jobs,
    replay,
    rerun,
    run,
    runs,
    static,
    submit,
    sweeps,
)
from runner.service.pages.problems import add_error_handlers, refused

__all__ = ["add_error_handlers", "refused", "router"]

router = APIRouter(include_in_schema=False)
for _part in (runs, rerun, run, replay, episodes, compare, submit, jobs, sweeps, disk, static):
    router.include_router(_part.router)
