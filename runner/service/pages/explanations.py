"""Explanations of the difference between two runs: a form, which queues a job, and the results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from http import HTTPStatus
from typing import Annotated, ClassVar

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import RedirectResponse
from starlette.concurrency import run_in_threadpool

from runner.analysis.sections import Section
from runner.analysis.step_reference import StepRef
from runner.debugging.explain import DEFAULT_SEEDS
from runner.debugging.explanation import Explanation, plots, sections
from runner.errors import RunnerError
from runner.export.plots.curves import Plot
from runner.export.reports.rendering import Link, View
from runner.service.api.comparing import Part, found_explanation
from runner.service.api.questions import queue_explanation
from runner.service.dependencies import JobsOf, SettingsOf
from runner.service.jobs.explanations import ExplainQuestion
from runner.service.pages.rendering import Form, message_of, number_in, page

router = APIRouter(include_in_schema=False)
Name = Annotated[str, Query(max_length=200)]


@dataclass(frozen=True)
class _ExplanationView(View):
    TEMPLATE: ClassVar = "explanation.html"
    title: str
    lead: list[str]
    links: Sequence[Link]
    plots: Sequence[Plot]
    results: Sequence[Section]


@dataclass(frozen=True)
class _ExplainView(View):
    TEMPLATE: ClassVar = "explain.html"
    form: Mapping[str, str]
    """The fields as they were sent."""
    problem: str = ""


@router.get("/explain")
def form(request: Request, a: Name = "", b: Name = "") -> Response:
    """Show the form."""
    return page(request, _ExplainView({"a": a, "b": b}))


@router.post("/explain")
async def explain(request: Request, sent: Form, jobs: JobsOf) -> Response:
    """Queue the explanation, or show what is wrong."""
    given = {name: text.strip() for name, text in sent.items()}
    try:
        numbers = {name: number_in(given, name) for name in ("at", "seeds")}
        question = ExplainQuestion(
            a=given.get("a", ""),
            b=given.get("b", ""),
            metric=given.get("metric") or None,
            at=numbers["at"],
            seeds=numbers["seeds"] or DEFAULT_SEEDS,
        )
        job = await queue_explanation(jobs, question)
    except RunnerError as error:
        view = _ExplainView(given, message_of(error, request))
        return await run_in_threadpool(page, request, view, HTTPStatus.UNPROCESSABLE_ENTITY)
    return RedirectResponse(f"/queue/{job.number}", HTTPStatus.SEE_OTHER)


@router.get("/sweeps/explanations/{pair}/{metric}")
def explanation(request: Request, pair: Part, metric: Part, settings: SettingsOf) -> Response:
    """Show an explanation."""
    result = found_explanation(pair, metric, settings)
    first, *others = sections(result)
    return page(
        request, _ExplanationView(first.title, first.sentences, _links(result), plots(result), others)
    )


def _links(found: Explanation) -> list[Link]:
    """Return the replays of the first step that the strongest setting changed, without and with it."""
    first = found.first_step
    if first is None or first.episode is None:
        return []
    step = StepRef(first.episode, first.t or 0)
    runs = (("without", first.run_a), ("with", first.run_b))
    return [Link(f"Replay {word} {first.setting}", step.replay_address(run)) for word, run in runs]
