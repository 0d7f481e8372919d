"""Logging in: a token, typed once into a page, begins a session of the browser; logging out ends it."""

from __future__ import annotations

from dataclasses import dataclass
from http import HTTPStatus
from typing import Annotated, Any, ClassVar, Final

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import RedirectResponse

from runner.errors import RunnerError
from runner.export.reports.rendering import View
from runner.service.pages.rendering import Form, message_of, page
from runner.service.problems import status_of
from runner.service.security import Tokens, unauthorized
from runner.service.sessions import COOKIE, SESSION_SECONDS, Sessions

router = APIRouter(include_in_schema=False)
TOKEN_COOKIE: Final = "dualtaxi_token"
"""Held the token itself in earlier versions; browsers are told to forget it."""


@dataclass(frozen=True)
class LoginView(View):
    """The form for a token."""

    TEMPLATE: ClassVar = "login.html"
    next: str
    problem: str = ""


@router.get("/login")
def ask(request: Request, next: Annotated[str, Query(max_length=4000)] = "/") -> Response:  # noqa: A002
    """Ask for a token."""
    answer = page(request, LoginView(next))
    if TOKEN_COOKIE in request.cookies:
        answer.delete_cookie(TOKEN_COOKIE, **_cookie_of(request))
    return answer


@router.post("/login")
def login(request: Request, sent: Form) -> Response:
    """Begin a session if the token is right, and lead to where its owner was going."""
    secret, where = (sent.get(name, "").strip() for name in ("token", "next"))
    tokens: Tokens = request.app.state.tokens
    sessions: Sessions = request.app.state.sessions
    try:
        token = tokens.find(secret)
        if token is None:
            raise unauthorized("token: found one that is unknown, or was revoked.")
        session = sessions.begin(token)
    except RunnerError as error:
        return page(request, LoginView(where, message_of(error, request)), status_of(error))
    answer = RedirectResponse(where if is_local(where) else "/", HTTPStatus.SEE_OTHER)
    answer.set_cookie(COOKIE, session, max_age=SESSION_SECONDS, **_cookie_of(request))
    return answer


@router.post("/logout")
def logout(request: Request) -> Response:
    """End the session."""
    sessions: Sessions = request.app.state.sessions
    if session := request.cookies.get(COOKIE):
        sessions.end(session)
    answer = RedirectResponse("/login", HTTPStatus.SEE_OTHER)
    answer.delete_cookie(COOKIE, **_cookie_of(request))
    return answer


def is_local(where: str) -> bool:
    """Return whether this is a path of the service: no other site, however written."""
    return where.startswith("/") and not where.startswith(("//", "/\\")) and where.isprintable()


def _cookie_of(request: Request) -> dict[str, Any]:
    return {"httponly": True, "samesite": "lax", "secure": request.url.scheme == "https"}
