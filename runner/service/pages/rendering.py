"""Pages: filled templates, the forms that they send, the files they load, the head of a run's pages."""

from __future__ import annotations

import contextlib
import functools
import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from http import HTTPStatus
from importlib.resources import files
from typing import Annotated, Final
from urllib.parse import parse_qsl

import jinja2
from fastapi import APIRouter, Depends, HTTPException, Query, Request, Response
from fastapi.responses import RedirectResponse
from markupsafe import Markup
from starlette.concurrency import run_in_threadpool
from starlette.types import Receive, Scope, Send

from runner.analysis.qtable import recorded_tables
from runner.errors import RecordingError, RunnerError
from runner.export.reports.rendering import TEMPLATES as REPORT_TEMPLATES
from runner.export.reports.rendering import code, environment_of, page_style
from runner.recording import schema
from runner.recording.metrics import EvaluationMetric
from runner.recording.reader import open_recording
from runner.recording.run_file import EvaluationMetrics, has_environment
from runner.runs.run import Run
from runner.service.computed import link
from runner.service.problems import error_body
from runner.util import extras, humanize
from runner.views import NAMES, shipped_views, view_named

router = APIRouter(include_in_schema=False)

STATIC: Final = files("runner.service.pages") / "static"
UPLOT: Final = "vendor/uplot-1.6.32"
_TYPES: Final = {"css": "text/css", "js": "text/javascript", "svg": "image/svg+xml", "LICENSE": "text/plain"}
_FOREVER: Final = "public, max-age=31536000, immutable"


@functools.cache
def assets() -> Mapping[str, bytes]:
    """Return the files of the pages by name."""
    bodies = {entry.name: entry.read_bytes() for entry in STATIC.iterdir() if entry.is_file()}
    bodies |= {
        name: (STATIC / name).read_bytes() for name in (f"{UPLOT}/uPlot.iife.min.js", f"{UPLOT}/LICENSE")
    }
    bodies["replay.js"] = (REPORT_TEMPLATES / "replay.js").read_bytes()
    layouts = (STATIC / UPLOT / "uPlot.min.css").read_text("utf-8"), bodies.pop("pages.css").decode()
    bodies["style.css"] = "\n".join([page_style(), *layouts]).encode()
    return bodies


@functools.cache
def static_version() -> str:
    """Return a digest of all files."""
    digest = hashlib.sha256()
    for name, body in sorted(assets().items()):
        digest.update(name.encode() + b"\0" + body)
    return digest.hexdigest()[:12]


def static_address(name: str) -> str:
    """Return the address of a file."""
    assets()[name]
    return f"/static/{static_version()}/{name}"


@router.api_route("/static/{digest}/{name:path}", methods=["GET", "HEAD"])
def static_file(digest: str, name: str) -> Response:
    """Return a file of the pages."""
    if name not in assets():
        raise HTTPException(HTTPStatus.NOT_FOUND)
    media_type = _TYPES[name.rpartition("/")[2].rpartition(".")[2]]
    headers = {"cache-control": _FOREVER if digest == static_version() else "no-cache"}
    return Response(assets()[name], media_type=media_type, headers=headers)


TEMPLATES: Final = files("runner.service.pages") / "templates"
SECTIONS: Final = (
    ("/runs", "Runs"),
    ("/find", "Find"),
    ("/sql", "SQL"),
    ("/sweeps", "Sweeps"),
    ("/queue", "Queue"),
    ("/submit", "Submit"),
    ("/disk", "Disk"),
)
MAX_FIELDS: Final = 100
"""Fields of a form."""


Values = Mapping[str, object] | Callable[[], Mapping[str, object]]


@dataclass(frozen=True)
class Viewer:
    """The user of a page, who decides what it offers."""

    name: str
    """Name of the token; empty where none is needed."""
    can_write: bool


class Page(Response):
    """A template, filled with values in a thread when it is sent; a function makes them there.

    The value `problem` is why a request was refused, an error or its message; the status is then 400 by
    default.
    """

    media_type = "text/html"

    def __init__(self, template: str, values: Values, status: HTTPStatus | None = None) -> None:
        super().__init__()
        self._template, self._values, self._status = template, values, status

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the page."""
        self.body = await run_in_threadpool(self._render, Request(scope))
        self.headers["content-length"] = str(len(self.body))
        await super().__call__(scope, receive, send)

    def _render(self, request: Request) -> bytes:
        values = dict(made(self._values))
        problem = values.get("problem")
        self.status_code = self._status or (HTTPStatus.BAD_REQUEST if problem else HTTPStatus.OK)
        if isinstance(problem, RunnerError):
            values["problem"] = message_of(problem, request)
        template, viewer = templates().get_template(self._template), viewer_of(request)
        return template.render(values, path=request.url.path, viewer=viewer).encode()


def made(values: Values) -> Mapping[str, object]:
    """Return the values of a page."""
    return values() if callable(values) else values


def to_job(number: int) -> Response:
    """Return the redirection to the page of a job."""
    return RedirectResponse(f"/queue/{number}", HTTPStatus.SEE_OTHER)


def viewer_of(request: Request) -> Viewer:
    """Return the user who sent a request."""
    token = getattr(request.state, "token", None)
    if token is None:
        return Viewer("", not request.app.state.settings.needs_token)
    return Viewer(token.name, token.can_write)


@functools.cache
def templates() -> jinja2.Environment:
    """Return the templates of pages, which use partial templates of reports."""
    environment = environment_of((TEMPLATES, REPORT_TEMPLATES))
    environment.filters |= {
        "size": humanize.size,
        "age": _age,
        "problem": _problem,
    }
    environment.globals |= {"static": static_address, "sections": SECTIONS, "link": link}
    return environment


def _problem(message: str) -> Markup:
    """Return an error as HTML; lines with a caret have a fixed width, so that it points at its place."""
    text, _, marked = message.partition("\n")
    if not marked.rstrip().endswith("^"):
        return Markup("<p>{}</p>").format(code(humanize.sentence(message)))
    return Markup("<p>{}</p><pre>{}</pre>").format(code(humanize.sentence(text)), marked)


def _age(moment: datetime | str) -> str:
    """Return the time since a moment as text."""
    return humanize.ago(datetime.fromisoformat(moment) if isinstance(moment, str) else moment)


async def form_of(request: Request) -> dict[str, str]:
    """Return the fields of a form as text, with the line ends of files.

    Raises:
        RunnerError: the body is not a form.
    """
    body = await request.body()
    try:
        pairs = parse_qsl(
            body.decode("ascii"), keep_blank_values=True, max_num_fields=MAX_FIELDS, errors="strict"
        )
    except ValueError as error:
        raise RunnerError(f"body: found no form ({error}).") from error
    return {name: value.replace("\r\n", "\n") for name, value in pairs}


Form = Annotated[dict[str, str], Depends(form_of)]


def message_of(error: RunnerError, request: Request) -> str:
    """Return the message of an error, as in the API."""
    return error_body(error, request.app.state.settings).message


StatusName = Annotated[str, Query(max_length=20, description="The status that the page shows.")]

TABS: Final = (
    ("", "Overview", ""),
    ("replay", "Replay", "episodes"),
    ("learned", "What was learned", "tables"),
    *((view.name, view.title, view.needs) for view in shipped_views() if view.has_tab),
    ("config", "Configuration", ""),
    ("pictures", "Pictures", "pictures"),
    ("rerun", "Rerun", "episodes"),
)
"""Paths and titles of the pages of a run, and what a run needs for each."""


def installed_names() -> list[str]:
    """Return the names of the views that installed packages add, except names of shipped pages."""
    shipped = {*NAMES, *(path for path, *_ in TABS)}
    return [name for name in extras.plugin_names(extras.VIEWS) if name not in shipped]


@dataclass(frozen=True)
class RunHead:
    """The facts of a run that all of its pages show."""

    id: str
    name: str
    seed: int | None
    status: str
    created: str
    tags: tuple[str, ...]
    note: str
    tabs: tuple[tuple[str, str], ...]
    lacking: Mapping[str, str]
    """The tabs that it does not have, and what they need."""
    steps: str
    """Which steps it records: `all`, `actions` or `none`."""


def run_page(run: Run, here: str, template: str, values: Values, status: HTTPStatus | None = None) -> Page:
    """Return a page of a run; `here` is the path of its tab."""
    return Page(template, lambda: {"run": head_of(run), "here": here, **made(values)}, status)


def head_of(run: Run) -> RunHead:
    """Return the facts of a run that all of its pages show."""
    has_episodes = has_environment(run.file.config)
    has_tables = run.can_train_again or _has_recorded_tables(run)
    status, messages = run.status, run.summary.messages
    packing = run.file.config.get("recording")
    is_running_loop = status == "running" and not run.can_train_again
    has = {
        "": True,
        "checkpoints": bool(messages.get(schema.CHECKPOINT_TOPIC.name)) or is_running_loop,
        "episodes": has_episodes,
        "pictures": bool(messages.get(schema.IMAGE_TOPIC.name)) or is_running_loop,
        "tables": has_tables,
        "training": run.can_train_again,
    }
    missing = {
        "episodes": "recorded steps",
        "tables": "Q-tables",
        "training": "training that the runner can repeat" if has_tables else "Q-tables",
    }
    installed = [view for view in map(view_named, installed_names()) if view.has_tab]
    return RunHead(
        id=run.run_id,
        name=run.name,
        seed=run.seed if run.has_seed else None,
        status=status,
        created=run.created.isoformat(),
        tags=run.tags,
        note=run.note,
        tabs=(
            *((path, title) for path, title, need in TABS if has[need]),
            *((view.name, view.title) for view in installed),
        ),
        lacking={path: missing[need] for path, _, need in TABS if need in missing and not has[need]},
        steps=str(packing.get("steps", "all")) if isinstance(packing, Mapping) else "all",
    )


def _has_recorded_tables(run: Run) -> bool:
    """Return whether a loop recorded tables that can be drawn as maps; only one with arrays is opened."""
    if not run.summary.messages.get(schema.ARRAY_TOPIC.name):
        return False
    with contextlib.suppress(RecordingError), open_recording(run.recording) as recording:
        return recording.tabular and next(recorded_tables(recording), None) is not None
    return False


def result_of(metric: EvaluationMetric, evaluation: EvaluationMetrics) -> tuple[str, str]:
    """Return the name of a metric in the last evaluation, and its value with its unit."""
    value = evaluation.values.get(metric.name)
    heading = metric.heading.removesuffix(metric.suffix).capitalize()
    return f"{heading} in the last evaluation", humanize.number(value) + metric.suffix * (value is not None)
