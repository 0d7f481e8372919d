"""Templates to answers: what every page has, numbers in words, and errors as pages."""

from __future__ import annotations

import base64
import functools
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from http import HTTPStatus
from importlib.resources import files
from typing import Any, Final
from urllib.parse import urlencode

import jinja2
from fastapi import Request, Response
from markupsafe import Markup

from runner.drawing import palette
from runner.export.reports.rendering import code
from runner.recording.metrics import METRICS
from runner.service.pages import static
from runner.util import humanize

TEMPLATES: Final = files("runner.service.pages") / "templates"
SECTIONS: Final = (
    ("/runs", "Runs"),
    ("/sweeps", "Sweeps"),
    ("/queue", "Queue"),
    ("/submit", "Submit"),
    ("/disk", "Disk"),
)


@functools.cache
def templates() -> jinja2.Environment:
    """Return the templates of pages; those of reports are beside them."""
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(_source),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters |= {
        "number": humanize.number,
        "size": humanize.size,
        "duration": humanize.duration,
        "age": _age,
        "code": code,
        "problem": _problem,
        "count": lambda value: humanize.number(value, 0),
        "sentence": lambda text: f"{text[:1].upper()}{text[1:]}{'' if text[-1:] in '.:' else '.'}",
        "with_name": lambda value, name: (name, value),
        "with_prefix": lambda value, prefix: f"{prefix}{value}",
        "query": lambda values: urlencode(list(values), doseq=True),
    }
    environment.globals |= {"static": static.address, "sections": SECTIONS, "metrics": METRICS}
    return environment


def page(request: Request, template: str, status: HTTPStatus = HTTPStatus.OK, **context: Any) -> Response:
    """Return a page.

    Args:
        request: which it answers.
        template: its name.
        status: of the answer.
        context: what the template asks for.
    """
    body = render(request.url.path, template, viewer=viewer_of(request), **context)
    return Response(body, status, media_type="text/html")


@dataclass(frozen=True)
class Viewer:
    """Who looks at a page, and so what it offers."""

    name: str
    """Of the token; empty where none is needed."""
    can_write: bool


def viewer_of(request: Request) -> Viewer:
    """Return who looks at a page."""
    token = getattr(request.state, "token", None)
    if token is None:
        return Viewer("", not request.app.state.settings.needs_token)
    return Viewer(token.name, token.can_write)


def render(path: str, template: str, viewer: Viewer, **context: Any) -> bytes:
    """Return the HTML of a page at a path."""
    return templates().get_template(template).render(path=path, viewer=viewer, **context).encode()


def link(path: str, values: Mapping[str, Any]) -> str:
    """Return an address with these values, without those that are empty."""
    kept = [(key, value) for key, value in values.items() if value not in ("", None, [], ())]
    return f"{path}?{urlencode(kept, doseq=True)}" if kept else path


def picture_address(picture: str) -> str:
    """Return an SVG of a page as the address of a picture.

    A picture knows nothing of the page's styles, so it gets the colours for light and dark of its own.
    """
    space = "" if "xmlns=" in picture[:300] else ' xmlns="http://www.w3.org/2000/svg"'
    start, tag, rest = picture.partition(">")
    start = start.replace("<svg", f"<svg{space}", 1)
    body = f"{start}{tag}<style>{_picture_style()}</style>{rest}".encode()
    return f"data:image/svg+xml;base64,{base64.b64encode(body).decode()}"


@functools.cache
def _picture_style() -> str:
    return f"{palette.css_variables()} :root {{ color: var(--ink); }}"


def _source(name: str) -> str | None:
    for folder in (TEMPLATES, static.REPORT):
        if (folder / name).is_file():
            return (folder / name).read_text("utf-8")
    return None


def _problem(message: str) -> Markup:
    """Return an error as HTML; what a caret points into is set in a fixed width, so that it points there."""
    text, _, marked = message.partition("\n")
    if not marked.rstrip().endswith("^"):
        return Markup("<p>{}</p>").format(code(message))
    return Markup("<p>{}</p><pre>{}</pre>").format(code(text), marked)


def _age(moment: datetime | str) -> str:
    """Return how long ago a moment was, in words."""
    then = datetime.fromisoformat(moment) if isinstance(moment, str) else moment
    return humanize.age((datetime.now(UTC) - then).total_seconds())
