"""Explanations of the difference between two runs: a form, which queues a job, and the results."""

from __future__ import annotations

from dataclasses import replace
from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Query, Response

from runner.analysis.episodes import EpisodeRef
from runner.analysis.sections import Link
from runner.debugging.explanation import Explanation, drawn_sections
from runner.errors import RunnerError
from runner.service.api.comparing import Part, found_explanation
from runner.service.api.questions import queue_explanation
from runner.service.dependencies import JobsOf, SettingsOf
from runner.service.jobs.checking import ExplainQuestion
from runner.service.pages.rendering import Form, Page, to_job
from runner.service.problems import filled

router = APIRouter(include_in_schema=False)
Name = Annotated[str, Query(max_length=200)]


@router.get("/explain")
def form(a: Name = "", b: Name = "") -> Response:
    """Show the form."""
    return Page("explain.html", {"given": {"a": a, "b": b}, "problem": ""})


@router.post("/explain")
async def explain(sent: Form, jobs: JobsOf) -> Response:
    """Queue the explanation, or show what is wrong."""
    given = {name: text.strip() for name, text in sent.items()}
    try:
        job = await queue_explanation(jobs, filled(ExplainQuestion, given))
    except RunnerError as error:
        values = {"given": given, "problem": error}
        return Page("explain.html", values, HTTPStatus.UNPROCESSABLE_ENTITY)
    return to_job(job.number)


@router.get("/sweeps/explanations/{pair}/{metric}")
def explanation(pair: Part, metric: Part, settings: SettingsOf) -> Response:
    """Show an explanation."""
    result = found_explanation(pair, metric, settings)
    first, *others = drawn_sections(result)
    shown = [replace(first, title="", links=_links(result)), *others]
    return Page("explanation.html", {"title": first.title, "answer": shown})


def _links(found: Explanation) -> list[Link]:
    """Return the replays of the first step that the strongest setting changed, without and with it."""
    first = found.first_step
    if first is None or first.episode is None:
        return []
    step = EpisodeRef(first.episode, first.t or 0)
    runs = (("without", first.run_a), ("with", first.run_b))
    return [Link(f"Replay {word} {first.setting}", step.replay_address(run)) for word, run in runs]
