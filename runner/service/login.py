"""A token, typed once into a page and kept in a cookie that no script can read."""

from __future__ import annotations

from http import HTTPStatus
from typing import Annotated, Any, Final
from urllib.parse import parse_qs

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import RedirectResponse

from runner.errors import RunnerError
from runner.service.guard import address_of
from runner.service.pages.problems import message_of
from runner.service.pages.rendering import page
from runner.service.problems import status_of
from runner.service.security import COOKIE, Access

router = APIRouter(include_in_schema=False)
SECONDS: Final = 30 * 86_400
"""The cookie is kept so long; a token that is revoked is refused at once all the same."""


@router.get("/login")
def ask(request: Request, next: Annotated[str, Query(max_length=4000)] = "/") -> Response:  # noqa: A002
    """Ask for a token."""
    return page(request, "login.html", next=next, problem="")


@router.post("/login")
async def login(request: Request) -> Response:
    """Keep a token that is right, and lead to where its owner was going."""
    form = parse_qs((await request.body()).decode(errors="replace"))
    secret, where = (form.get(name, [""])[0].strip() for name in ("token", "next"))
    access: Access = request.app.state.access
    try:
        access.scopes_of(secret, address_of(request.scope))
    except RunnerError as error:
        return page(request, "login.html", status_of(error), next=where, problem=message_of(error, request))
    answer = RedirectResponse(where if is_local(where) else "/", HTTPStatus.SEE_OTHER)
    answer.set_cookie(COOKIE, secret, max_age=SECONDS, **_cookie_of(request))
    return answer


@router.post("/logout")
def logout(request: Request) -> Response:
    """Forget the token."""
    answer = RedirectResponse("/login", HTTPStatus.SEE_OTHER)
    answer.delete_cookie(COOKIE, **_cookie_of(request))
    return answer


def is_local(where: str) -> bool:
    """Return whether this is a path of the service: no other site, however written."""
    return where.startswith("/") and not where.startswith(("//", "/\\")) and where.isprintable()


def _cookie_of(request: Request) -> dict[str, Any]:
    return {"httponly": True, "samesite": "lax", "secure": request.url.scheme == "https"}
