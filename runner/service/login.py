"""Logging in: a token, typed into a page once, begins a session of the browser; logging out ends it."""

from __future__ import annotations

from http import HTTPStatus
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import RedirectResponse

from runner.errors import RunnerError
from runner.service.pages.rendering import Form, Page
from runner.service.problems import status_of
from runner.service.tokens import COOKIE, SESSION_SECONDS, Sessions, Tokens

router = APIRouter(include_in_schema=False)


@router.get("/login")
def ask(request: Request, next: Annotated[str, Query(max_length=4000)] = "/") -> Response:  # noqa: A002
    """Ask for a token, where one is needed."""
    if not request.app.state.settings.needs_token:
        return RedirectResponse(_local(next), HTTPStatus.SEE_OTHER)
    return Page("login.html", {"next": next, "problem": ""})


@router.post("/login")
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


@router.post("/logout")
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
