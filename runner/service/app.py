"""The application: what all requests pass, the routes, and what lives as long as the service."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from http import HTTPStatus
from typing import Any, Final

import anyio
import anyio.to_thread
from fastapi import APIRouter, FastAPI

from runner.errors import RunnerError
from runner.service import health, login, pages
from runner.service.api import comparing, files, jobs, reading, replay, runs, uploads
from runner.service.catalogue import Catalogue
from runner.service.fragments import load_sweep_libraries
from runner.service.guard import Guard
from runner.service.jobs.pool import JobPool
from runner.service.logs import LOG, AccessLog
from runner.service.problems import add_error_handlers, answers
from runner.service.processes import ProcessPool
from runner.service.response_cache import ResponseCache
from runner.service.security import Tokens
from runner.service.sessions import Sessions
from runner.service.settings import Settings
from runner.service.upload_model import Upload, UploadLimits
from runner.service.uploads import Uploads
from runner.sweep import sweeps_in
from runner.util.version import __version__

API: Final = "/api/v1"
THREADS: Final = 8
"""Requests that are worked on at the same time; the others wait."""
PROCESSES: Final = 2
"""Comparisons, pictures and exports that are made at the same time, each in a process of its own."""


def create_app(settings: Settings) -> FastAPI:
    """Return the application.

    Raises:
        RunnerError: it would be reachable from other machines and there is no token.
    """
    tokens = Tokens(settings.tokens)
    if settings.needs_token and not tokens.all():
        why = (
            "--require-token" if settings.is_loopback else f"{settings.host}, which other machines can reach,"
        )
        raise RunnerError(
            f"host: found {why} and no token; expected one. Make it by `dualtaxi token create NAME`, or "
            "serve on 127.0.0.1 without --require-token."
        )
    app = FastAPI(
        title="dualtaxi",
        version=__version__,
        summary="Recorded reinforcement-learning runs: listed, read, compared, uploaded, done.",
        openapi_url=f"{API}/openapi.json",
        docs_url=None,
        redoc_url=None,
        lifespan=_lifespan,
    )
    app.state.settings = settings
    app.state.catalogue = Catalogue(settings.recordings, LOG.warning)
    app.state.cache = ResponseCache(settings.limits.cache_bytes)
    app.state.stopping = asyncio.Event()
    app.state.tokens = tokens
    app.state.sessions = Sessions(tokens)
    app.add_middleware(
        Guard, settings=settings, tokens=tokens, sessions=app.state.sessions, refused=pages.refused
    )
    app.add_middleware(AccessLog)
    add_error_handlers(app)
    pages.add_error_handlers(app)
    app.include_router(_api(), prefix=API)
    app.include_router(health.router)
    app.include_router(login.router)
    app.include_router(pages.router)
    return app


def _api() -> APIRouter:
    general = answers(
        HTTPStatus.BAD_REQUEST,
        HTTPStatus.UNAUTHORIZED,
        HTTPStatus.FORBIDDEN,
        HTTPStatus.REQUEST_TIMEOUT,
        HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
        HTTPStatus.MISDIRECTED_REQUEST,
        HTTPStatus.UNPROCESSABLE_ENTITY,
        HTTPStatus.TOO_MANY_REQUESTS,
        HTTPStatus.INSUFFICIENT_STORAGE,
    )
    api = APIRouter(responses=general)
    for part in (runs, reading, replay, comparing, files, jobs, uploads):
        api.include_router(part.router)
    return api


@contextlib.asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[dict[str, Any]]:
    """Open what lives as long as the service, and close it in the opposite order."""
    anyio.to_thread.current_default_thread_limiter().total_tokens = THREADS
    app.state.stopping.clear()
    async with contextlib.AsyncExitStack() as stack:
        stack.callback(app.state.catalogue.close)
        app.state.catalogue.prepare()
        settings: Settings = app.state.settings
        app.state.jobs = stack.enter_context(
            JobPool(
                settings.recordings[0],
                settings.workers,
                max_unfinished=settings.limits.jobs,
                ray=settings.ray,
            )
        )
        app.state.writers = anyio.CapacityLimiter(uploads.WRITERS)
        app.state.uploads = stack.enter_context(
            Uploads(
                settings.recordings[0],
                UploadLimits(max_bytes=settings.limits.upload_bytes),
                lambda upload: _uploaded(app, upload),
            )
        )
        app.state.processes = stack.enter_context(
            ProcessPool(PROCESSES, settings.limits.work_seconds, settings.limits.work_bytes)
        )
        app.state.sweep_processes = stack.enter_context(
            ProcessPool(1, settings.limits.work_seconds, settings.limits.work_bytes, is_reused=True)
        )
        if any(sweeps_in(folder) for folder in settings.recordings):
            app.state.sweep_processes.submit(load_sweep_libraries)
        LOG.info("started", extra=settings.told())
        yield {}
        app.state.stopping.set()
        LOG.info("stopping")


def _uploaded(app: FastAPI, upload: Upload) -> None:
    """Say what became of an upload."""
    app.state.catalogue.changed()
    facts = {"state": upload.state, "run_id": upload.run_id, "bytes": upload.size, "problem": upload.problem}
    LOG.info("upload", extra=facts)
