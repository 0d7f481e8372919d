"""Submitting a configuration or a sweep: the schema's help beside it, every mistake told at its line."""

from __future__ import annotations

import functools
import json
from collections.abc import Iterator, Mapping
from http import HTTPStatus
from typing import Annotated, Any, Final

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import RedirectResponse
from starlette.concurrency import run_in_threadpool

from runner.config.document import write_yaml
from runner.config.schema import json_schema, without_references
from runner.errors import RunnerError
from runner.service.dependencies import CatalogueOf, JobsOf
from runner.service.errors import Refused
from runner.service.jobs.checking import SWEEP_KEYS, CheckedJob
from runner.service.pages.forms import Form
from runner.service.pages.rendering import page, viewer_of
from runner.service.problems import error_body

router = APIRouter(prefix="/submit", include_in_schema=False)

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


@router.get("")
def form(
    request: Request,
    catalogue: CatalogueOf,
    origin: Annotated[str, Query(alias="from", max_length=200)] = "",
    sweep: Annotated[bool, Query()] = False,
) -> Response:
    """Show the form, with a configuration to begin with."""
    if not viewer_of(request).can_write:
        raise Refused(
            HTTPStatus.FORBIDDEN, "token: found one for reading, expected one for writing: log in with that."
        )
    text = SWEEP if sweep else FIRST
    if origin:
        text = write_yaml(catalogue.find(origin).file.config)
    return _form(request, text)


@router.post("")
async def submit(request: Request, sent: Form, jobs: JobsOf) -> Response:
    """Queue what was sent, or say what is wrong with it."""
    text = sent.get("text", "")
    try:
        checked = await jobs.checker.check(text)
        if sent.get("action") == "check":
            return await run_in_threadpool(_form, request, text, fine=checked)
        job = await run_in_threadpool(jobs.add, text, checked)
    except RunnerError as error:
        return await run_in_threadpool(_refused, request, text, error)
    return RedirectResponse(f"/queue/{job.number}", HTTPStatus.SEE_OTHER)


def _refused(request: Request, text: str, error: RunnerError) -> Response:
    """Return the form with what is wrong, each mistake with its line."""
    trouble = error_body(error, request.app.state.settings)
    lines = text.splitlines()
    problems = [
        {"line": p.line, "path": p.path, "message": p.message, "text": _line(lines, p.line)}
        for p in trouble.problems
    ]
    return _form(request, text, problems or [_whole(trouble.message)], status=HTTPStatus.UNPROCESSABLE_ENTITY)


def _form(
    request: Request,
    text: str,
    problems: list[dict[str, Any]] | None = None,
    fine: CheckedJob | None = None,
    status: HTTPStatus = HTTPStatus.OK,
) -> Response:
    lines = text.splitlines()
    is_sweep = any(line.startswith(f"{key}:") for line in lines for key in SWEEP_KEYS)
    told = {"text": text, "problems": problems or [], "fine": fine}
    told |= {"keys": keys_of_config(), "keys_of_sweep": keys_of_sweep() if is_sweep else []}
    return page(request, "submit.html", status, **told)


def _line(lines: list[str], number: int | None) -> str:
    return lines[number - 1] if number and number <= len(lines) else ""


def _whole(message: str) -> dict[str, Any]:
    return {"line": None, "path": None, "message": message, "text": ""}


@functools.cache
def keys_of_config() -> list[dict[str, Any]]:
    """Return the keys of a configuration, with what the schema says of each."""
    schema = without_references(json_schema())
    return list(_keys(schema["properties"]))


@functools.cache
def keys_of_sweep() -> list[dict[str, Any]]:
    """Return the keys of a sweep, in the same way."""
    from runner.sweep.model import SweepFile

    return list(_keys(without_references(SweepFile.model_json_schema())["properties"]))


def _keys(properties: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    for name, node in properties.items():
        options = [node, *node.get("anyOf", ()), *node.get("oneOf", ())]
        inner: dict[str, Any] = {}
        for option in options:
            inner |= option.get("properties", {})
        yield {
            "name": name,
            "description": node.get("description", ""),
            "kind": _kind(options),
            "default": json.dumps(node["default"]) if "default" in node else "",
            "inner": list(_keys(inner)),
        }


def _kind(options: list[Mapping[str, Any]]) -> str:
    """Return what a value may be, in a few words."""
    said: list[str] = []
    for option in options:
        if "enum" in option:
            said.append(", ".join(map(str, option["enum"])))
        elif "const" in option:
            said.append(str(option["const"]))
        elif "type" in option:
            said.append(_WORDS.get(str(option["type"]), str(option["type"])) + _bounds(option))
    return " or ".join(dict.fromkeys(said))


def _bounds(option: Mapping[str, Any]) -> str:
    low = option.get("minimum", option.get("exclusiveMinimum"))
    high = option.get("maximum", option.get("exclusiveMaximum"))
    if high is not None and high > _UNTOLD:
        high = None
    if low is None and high is None:
        return ""
    if high is None:
        return f" {'above' if 'exclusiveMinimum' in option else 'from'} {low}"
    return f" {'' if low is None else low} to {high}"


_UNTOLD: Final = 10**9
"""A greatest value beyond this says nothing to people."""
_WORDS: Final = {
    "integer": "whole number",
    "number": "number",
    "string": "text",
    "boolean": "true or false",
    "array": "list",
    "object": "keys",
    "null": "nothing",
}
