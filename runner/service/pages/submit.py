"""Submitting a configuration or a sweep, with the schema's help, and every mistake at its line."""

from __future__ import annotations

import functools
import json
from collections.abc import Iterator, Mapping, Sequence
from http import HTTPStatus
from types import MappingProxyType
from typing import Annotated, Final, NamedTuple

from fastapi import APIRouter, Query, Request, Response
from pydantic import BaseModel
from starlette.concurrency import run_in_threadpool

from runner.config.schema import branches, expected, json_schema, without_references
from runner.errors import RunnerError
from runner.service.api.jobs import Workers
from runner.service.dependencies import CatalogueOf, JobsOf
from runner.service.errors import Refused
from runner.service.jobs.checking import SWEEP_KEYS
from runner.service.jobs.store import CheckedJob
from runner.service.pages.rendering import Form, Page, to_job, viewer_of
from runner.service.problems import error_body, filled
from runner.sweep.model import SweepFile
from runner.util.values import Json, JsonView
from runner.util.yaml_text import write_yaml

router = APIRouter(prefix="/submit", include_in_schema=False)
TEMPLATE: Final = "submit.html"

FIRST: Final = """\
# A first look: one agency learns to drive both taxis, in a second or two.
name: first
mode: cooperative
episodes: 3000
seed: 0
step_size: 1.0
discount: 0.99
epsilon: {schedule: linear, start: 1.0, end: 0.1, over: 3000}
evaluation: {every: 200, trials: 100}
"""
SWEEP: Final = """\
# Several values, several seeds each: what of it matters?
name: which-discount
base:
  name: quick
  mode: cooperative
  episodes: 1000
  step_size: 1.0
  epsilon: {schedule: linear, start: 1.0, end: 0.1, over: 1000}
  evaluation: {every: 200, trials: 50}
parameters:
  discount: [0.9, 0.95, 0.99]
strategy: grid
seeds: [0, 1]
"""


class _Options(BaseModel):
    """The fields of the form besides the text."""

    workers: Workers = None


class FormProblem(NamedTuple):
    """A mistake in the submitted text."""

    line: int | None
    path: str | None
    message: str
    text: str
    """The line's text."""


class Key(NamedTuple):
    """A key of a configuration or a sweep, as the schema describes it."""

    name: str
    description: str
    expected: str
    """What it takes, as in messages about it."""
    default: str
    inner: list[Key]


@router.get("")
def form(
    request: Request,
    catalogue: CatalogueOf,
    origin: Annotated[str, Query(alias="from", max_length=200)] = "",
    sweep: Annotated[bool, Query()] = False,
) -> Response:
    """Show the form, with a configuration to start from."""
    if not viewer_of(request).can_write:
        raise Refused(
            HTTPStatus.FORBIDDEN, "token: found one for reading, expected one for writing: log in with that."
        )
    text = SWEEP if sweep else FIRST
    if origin:
        text = write_yaml(catalogue.find(origin).file.config)
    return Page(TEMPLATE, _values(text))


@router.post("")
async def submit(request: Request, sent: Form, jobs: JobsOf) -> Response:
    """Queue the text of the form, or show its mistakes."""
    text = sent.get("text", "")
    try:
        checked = await jobs.checker.check(text)
        if sent.get("action") == "check":
            return Page(TEMPLATE, _values(text, sent, checked=checked))
        options = filled(_Options, {"workers": sent.get("workers")})
        job = await run_in_threadpool(jobs.add, text, checked, options.workers)
    except RunnerError as error:
        values = _values(text, sent, _problems(request, text, error))
        return Page(TEMPLATE, values, HTTPStatus.UNPROCESSABLE_ENTITY)
    return to_job(job.number)


def _problems(request: Request, text: str, error: RunnerError) -> list[FormProblem]:
    """Return the mistakes in a text, each with its line."""
    body = error_body(error, request.app.state.settings)
    lines = dict(enumerate(text.splitlines(), 1))
    problems = [FormProblem(p.line, p.path, p.message, lines.get(p.line or 0, "")) for p in body.problems]
    return problems or [FormProblem(None, None, body.message, "")]


def _values(
    text: str,
    sent: Mapping[str, str] = MappingProxyType({}),
    problems: Sequence[FormProblem] = (),
    checked: CheckedJob | None = None,
) -> dict[str, object]:
    """Return the values of the page; `checked` is what the text means, if it was checked and is valid."""
    is_sweep = any(line.startswith(f"{key}:") for line in text.splitlines() for key in SWEEP_KEYS)
    return {
        "text": text,
        "workers": sent.get("workers", ""),
        "problems": problems,
        "checked": checked,
        "keys": config_keys(),
        "sweep_keys": sweep_keys() if is_sweep else [],
    }


@functools.cache
def config_keys() -> list[Key]:
    """Return the keys of a configuration."""
    return list(_keys(without_references(json_schema())["properties"]))


@functools.cache
def sweep_keys() -> list[Key]:
    """Return the keys of a sweep."""
    return list(_keys(without_references(SweepFile.model_json_schema())["properties"]))


def _keys(properties: JsonView) -> Iterator[Key]:
    for name, node in properties.items():
        inner: Json = {}
        for option in branches(node):
            inner |= option.get("properties", {})
        default = json.dumps(node["default"]) if "default" in node else ""
        yield Key(name, node.get("description", ""), expected(node), default, list(_keys(inner)))
