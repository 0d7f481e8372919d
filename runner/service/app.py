"""The application: middleware, routes, errors, login, health, and what lives as long as the service."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import shutil
from collections.abc import AsyncIterator, Mapping
from functools import cache, partial
from http import HTTPStatus
from types import MappingProxyType
from typing import Annotated, Any, Final

import anyio
import anyio.to_thread
from fastapi import APIRouter, Depends, FastAPI, Query, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, RedirectResponse
from pydantic import BaseModel
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.routing import BaseRoute

from runner.errors import RunnerError
from runner.service import pages, views
from runner.service.api import files, jobs, reading, replay, runs
from runner.service.catalogue import Catalogue
from runner.service.dependencies import CatalogueOf, SettingsOf
from runner.service.errors import RequestError
from runner.service.guard import Guard
from runner.service.jobs.queue import JobQueue
from runner.service.logs import LOG, AccessLog
from runner.service.pages.rendering import Form, Page
from runner.service.pictures import PictureStreams
from runner.service.problems import (
    ERROR_DOCS,
    ErrorBody,
    as_config_error,
    error_body,
    known_query,
    requests_page,
    status_of,
)
from runner.service.processes import ProcessPool
from runner.service.response_cache import ResponseCache
from runner.service.settings import ServiceSettings
from runner.service.tokens import COOKIE, SESSION_SECONDS, Sessions, Tokens
from runner.service.uploads import Upload, Uploads
from runner.util import __version__
from runner.util.processes import OWN_ONLY

API: Final = "/api/v1"
THREADS: Final = 8
"""Requests that are worked on at the same time; the others wait."""
PROCESSES: Final = 2
"""Comparisons, plots and exports that are computed at the same time, in as many processes."""
MIN_FREE_BYTES: Final = 100_000_000
"""Free disk space below which the service is not ready: it could not store a recording."""

ERRORS: Final = (
    RunnerError,
    HTTPException,
    RequestValidationError,
    OSError,
    ClientDisconnect,
    Exception,
)
"""The kinds of errors that become responses."""

health = APIRouter(tags=["health"])
login_pages = APIRouter(include_in_schema=False)


class Ready(BaseModel):
    """Whether the service can do its work."""

    ready: bool
    checks: dict[str, bool]
    """Each thing that it needs, and whether that is so."""


def create_app(settings: ServiceSettings) -> FastAPI:
    """Return the application.

    Raises:
        RunnerError: it would be reachable from other machines and there is no token.
    """
    tokens = Tokens(settings.tokens)
    if settings.needs_token and not tokens.all():
        option = (
            "--require-token" if settings.is_loopback else f"{settings.host}, which other machines can reach,"
        )
        raise RunnerError(
            f"host: found {option} and no token; expected one. Create it by `dualtaxi token create NAME`, or "
            "serve on 127.0.0.1 without --require-token."
        )
    app = FastAPI(
        title="dualtaxi",
        version=__version__,
        summary="Recorded reinforcement-learning runs: list, read, compare, upload, submit.",
        openapi_url=f"{API}/openapi.json",
        docs_url=None,
        redoc_url=None,
        routes=_routes(),
        lifespan=_lifespan,
        exception_handlers=dict.fromkeys(ERRORS, respond_to_error),
    )
    app.state.settings = settings
    app.state.catalogue = Catalogue(settings.recordings, LOG.warning)
    app.state.cache = ResponseCache(settings.limits.cache_bytes)
    app.state.stopping = asyncio.Event()
    app.state.tokens = tokens
    app.state.sessions = Sessions(tokens)
    app.add_middleware(
        Guard, settings=settings, tokens=tokens, sessions=app.state.sessions, refusal=error_response
    )
    app.add_middleware(AccessLog)
    return app


def error_response(request: Request, error: RunnerError) -> Response:
    """Return the response to a request that raised one of the project's errors."""
    headers = error.headers if isinstance(error, RequestError) else {}
    return _response(request, status_of(error), error_body(error, request.app.state.settings), headers)


async def respond_to_error(request: Request, error: Exception) -> Response:
    """Return the response to any error: JSON in one form, or a page where a browser requested one."""
    match error:
        case RunnerError():
            return error_response(request, error)
        case RequestValidationError():
            return error_response(request, as_config_error(error))
        case HTTPException():
            status = HTTPStatus(error.status_code)
            if status == HTTPStatus.NO_CONTENT:
                return Response(status_code=status)
            messages = {
                HTTPStatus.NOT_FOUND: f"there is nothing at {request.url.path}.",
                HTTPStatus.METHOD_NOT_ALLOWED: f"{request.method} is not supported at {request.url.path}.",
            }
            body = ErrorBody(message=messages.get(status, str(error.detail)))
            return _response(request, status, body, error.headers or {})
        case ClientDisconnect():
            status, message = HTTPStatus.BAD_REQUEST, "the client closed the connection."
        case OSError() if error.errno in (errno.ENOSPC, getattr(errno, "EDQUOT", None)):
            status = HTTPStatus.INSUFFICIENT_STORAGE
            message = (
                f"the disk is full ({error.strerror}); free some of it: `dualtaxi du` lists what uses it."
            )
        case _:
            LOG.error("error", exc_info=error, extra={"path": request.url.path, "method": request.method})
            status = HTTPStatus.INTERNAL_SERVER_ERROR
            message = "something unexpected went wrong; see the service's log."
    return _response(request, status, ErrorBody(message=message))


def _response(
    request: Request, status: HTTPStatus, body: ErrorBody, headers: Mapping[str, str] = MappingProxyType({})
) -> Response:
    if not requests_page(request):
        return JSONResponse({"error": body.model_dump()}, status, headers)
    page = Page("problem.html", {"title": status.phrase.capitalize(), "message": body.message}, status)
    page.headers.update(headers)
    return page


@cache
def _routes() -> list[BaseRoute]:
    """Return the routes of every application of this process: FastAPI takes half a second to analyse them."""
    whole = APIRouter()
    parts = (runs.router, reading.router, replay.router, reading.comparing, files.router, jobs.router)
    for router in (*parts, files.uploads_router, views.api):
        whole.include_router(router, prefix=API, responses=ERROR_DOCS, dependencies=[Depends(known_query)])
    for router in (health, login_pages, views.pages, pages.router):
        whole.include_router(router)
    return whole.routes


@contextlib.asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    """Open what lives as long as the service, and close it in the opposite order."""
    anyio.to_thread.current_default_thread_limiter().total_tokens = THREADS
    app.state.stopping.clear()
    settings: ServiceSettings = app.state.settings
    limits = settings.limits

    def log_upload(upload: Upload) -> None:
        app.state.catalogue.changed()
        fields = {"state": upload.state, "run_id": upload.run_id}
        LOG.info("upload", extra=fields | {"bytes": upload.size, "problem": upload.problem})

    with contextlib.ExitStack() as stack:
        os.environ[OWN_ONLY] = "1"  # before any child process
        stack.callback(os.environ.pop, OWN_ONLY, None)
        app.state.jobs = stack.enter_context(
            JobQueue(settings.recordings[0], settings.workers, max_unfinished=limits.jobs, ray=settings.ray)
        )
        app.state.writers = anyio.CapacityLimiter(files.WRITERS)
        app.state.downloads = anyio.CapacityLimiter(2)
        app.state.uploads = Uploads(settings.recordings[0], limits, log_upload)
        stack.callback(app.state.uploads.close)
        app.state.pictures = PictureStreams()
        stack.callback(app.state.pictures.close)
        pool = partial(ProcessPool, seconds=limits.work_seconds, memory_bytes=limits.work_bytes)
        app.state.processes = stack.enter_context(pool(PROCESSES))
        app.state.exclusive = stack.enter_context(pool(1))
        app.state.sweep_processes = stack.enter_context(pool(1, keep_seconds=None))
        logged = {name: getattr(settings, name) for name in ("host", "port", "needs_token", "workers")}
        LOG.info("started", extra={"recordings": list(map(str, settings.recordings)), **logged})
        yield
        app.state.stopping.set()
        LOG.info("stopping")


@health.get("/healthz", summary="Whether the service responds.")
async def healthz() -> dict[str, str]:
    """Respond."""
    return {"status": "ok"}


@health.get(
    "/readyz",
    response_model=Ready,
    responses={int(HTTPStatus.SERVICE_UNAVAILABLE): {"model": Ready, "description": "It cannot."}},
    summary="Whether the service can do its work.",
)
def readyz(request: Request, settings: SettingsOf, catalogue: CatalogueOf) -> Response:
    """Check that runs can be read, and recordings and jobs accepted."""
    folder = settings.recordings[0]
    has_space = can_list = False
    with contextlib.suppress(OSError):
        has_space = shutil.disk_usage(folder).free > MIN_FREE_BYTES
    with contextlib.suppress(RunnerError):
        can_list = catalogue.read(lambda index: index.count()) >= 0
    checks = {
        "not_stopping": not request.app.state.stopping.is_set(),
        "recordings_can_be_written": os.access(folder, os.R_OK | os.W_OK | os.X_OK),
        "disk_has_space": has_space,
        "runs_can_be_listed": can_list,
        "jobs_can_be_started": request.app.state.jobs.pool.is_working,
    }
    ready = all(checks.values())
    status = HTTPStatus.OK if ready else HTTPStatus.SERVICE_UNAVAILABLE
    return JSONResponse({"ready": ready, "checks": checks}, status)


@login_pages.get("/login")
def ask(request: Request, next: Annotated[str, Query(max_length=4000)] = "/") -> Response:  # noqa: A002
    """Ask for a token, where one is needed."""
    if not request.app.state.settings.needs_token:
        return RedirectResponse(_local(next), HTTPStatus.SEE_OTHER)
    return Page("login.html", {"next": next, "problem": ""})


@login_pages.post("/login")
def login(request: Request, sent: Form) -> Response:
    """Begin a session if the token is right, and redirect to the page that was requested."""
    secret, target = (sent.get(name, "").strip() for name in ("token", "next"))
    tokens: Tokens = request.app.state.tokens
    sessions: Sessions = request.app.state.sessions
    try:
        session = sessions.begin(tokens.find(secret))
    except RunnerError as error:
        return Page("login.html", {"next": target, "problem": error}, status_of(error))
    response = RedirectResponse(_local(target), HTTPStatus.SEE_OTHER)
    response.set_cookie(COOKIE, session, max_age=SESSION_SECONDS, **_cookie_options(request))
    return response


@login_pages.post("/logout")
def logout(request: Request) -> Response:
    """End the session."""
    sessions: Sessions = request.app.state.sessions
    if session := request.cookies.get(COOKIE):
        sessions.end(session)
    response = RedirectResponse("/login", HTTPStatus.SEE_OTHER)
    response.delete_cookie(COOKIE, **_cookie_options(request))
    return response


def _local(target: str) -> str:
    """Return an address of this service, or the first page in place of any other address."""
    # Browsers take `//host` and `/\host` for addresses of other sites.
    is_local = target.startswith("/") and not target.startswith(("//", "/\\")) and target.isprintable()
    return target if is_local else "/"


def _cookie_options(request: Request) -> dict[str, Any]:
    return {"httponly": True, "samesite": "lax", "secure": request.url.scheme == "https"}
